"""Work shared out: a Dask cluster, the ranks of torchrun, processes of this machine."""
