"""Slow twin of the depth of field with all taps: each pixel scatters over its own disc.

Plain loops in float64; nothing here imports torchblur. The circle of each pixel is given, signed,
in px: negative before the focus.
"""

import math

import numpy as np

SHARP = 0.5
OWN = 1e-3


def cover(radius, distance, edge):
    """Share of a pixel at a distance that a disc with a soft rim covers."""
    return min(max((radius - distance) / edge + 0.5, 0.0), 1.0)


def spread(radius, edge):
    """Area that the disc covers, at least a pixel's."""
    return max(math.pi * (radius**2 + edge**2 / 12), 1.0)


def clamped(plane, y, x):
    return plane[..., min(max(y, 0), plane.shape[-2] - 1), min(max(x, 0), plane.shape[-1] - 1)]


def window(reach):
    size = math.ceil(reach)
    for dy in range(-size, size + 1):
        for dx in range(-size, size + 1):
            if math.hypot(dx, dy) <= reach:
                yield dy, dx, math.hypot(dx, dy)


def far_field(color, circle, edge):
    """Return the color with everything behind the focus blurred."""
    result = color.copy()
    for y, x in np.ndindex(circle.shape):
        own = circle[y, x]
        if own <= SHARP:
            continue
        total, weights = OWN * color[:, y, x], OWN
        for dy, dx, distance in window(own + edge / 2):
            other = max(clamped(circle, y + dy, x + dx), 0)
            w = cover(min(other, own), distance, edge) / spread(other, edge)
            total = total + w * clamped(color, y + dy, x + dx)
            weights += w
        result[:, y, x] = total / weights
    return result


def depth_of_field(color, circle, *, max_radius, edge=1.0, near_coverage=1.0):
    """Return color (3, H, W) and the near field's opacity (H, W)."""
    behind, near = far_field(color, circle, edge), np.maximum(-circle, 0)
    result, opacity = behind.copy(), np.zeros_like(circle)
    for y, x in np.ndindex(circle.shape):
        rows = slice(max(y - max_radius, 0), y + max_radius + 1)
        reach = near[rows, max(x - max_radius, 0) : x + max_radius + 1].max()
        if reach <= SHARP:
            continue
        front, front_weight = np.zeros(3), 0.0
        back, back_weight = OWN * color[:, y, x], OWN
        for dy, dx, distance in window(reach + edge / 2):
            other = clamped(near, y + dy, x + dx)
            if other > SHARP:
                w = cover(other, distance, edge) / spread(other, edge)
                front, front_weight = front + w * clamped(color, y + dy, x + dx), front_weight + w
            w = min(max(2 * (1 - other / max(near[y, x], SHARP)), 0), 1) / (1 + distance**2)
            back, back_weight = back + w * clamped(behind, y + dy, x + dx), back_weight + w
        under = back / back_weight if near[y, x] > SHARP else behind[:, y, x]
        if front_weight > 0:
            opacity[y, x] = min(near_coverage * front_weight, 1)
            result[:, y, x] = under + opacity[y, x] * (front / front_weight - under)
        else:
            result[:, y, x] = under
    return result, opacity
