"""Frames small enough to work out by hand what a filter makes of them."""

import numpy as np


def random_frame(rng, rows=9, columns=11):
    """Color, depth and velocity of a frame, all random, the longest vectors over a tile of 4."""
    shape = (rows, columns)
    depth = rng.uniform(1, 3, (1, *shape))
    depth[0, 0, :3] = np.inf
    return rng.uniform(0, 2, (3, *shape)), depth, rng.normal(0, 8, (2, *shape))


def moving_pixel(rng, direction=(1, 0), rows=9, columns=9):
    """A pixel at (4, 4) with V = 2 px, in front (depth 1) of a static, colorful background."""
    color = rng.uniform(0, 1, (3, rows, columns))
    depth = np.full((1, rows, columns), 2.0)
    velocity = np.zeros((2, rows, columns))
    depth[0, 4, 4] = 1
    velocity[:, 4, 4] = np.multiply(4, direction)
    return color, depth, velocity


def uniform(rng, velocity):
    color = rng.uniform(0, 1, (3, 8, 24))
    field = np.broadcast_to(np.reshape(velocity, (2, 1, 1)), (2, 8, 24)).astype(float)
    return color, np.full((1, 8, 24), 5.0), field


def still_stream(rng, rows=9, columns=12):
    """A frame with times: random colors at depth 2, nothing moves."""
    return {
        "color": rng.uniform(0, 1, (3, rows, columns)),
        "depth": np.full((1, rows, columns), 2.0),
        "velocity": np.zeros((2, rows, columns)),
        "time": np.full((1, rows, columns), 0.5),
    }


def moved_stream(rng, velocity, rows=9, columns=12):
    """The same, all of it moving."""
    frame = still_stream(rng, rows, columns)
    frame["velocity"][:] = np.reshape(velocity, (2, 1, 1))
    return frame
