"""Forward splatting: what pixels leave where they move to, the nearer before the farther.

A splat has marks, one for each target pixel that it touches. Targets are numbered 0 to T − 1;
number T takes what falls outside. All functions are sums and minima over marks, without loops
over pixels, and leave their arguments unchanged.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Composite", "Marks", "composite", "footprints", "nearest_depth"]

LEAST_SHARE = 1e-3
"""A mark that covers less of a pixel hides nothing there."""

_TINY = 1e-8
_BEHIND = 0.36787944117144233  # exp(-1): farther than the nearest by the extent
_DEEPEST = 80.0  # exp(-80) is nothing


class Marks(NamedTuple):
    """What splats touch."""

    target: Tensor
    """Numbers of the target pixels, (K, M)."""
    share: Tensor
    """How much of the target the splat covers, (K, M)."""


class Composite(NamedTuple):
    """The nearest two layers over nothing."""

    color: Tensor
    """Color times coverage, (C, T + 1)."""
    coverage: Tensor
    """Share of the pixel that is covered, in [0, 1], (1, T + 1)."""


def footprints(x: Tensor, y: Tensor, size: tuple[int, int], width: float | Tensor) -> Marks:
    """Return the four pixels around positions, and how a square splat shares itself out.

    ``a = sat((f − ½) / width + ½)`` goes to the right pixel and 1 − a to the left one, f being
    the fraction of x; likewise along y. With a width of 1 px that is bilinear.

    Args:
        x: Columns in pixel indices, (M,).
        y: Rows, likewise.
        size: Height and width of the image, px.
        width: Edge of the square, px, in (0, 1]; a number or (M,).

    Returns:
        Marks (4, M); a target is ``row · W + column``, and −1 outside the image.

    Differentiable: in positions and width, but for kinks where x is whole (width 1).
    """
    left, top = x.detach().floor(), y.detach().floor()
    right_share = ((x - left - 0.5) / width + 0.5).clamp(0, 1)
    lower_share = ((y - top - 0.5) / width + 0.5).clamp(0, 1)
    targets, shares = [], []
    for dy, share_y in ((0, 1 - lower_share), (1, lower_share)):
        for dx, share_x in ((0, 1 - right_share), (1, right_share)):
            column, row = left + dx, top + dy
            inside = (column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])
            number = row.clamp(0, size[0] - 1).long() * size[1]
            number = number + column.clamp(0, size[1] - 1).long()
            targets.append(torch.where(inside, number, -1))
            shares.append(share_x * share_y)
    return Marks(torch.stack(targets), torch.stack(shares))


def nearest_depth(marks: Marks, depth: Tensor, empty: Tensor, among: Tensor) -> Tensor:
    """Return the least depth at each target among some marks.

    Args:
        marks: The marks.
        depth: Of each splat, (M,).
        empty: Zeros, (T + 1,): says how many targets there are.
        among: Marks that count, bool, (K, M).

    Returns:
        Depth (T + 1,); a quarter of the greatest number where there is no mark.

    Differentiable: in the depth of the nearest.
    """
    far = torch.finfo(depth.dtype).max / 4
    values = torch.where(among, depth, far).flatten()
    return (empty + far).scatter_reduce(0, marks.target.flatten(), values, "amin")


def composite(
    marks: Marks,
    color: Tensor,
    depth: tuple[Tensor, Tensor],
    empty: Tensor,
    extent: Tensor,
    gain: Tensor,
) -> Composite:
    """Return the nearest layer over the next one.

    A mark belongs to the nearest layer by ``f = exp(−max(z' − z_min, 0) / (extent · z_min))``,
    z_min being the least depth at the target. What is left, 1 − f, belongs to the next layer by
    the same weight over the least depth among marks with f < 1/e. Each layer has the mean color
    of its marks and covers ``min(gain · Σ share, 1)`` of the pixel.

    Args:
        marks: The marks.
        color: Of each splat, (C, M).
        depth: z and z' of each splat, (M,) each: z' is nearer by what its own surface is slanted.
        empty: Zeros, (T + 1,).
        extent: Relative depth over which front and back are told apart, 0-d or (T + 1,).
        gain: See above, 0-d or (T + 1,).

    Returns:
        Color times coverage, and coverage.

    Differentiable: in everything but `empty`.
    """
    target = marks.target
    solid = marks.share > LEAST_SHARE
    front = _share_of_nearest(
        nearest_depth(marks, depth[0], empty, solid), depth[1], target, extent
    )
    behind = nearest_depth(marks, depth[0], empty, solid & (front < _BEHIND))
    back = (1 - front) * _share_of_nearest(behind, depth[1], target, extent)
    near = _layer(target, marks.share * front, color, empty, gain)
    far = _layer(target, marks.share * back, color, empty, gain)
    free = 1 - near.coverage
    return Composite(near.color + free * far.color, near.coverage + free * far.coverage)


def _share_of_nearest(nearest: Tensor, depth: Tensor, target: Tensor, extent: Tensor) -> Tensor:
    scale = extent * nearest
    where = target.flatten()
    apart = depth - nearest.index_select(0, where).view_as(target)
    return (-(apart / scale.index_select(0, where).view_as(target)).clamp(0, _DEEPEST)).exp()


def _layer(target: Tensor, weight: Tensor, color: Tensor, empty: Tensor, gain: Tensor) -> Composite:
    where = target.flatten()
    total = empty.scatter_add(0, where, weight.flatten())
    sums = torch.stack([empty.scatter_add(0, where, (weight * plane).flatten()) for plane in color])
    coverage = (gain * total).clamp(max=1)
    return Composite(sums / total.clamp(min=_TINY) * coverage, coverage[None])
