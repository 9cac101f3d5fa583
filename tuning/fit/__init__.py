"""One run, from configuration to preset and report."""
