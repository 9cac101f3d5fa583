"""Dask clusters for tests: workers that are threads of this process, or processes to be killed."""

import logging
import warnings
from contextlib import contextmanager

import distributed

from tuning.parallel.cluster import Cluster


@contextmanager
def threads_cluster(workers=2, patience=20.0):
    """Two workers in this process: started at once, with everything that a test has replaced."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # distributed's own, on closing
        with (
            distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=False,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            ) as local,
            distributed.Client(local, set_as_default=False) as client,
        ):
            yield Cluster(client, patience)
