"""What a depth map tells of the surfaces in it: which neighbors belong together, what lies behind.

Two neighbors lie on one surface if the nearer is not nearer by more than a share, the `gap`:
``1/z_near < (1 + gap) / z_far``. All functions take inverse depths, which steps are even in.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = [
    "Hidden",
    "clean_planes",
    "depth_step",
    "gradients",
    "guess_behind",
    "local_range",
    "neighbors",
    "same_surface",
    "second_differences",
]

_FALL = 0.01  # of the weight with each ring around a pixel: nearer rings come first
_STEPS = ((0, -1), (0, 1), (-1, 0), (1, 0))


class Hidden(NamedTuple):
    """What lies behind some of the pixels."""

    pixels: Tensor
    """Number of the pixel in the batch, (M,): image · H · W + row · W + column."""
    values: Tensor
    """Its planes, the last of them the inverse depth, (M, C)."""


def neighbors(plane: Tensor) -> tuple[Tensor, ...]:
    """Return the left, right, upper and lower neighbors of all pixels, (B, C, H, W) each.

    Border: replicated.
    """
    height, width = plane.shape[-2:]
    padded = F.pad(plane, (1, 1, 1, 1), mode="replicate")
    return tuple(
        padded[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dy, dx in _STEPS
    )


def same_surface(one: Tensor, other: Tensor, gap: float | Tensor) -> Tensor:
    """Return where two inverse depths may belong to one surface, bool."""
    return torch.maximum(one, other) < torch.minimum(one, other) * (1 + gap)


def _links(inverse: Tensor, usable: Tensor, gap: float | Tensor) -> tuple[Tensor, ...]:
    """Return for each of the four neighbors where it is usable and of the same surface."""
    pairs = zip(neighbors(inverse), neighbors(usable.to(inverse.dtype)), strict=True)
    return tuple(same_surface(z, inverse, gap) & (u > 0) for z, u in pairs)


def depth_step(depth: Tensor, usable: Tensor, gap: float | Tensor) -> Tensor:
    """Return how much the depth of a slanted surface changes from pixel to pixel.

    Along each axis it is the smaller of the steps to the neighbors of the same surface, 0 if
    there is none; the larger of both axes counts.

    Args:
        depth: Finite positive depth, (B, 1, H, W).
        usable: Pixels that count as neighbors, bool, (B, 1, H, W).
        gap: See the module.

    Returns:
        The step, in the unit of depth, (B, 1, H, W).

    Differentiable: in the depth.
    """
    far = torch.finfo(depth.dtype).max
    links = _links(1 / depth, usable, gap)
    steps = [
        torch.where(link, (other - depth).abs(), far)
        for link, other in zip(links, neighbors(depth), strict=True)
    ]
    along = [torch.minimum(steps[0], steps[1]), torch.minimum(steps[2], steps[3])]
    return torch.maximum(*(torch.where(step < far, step, 0.0) for step in along))


def gradients(plane: Tensor, inverse: Tensor, usable: Tensor, gap: float | Tensor) -> Tensor:
    """Return the change of planes per px on the pixel's own surface, along x and along y.

    Args:
        plane: Any planes, (B, C, H, W).
        inverse: 1 / depth, (B, 1, H, W).
        usable: Pixels that count as neighbors, bool, (B, 1, H, W).
        gap: See the module.

    Returns:
        The mean of the one-sided differences that stay on the surface, 0 if there is none,
        (B, 2 C, H, W): all planes along x, then along y.

    Differentiable: in the planes.
    """
    links = [link.to(plane.dtype) for link in _links(inverse, usable, gap)]
    left, right, up, down = neighbors(plane)
    along_x = links[1] * (right - plane) + links[0] * (plane - left)
    along_y = links[3] * (down - plane) + links[2] * (plane - up)
    return torch.cat(
        (
            along_x / (links[0] + links[1]).clamp(min=1),
            along_y / (links[2] + links[3]).clamp(min=1),
        ),
        1,
    )


def second_differences(
    plane: Tensor, inverse: Tensor, usable: Tensor, gap: float | Tensor
) -> Tensor:
    """Return the second differences of planes along x and y; 0 where a neighbor is of another.

    Args:
        plane: Any planes, (B, C, H, W).
        inverse: 1 / depth, (B, 1, H, W).
        usable: Pixels that count as neighbors, bool, (B, 1, H, W).
        gap: See the module.

    Returns:
        (B, 2 C, H, W): all planes along x, then along y.

    Differentiable: in the planes.
    """
    links = _links(inverse, usable, gap)
    left, right, up, down = neighbors(plane)
    zero = torch.zeros_like(plane)
    along_x = torch.where(links[0] & links[1], left + right - 2 * plane, zero)
    along_y = torch.where(links[2] & links[3], up + down - 2 * plane, zero)
    return torch.cat((along_x, along_y), 1)


def local_range(plane: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least and the greatest value of a pixel and its usable direct neighbors."""
    low = high = plane
    for other, use in zip(neighbors(plane), neighbors(usable.to(plane.dtype)), strict=True):
        kept = torch.where(use > 0, other, plane)
        low, high = torch.minimum(low, kept), torch.maximum(high, kept)
    return low, high


