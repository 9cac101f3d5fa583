"""Half spreads: how far pixels and tiles blur to each side while the shutter is open."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.filters.parts.base import Values
from torchblur.filters.parts.reach import code_range, longest_spread, swept_times
from torchblur.frame import Frame
from torchblur.ops.directions import TileDirections, tile_directions
from torchblur.ops.reaching import longest_reaching, reaching_directions
from torchblur.ops.tiles import neighbor_max, tile_max
from torchblur.ops.velocity import clamp_length, direction, half_velocity, length, quantize_uint8

__all__ = [
    "Spread",
    "Tiles",
    "around_tiles",
    "exact_spread",
    "per_image",
    "pixel_spread",
    "spread_of",
    "tile_motions",
    "tiles_of",
]


class Spread(NamedTuple):
    """Half spread of each pixel, clamped to what the tiles can reach."""

    half: Tensor
    """V in px, (B, 2, H, W)."""
    length: Tensor
    """|V| in px, (B, 1, H, W)."""
    unit: Tensor
    """V / |V|, or 0 for a still pixel, (B, 2, H, W)."""


class Tiles(NamedTuple):
    """Longest half spreads per tile in px, (B, 2, Ty, Tx): of the tile, and of those around."""

    own: Tensor
    neighborhood: Tensor


def spread_of(
    frame: Frame, values: Values, *, uint8: bool = False, cull: bool = False
) -> tuple[Spread, Tiles]:
    """Return the half spreads of a frame, per pixel and per tile; see `tiles_of`.

    Args:
        frame: The frame.
        values: Shutter and tile size.
        uint8: Store per-pixel vectors in eight bits, and choose among those.
        cull: Leave out diagonal tiles that cannot reach the middle one.
    """
    return pixel_spread(frame, values, uint8=uint8), tiles_of(frame, values, uint8=uint8, cull=cull)


def pixel_spread(frame: Frame, values: Values, *, uint8: bool = False) -> Spread:
    """Return the half spread of each pixel.

    With a shutter that is not centered the taps reach twice as far from the pixel, so that the
    longest half spread is half a tile.

    Args:
        frame: The frame, or a list of its pixels.
        values: Shutter and tile size.
        uint8: Store vectors in eight bits.
    """
    half = half_velocity(frame.velocity, values.shutter, longest_spread(values))
    if uint8:
        half = quantize_uint8(half, code_range(values))
    return Spread(half, length(half), direction(half))


def tiles_of(frame: Frame, values: Values, *, uint8: bool = False, cull: bool = False) -> Tiles:
    """Return the longest half spread of each tile, and of the tiles around it.

    Tiles choose by the length before it is clamped: clamped vectors are all equally long, and
    rounding would choose among them.

    Args:
        frame: The frame.
        values: Shutter and tile size.
        uint8: Choose among vectors stored in eight bits.
        cull: Leave out diagonal tiles that cannot reach the middle one.
    """
    if uint8:
        tiles = tile_max(pixel_spread(frame, values, uint8=True).half, values.tile_size)
        return Tiles(tiles, around_tiles(tiles, values, cull=cull))
    if values.shutter.ndim == 4 and values.shutter.shape[-2:] == frame.size:
        tiles = tile_max(half_velocity(frame.velocity, values.shutter), values.tile_size)
    else:  # one factor for all pixels of an image does not change which is the longest
        tiles = half_velocity(tile_max(frame.velocity, values.tile_size), values.shutter)
    longest = longest_spread(values)
    around = around_tiles(tiles, values, cull=cull)
    return Tiles(clamp_length(tiles, longest), clamp_length(around, longest))


def around_tiles(tiles: Tensor, values: Values, *, cull: bool = False) -> Tensor:
    """Return the longest vector of the 3x3 tiles, or of all whose motion reaches the tile.

    Args:
        tiles: Longest half spread per tile, px, (B, 2, Ty, Tx).
        values: `reach`, `max_reach`, `tile_size`.
        cull: With tiles as the reach: leave out diagonal ones that cannot reach the middle one.
    """
    if values.reach == "tile":
        return neighbor_max(tiles, cull=cull)
    return longest_reaching(tiles, values.tile_size, longest_spread(values), swept_times(values))


def exact_spread(half: Tensor) -> Spread:
    """Return half spreads with lengths of exactly 0 where still.

    A still pixel must not count, however little.

    Args:
        half: In px, (B, 2, H, W).
    """
    unit = direction(half)
    return Spread(half, torch.where((unit == 0).all(1, True), 0.0, length(half)), unit)


def tile_motions(half: Tensor, values: Values, *, two: bool) -> TileDirections:
    """Return the longest half spread around each tile, and one that differs from it.

    Args:
        half: Half spreads of the pixels, px, (B, 2, H, W).
        values: `tile_size`, `reach`, `neighbor_culling`; `direction_reduction` (where tiles are
            the reach), `secondary_exponent`.
        two: Whether the second is wanted; else it is 0.
    """
    size, cull = values.tile_size, values.neighbor_culling
    if values.reach == "frame":
        return reaching_directions(
            half,
            size,
            longest_spread(values),
            swept_times(values),
            two=two,
            exponent=per_image(values.secondary_exponent) if two else 2.0,
        )
    if two:
        return tile_directions(
            half,
            size,
            reduction=values.direction_reduction,
            cull=cull,
            exponent=per_image(values.secondary_exponent),
        )
    primary = neighbor_max(tile_max(half, size), cull=cull)
    return TileDirections(primary, torch.zeros_like(primary))


def per_image(value: Tensor) -> Tensor:
    """Return a parameter without its dependence on the pixel, for use per tile."""
    return value.mean((-2, -1), keepdim=True) if value.ndim == 4 else value
