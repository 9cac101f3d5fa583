"""How parameters are found: gradients, searches, fronts, polishing and pruning."""
