"""Slow twin of the line blur (Rosado 2007): the mean of taps along each pixel's own velocity."""

import numpy as np
from twins.reconstruction import SHUTTER_CENTER, color_at


def shutter_interval(shutter, position):
    """Opening and closing time in frames: [-E/2, E/2], [0, E] or [-E, 0]."""
    middle = SHUTTER_CENTER[position] * shutter / 2
    return middle - shutter / 2, middle + shutter / 2


def line(
    color, velocity, *, shutter=0.5, shutter_position="centered", num_samples=31, lookup="bilinear"
):
    """Return {"color": (3, H, W)} for color (3, H, W) and velocity (2, H, W) in px/frame."""
    opening, closing = shutter_interval(shutter, shutter_position)
    blurred = np.zeros_like(color)
    _, rows, columns = color.shape
    for y in range(rows):
        for x in range(columns):
            vx, vy = velocity[:, y, x]
            total = np.zeros(3)
            for i in range(num_samples):
                time = opening + (i + 0.5) / num_samples * (closing - opening)
                # What is at p at this time was at p - time · velocity at the frame's own time.
                total += color_at(color, x - time * vx, y - time * vy, lookup)
            blurred[:, y, x] = total / num_samples
    return {"color": blurred}
