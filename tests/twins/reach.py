"""Which tiles' motion reaches which tiles, and how many taps a path has: plain loops."""

import math

from twins import reconstruction as common
from twins.notes2025 import best, pixels_of


def directions_of(field, settings):
    """Longest and complementing vector of all tiles whose motion reaches each tile."""
    r = settings.tile_size
    own = common.tile_max(field, r)
    places = [(ty, tx) for ty in range(len(own)) for tx in range(len(own[0]))]
    candidates = {
        (ty, tx): (own[ty][tx], best(pixels_of(field, tx, ty, r), own[ty][tx], settings))
        for ty, tx in places
    }
    first = [[None] * len(own[0]) for _ in own]
    second = [[None] * len(own[0]) for _ in own]
    for ty, tx in places:
        found = [
            (number, v)
            for sy, sx in places
            for number, v in enumerate(candidates[sy, sx])
            if arrives(v, (tx - sx, ty - sy), settings)
        ]
        first[ty][tx] = common.longest([v for number, v in found if number == 0])
        second[ty][tx] = best([v for _, v in found], first[ty][tx], settings)
    return first, second


def arrives(v, offset, settings):
    """Does a tile that moves by τ v overlap the tile at an offset (in tiles) at some τ?

    τ runs over the open shutter; the eight tiles around always count.
    """
    if max(abs(o) for o in offset) <= 1:
        return True
    low, high = settings.c - 1.0, settings.c + 1.0
    for o, along in zip(offset, v, strict=True):
        away = o * settings.tile_size
        if along == 0:
            if abs(away) >= settings.tile_size:
                return False
            continue
        ends = [(away + side * settings.tile_size) / along for side in (-1, 1)]
        low, high = max(low, min(ends)), min(high, max(ends))
    return low < high


def taps_of(lengths, settings):
    """num_samples · √2^k, the least k for which the taps of the longest path are close enough."""
    least = settings.num_samples
    if settings.tap_spacing == 0:
        return least
    needed, step = 2 * max(lengths) / settings.tap_spacing / least, 0
    most = max(least, settings.max_samples)
    while 2 ** (step / 2) < needed * (1 - 1e-5) and math.ceil(least * 2 ** (step / 2)) < most:
        step += 1
    return min(most, math.ceil(least * 2 ** (step / 2)))
