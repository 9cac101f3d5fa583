"""Noise per pixel for jittered taps: deterministic, tileable, seeded."""

from __future__ import annotations

import functools
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torchblur.ops.gather import pixel_grid
from torchblur.ops.pixels import PixelList

__all__ = [
    "NoiseKind",
    "checkerboard",
    "dither_2x2",
    "halton",
    "halton_plane",
    "interleaved_gradient_noise",
    "noise_plane",
]

NoiseKind = Literal["halton", "gradient", "none"]

_TILE = 32
_BASES = (2, 3, 5, 7)
_FRAME_STRIDE = 5.588238  # shift between frames that decorrelates interleaved gradient noise


def halton(count: int, base: int) -> Tensor:
    """Return the first points of the van der Corput sequence in a base, skipping 0.

    Args:
        count: Number of points.
        base: A prime.

    Returns:
        Points in (0, 1), float64, shape (count,).
    """
    index = torch.arange(1, count + 1, dtype=torch.int64)
    result = torch.zeros(count, dtype=torch.float64)
    fraction = 1.0
    while bool(index.any()):
        fraction /= base
        result += fraction * (index % base)
        index = index // base
    return result


def halton_plane(
    like: Tensor, stream: int = 0, seed: int = 0, pixels: PixelList | None = None
) -> Tensor:
    """Return a plane of Halton points: a shuffled tile of 32² points, repeated.

    Args:
        like: Any tensor of the image's size, (B, C, H, W).
        stream: 0 to 3; streams use other bases, so that they do not correlate.
        seed: Shuffles the tile; give each frame of a sequence its own.
        pixels: For these alone, as a list (1, 1, 1, M).

    Returns:
        Values in [0, 1), (1, 1, H, W).

    Reference: Guertin 2014, section 4.5, asks for a Halton sequence and does not say which pixel
        gets which point; this shuffle is ours.
    """
    tile = torch.tensor(_halton_tile(stream, seed), dtype=like.dtype, device=like.device)
    height, width = like.shape[-2:] if pixels is None else pixels.size
    repeated = tile.repeat(-(-height // _TILE), -(-width // _TILE))[:height, :width]
    plane = repeated[None, None]
    return plane if pixels is None else pixels.pack(plane)


@functools.lru_cache(maxsize=64)
def _halton_tile(stream: int, seed: int) -> npt.NDArray[np.float64]:
    """Return the shuffled tile; an array, as no tensor of one trace may get into another."""
    generator = torch.Generator().manual_seed(seed * len(_BASES) + stream)
    order = torch.randperm(_TILE * _TILE, generator=generator)
    tile: npt.NDArray[np.float64] = halton(_TILE * _TILE, _BASES[stream])[order].numpy()
    return tile.reshape(_TILE, _TILE)


def interleaved_gradient_noise(
    like: Tensor, stream: int = 0, seed: int = 0, pixels: PixelList | None = None
) -> Tensor:
    """Return ``frac(52.9829189 · frac(0.06711056 x + 0.00583715 y))``.

    Args:
        like: Any tensor of the image's size, (B, C, H, W).
        stream: Shifts the pattern, so that two streams differ.
        seed: Shifts the pattern; give each frame of a sequence its own.
        pixels: For these alone, as a list (1, 1, 1, M).

    Returns:
        Values in [0, 1), (1, 1, H, W).

    Reference: Jimenez 2014.
    """
    x, y = pixel_grid(like, pixels)
    shift = _FRAME_STRIDE * (seed % 64)
    shift_x, shift_y = shift + 13.0 * stream, shift + 29.0 * stream  # no correlation: measured
    inner = 0.06711056 * (x + shift_x) + 0.00583715 * (y + shift_y)
    return (52.9829189 * inner.frac()).frac()


def checkerboard(like: Tensor, pixels: PixelList | None = None) -> Tensor:
    """Return ``(x + y) & 1``: 0 and 1 by turns.

    Args:
        like: Any tensor of the image's size, (B, C, H, W).
        pixels: For these alone, as a list (1, 1, 1, M).

    Returns:
        Zeros and ones, (1, 1, H, W).
    """
    x, y = pixel_grid(like, pixels)
    return torch.remainder(x + y, 2)


def dither_2x2(like: Tensor, pixels: PixelList | None = None) -> Tensor:
    """Return the ordered dither of 2x2 pixels, ``[[+¼, −¼], [−¼, +¼]]``.

    Two neighbors shift their taps by half a step against each other, so that the mean of a
    2x2 block has twice the taps.

    Args:
        like: Any tensor of the image's size, (B, C, H, W).
        pixels: For these alone, as a list (1, 1, 1, M).

    Returns:
        Plus and minus one quarter, (1, 1, H, W).

    Reference: Jimenez 2014, as in public ports.
    """
    return 0.25 - 0.5 * checkerboard(like, pixels)


def noise_plane(
    kind: NoiseKind, like: Tensor, stream: int = 0, seed: int = 0, pixels: PixelList | None = None
) -> Tensor:
    """Return a plane of noise by its name; "none" is one half everywhere.

    Args:
        kind: "halton", "gradient" (interleaved gradient noise) or "none".
        like: Any tensor of the image's size, (B, C, H, W).
        stream: Streams of one seed do not correlate.
        seed: Another pattern for another seed.
        pixels: For these alone, as a list (1, 1, 1, M).

    Returns:
        Values in [0, 1), (1, 1, H, W).
    """
    if kind == "halton":
        return halton_plane(like, stream, seed, pixels)
    if kind == "gradient":
        return interleaved_gradient_noise(like, stream, seed, pixels)
    shape = (1, 1, *like.shape[-2:]) if pixels is None else (1, 1, 1, pixels.count)
    return like.new_full(shape, 0.5)
