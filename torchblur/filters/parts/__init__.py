"""What filters are made of: the Module and its registry, reach, tiles, taps, sums."""
