"""Pure tensor functions: gather, tiles, weights, noise, velocity, color."""
