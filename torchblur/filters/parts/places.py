"""Where the taps of a pixel lie: shifts by noise, pairs, the shortest reach."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from torchblur.filters.parts.base import Values
from torchblur.ops.noise import NoiseKind, dither_2x2, noise_plane
from torchblur.ops.pixels import PixelList

__all__ = ["SHORTEST_REACH", "PairNoise", "num_pairs", "tap_shift", "tile_noise"]

PairNoise = Literal["checkerboard", "gradient", "halton", "none"]

SHORTEST_REACH = 1e-3
"""Half spread that taps cover at least, px; what is shorter has no direction either."""


def num_pairs(values: Values) -> int:
    """Return how many pairs of taps there are; an odd number of taps gets one more."""
    return int(values.num_samples + 1) // 2


def tap_shift(color: Tensor, values: Values, pixels: PixelList | None = None) -> Tensor:
    """Return how far a pixel's taps are shifted, in steps from tap to tap.

    Args:
        color: For its size, (B, 3, H, W).
        values: `noise` (a `PairNoise`), `jitter`, `seed`.
        pixels: Pixels of which a list is wanted; `jitter` is a list, too, if it is per pixel.

    Returns:
        Shift in [-jitter / 2, jitter / 2], (1 or P, 1, H, W), or a list of the pixels'.
    """
    if values.noise == "checkerboard":
        shift = dither_2x2(color, pixels)
    else:
        shift = noise_plane(values.noise, color, 0, values.seed, pixels) - 0.5
    shifted: Tensor = shift * values.jitter
    return shifted


def tile_noise(values: Values) -> NoiseKind:
    """Return the noise of the tile lookup; a 2x2 dither is too coarse for it."""
    kind: NoiseKind = "gradient" if values.noise == "checkerboard" else values.noise
    return kind
