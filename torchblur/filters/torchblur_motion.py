"""The motion that torchblur's own filter samples along: of pixels, cleaned, and of tiles."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.reach import code_range, longest_spread
from torchblur.filters.spreads import Spread, exact_spread, tile_motions
from torchblur.frame import Frame
from torchblur.ops.directions import TileDirections
from torchblur.ops.velocity import clamp_length, half_velocity, quantize_uint8

__all__ = ["clean_edges", "half_spreads"]

_LEVEL = 1e-6  # neighbors whose depths differ by less, as a share, are one surface


def clean_edges(frame: Frame, values: Values) -> Frame:
    """Return the frame; beside something nearer, pixels have its motion (and its depth).

    Renderers average motion over a pixel: at the edge of an object it is that of neither surface,
    and nothing that follows it arrives.
    """
    depth = frame.finite_depth()
    if values.edge_motion == "own":
        return frame
    depths = _around(depth)
    nearest = depths.amin(1, keepdim=True)
    same = (depths <= nearest * (1 + _LEVEL)).to(depth.dtype)
    beside = depth * (1 - values.edge_depth) > nearest
    share = same / same.sum(1, keepdim=True)
    motion = [(_around(v) * share).sum(1, keepdim=True) for v in frame.velocity.split(1, 1)]
    velocity = torch.where(beside, torch.cat(motion, 1), frame.velocity)
    if values.edge_motion == "surface":
        depth = torch.where(beside, nearest, depth)
    return frame.replaced(velocity=velocity, depth=depth)


def _around(plane: Tensor) -> Tensor:
    """Return the 3x3 values around each pixel of one plane, (B, 9, H, W)."""
    height, width = plane.shape[-2:]
    padded = F.pad(plane, (1, 1, 1, 1), mode="replicate")
    shifts = [(j, i) for j in range(3) for i in range(3)]
    return torch.cat([padded[..., j : j + height, i : i + width] for j, i in shifts], 1)


def half_spreads(frame: Frame, values: Values) -> tuple[Spread, TileDirections]:
    """Return half spreads per pixel, exactly 0 where still, and both motions per tile."""
    size = code_range(values)
    longest = longest_spread(values)
    whole = half_velocity(frame.velocity, values.shutter)
    half = clamp_length(whole, longest)
    if values.velocity_encoding == "uint8":
        whole = half = quantize_uint8(half, size)
    tiles = tile_motions(whole, values, two=values.second_direction)
    if values.velocity_encoding != "uint8":
        tiles = TileDirections(*(clamp_length(tile, longest) for tile in tiles))
    if values.velocity_encoding == "tiles":
        tiles = TileDirections(*(quantize_uint8(tile, size) for tile in tiles))
    return exact_spread(half), tiles