def clean_planes(
    plane: Tensor, inverse: Tensor, usable: Tensor, gap: float | Tensor, radius: int
) -> Tensor:
    """Return planes in which pixels at an edge take what their surface has beside the edge.

    Renderers average color over a pixel, and depth not: at an edge the color of two surfaces
    stands under the depth of one.

    Args:
        plane: Color, (B, C, H, W).
        inverse: 1 / depth, (B, 1, H, W).
        usable: Pixels that can be trusted, bool, (B, 1, H, W).
        gap: See the module.
        radius: How far to look, px; 0 leaves all as it is. Nearer pixels come first.

    Returns:
        (B, C, H, W); a pixel that finds none keeps its value.

    Differentiable: in the planes.
    """
    if radius == 0:
        return plane
    padded = F.pad(inverse, (1, 1, 1, 1), mode="replicate")
    nearest = F.max_pool2d(padded, 3, 1)
    farthest = -F.max_pool2d(-padded, 3, 1)
    edge = ~same_surface(nearest, inverse, gap) | ~same_surface(farthest, inverse, gap)
    size = (radius,) * 4
    inside = F.pad((usable & ~edge).to(plane.dtype), size)
    depths = F.pad(inverse, size, mode="replicate")
    planes = F.pad(plane, size, mode="replicate")
    height, width = plane.shape[-2:]
    total, weight = torch.zeros_like(plane), torch.zeros_like(inverse)
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            at = (
                ...,
                slice(radius + dy, radius + dy + height),
                slice(radius + dx, radius + dx + width),
            )
            ring = _FALL ** max(abs(dx), abs(dy))
            share = ring * inside[at] * same_surface(depths[at], inverse, gap)
            total, weight = total + share * planes[at], weight + share
    found = edge & (weight > 0)
    return torch.where(found, total / torch.where(found, weight, 1.0), plane)


def guess_behind(planes: Tensor, usable: Tensor, gap: float | Tensor, reach: int) -> Hidden:
    """Return what lies behind pixels near an edge: the surfaces beside it, continued.

    A pixel that is nearer than a neighbor by more than the gap has that neighbor's planes behind
    it, as the mean of all such neighbors; its other neighbors get from it what lies behind them,
    if it is behind them too, and so on, ring by ring.

    Args:
        planes: What to continue; the last one is the inverse depth, (B, C, H, W).
        usable: Pixels that can be continued, bool, (B, 1, H, W).
        gap: See the module; a number, or (B, 1, H, W).
        reach: Number of rings, px.

    Returns:
        The pixels that have something behind them, and what.

    Differentiable: in the planes; which pixels and neighbors count is a choice.
    """
    _, channels, height, width = planes.shape
    rows = planes.permute(0, 2, 3, 1).reshape(-1, channels)
    with torch.no_grad():
        inverse = planes[:, -1:]
        limit = (inverse / (1 + gap)).reshape(-1)
        known = torch.zeros_like(limit, dtype=torch.bool)
        front = usable.reshape(-1).nonzero().flatten()
    index, values = [], []
    given = rows[front]
    for _ in range(reach):
        with torch.no_grad():
            target, source = _neighbors_in_front(front, given[:, -1], limit, known, (height, width))
            if target.numel() == 0:
                break
            front, slot = target.unique(return_inverse=True)
            known[front] = True
            count = torch.zeros_like(front, dtype=given.dtype).index_add(
                0, slot, torch.ones_like(slot, dtype=given.dtype)
            )
        total = given.new_zeros(front.numel(), channels).index_add(0, slot, given[source])
        given = total / count[:, None]
        index.append(front)
        values.append(given)
    if not index:
        return Hidden(front.new_zeros(0), rows.new_zeros(0, channels))
    return Hidden(torch.cat(index), torch.cat(values))


def _neighbors_in_front(
    pixels: Tensor, inverse: Tensor, limit: Tensor, known: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return neighbors of pixels before what these hold, and which of the pixels it was."""
    height, width = size
    row, column = pixels // width % height, pixels % width
    targets, sources = [], []
    for dy, dx in _STEPS:
        inside = (row + dy >= 0) & (row + dy < height) & (column + dx >= 0) & (column + dx < width)
        target = torch.where(inside, pixels + dy * width + dx, 0)
        source = (inside & ~known[target] & (inverse < limit[target])).nonzero().flatten()
        targets.append(target[source])
        sources.append(source)
    return torch.cat(targets), torch.cat(sources)
