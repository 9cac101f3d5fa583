"""Slow twin of FXAA 3.11 (quality path): one pixel at a time, from the description.

Plain loops in float64; nothing here imports torchblur.
"""

import math

import numpy as np

STEPS_12 = (1.0, 1.5, 2.0, 4.0, 12.0)


def read(plane, x, y):
    """Bilinear lookup in a plane (H, W) at pixel indices, border replicated."""
    rows, columns = plane.shape
    x, y = min(max(x, 0), columns - 1), min(max(y, 0), rows - 1)
    left, top = math.floor(x), math.floor(y)
    right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
    u, v = x - left, y - top
    upper = (1 - u) * plane[top, left] + u * plane[top, right]
    lower = (1 - u) * plane[bottom, left] + u * plane[bottom, right]
    return (1 - v) * upper + v * lower


def edge_end(plane, start, along, mean, enough, steps):
    """Walk until luma leaves its mean by enough; return the distance and how far it is off."""
    distance = steps[0]
    off = read(plane, start[0] + along[0] * distance, start[1] + along[1] * distance) - mean
    for i in range(1, len(steps)):
        if abs(off) >= enough:
            return distance, off
        distance += steps[i]
        if i == len(steps) - 1:
            return distance, off
        off = read(plane, start[0] + along[0] * distance, start[1] + along[1] * distance) - mean
    return distance, off


def shift_of(plane, x, y, threshold, threshold_min, subpix, span_end, steps):
    """Return the shift (dx, dy) of the lookup at a pixel."""
    m = plane[y, x]
    n, s, w, e = (read(plane, x + i, y + j) for i, j in ((0, -1), (0, 1), (-1, 0), (1, 0)))
    nw, ne, sw, se = (read(plane, x + i, y + j) for i, j in ((-1, -1), (1, -1), (-1, 1), (1, 1)))
    high, low = max(m, n, s, w, e), min(m, n, s, w, e)
    if high - low < max(threshold_min, high * threshold):
        return 0.0, 0.0
    horizontal = (
        abs(nw - 2 * w + sw) + 2 * abs(n - 2 * m + s) + abs(ne - 2 * e + se) + 1e-5  # for ties
        >= abs(nw - 2 * n + ne) + 2 * abs(w - 2 * m + e) + abs(sw - 2 * s + se)
    )
    before, after = (n, s) if horizontal else (w, e)
    to_first = abs(before - m) >= abs(after - m)
    other, side = (before, -1) if to_first else (after, 1)
    normal = (0, side) if horizontal else (side, 0)
    tangent = (1, 0) if horizontal else (0, 1)
    start = (x + normal[0] / 2, y + normal[1] / 2)
    mean, enough = (other + m) / 2, span_end * abs(other - m)
    back = edge_end(plane, start, (-tangent[0], -tangent[1]), mean, enough, steps)
    ahead = edge_end(plane, start, tangent, mean, enough, steps)
    distance, off = back if back[0] < ahead[0] else ahead
    span = 0.5 - distance / (back[0] + ahead[0]) if (off < 0) != (m < mean) else 0.0
    lowpass = (2 * (n + s + w + e) + nw + ne + sw + se) / 12
    c = min(abs(lowpass - m) / (high - low), 1) if high > low else 0.0
    amount = max(span, subpix * (c * c * (3 - 2 * c)) ** 2)
    return amount * normal[0], amount * normal[1]


def fxaa(
    color,
    luma,
    *,
    threshold=0.166,
    threshold_min=0.0833,
    subpix=0.75,
    span_end=0.25,
    steps=STEPS_12,
):
    """Return the smoothed color (3, H, W) for color (3, H, W) and luma (H, W)."""
    result = np.empty_like(color)
    for y, x in np.ndindex(luma.shape):
        dx, dy = shift_of(luma, x, y, threshold, threshold_min, subpix, span_end, steps)
        for channel in range(3):
            result[channel, y, x] = read(color[channel], x + dx, y + dy)
    return result
