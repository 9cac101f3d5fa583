"""How good images are: figures of frames and sequences, beside baselines."""
