"""Half resolution and back, without leaks over edges in depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.gather import lookup, pixel_grid
from torchblur.ops.weights import saturate

__all__ = ["HalfImage", "UpsampleRules", "box_halve", "depth_halve", "upsample_over"]


def box_halve(planes: Tensor) -> Tensor:
    """Return the plain means of 2x2 pixels.

    Args:
        planes: (B, C, H, W), any unit.

    Returns:
        (B, C, ceil(H/2), ceil(W/2)).

    Border: replicated.
    """
    return _quads(planes).mean(2)


def depth_halve(
    planes: Tensor, depth: Tensor, extent: float | Tensor, *, relative: bool = False
) -> Tensor:
    """Return means of 2x2 pixels in which only what is as near as the nearest counts.

    ``w = 1 − sat(|Z_min − Z| / extent)``, normalized.

    Args:
        planes: (B, C, H, W), any unit; the depth itself may be among them.
        depth: Z, scene units, finite, (B, 1, H, W).
        extent: Distance at which a pixel no longer counts: scene units, or (relative) as a
            fraction of the nearest depth; a number or (B, 1, ceil(H/2), ceil(W/2)).
        relative: See `extent`.

    Returns:
        (B, C, ceil(H/2), ceil(W/2)).

    Differentiable: in all arguments.
    Border: replicated.
    Reference: 2025 notes, Half Resolution Rendering (computeDownsampleDepthWeight).
    """
    quads = _quads(depth)
    nearest = quads.amin(2, keepdim=True)
    width = torch.as_tensor(extent, dtype=depth.dtype, device=depth.device)
    width = width[:, :, None] if width.ndim == 4 else width
    weights = 1 - saturate((quads - nearest) / (width * nearest if relative else width))
    return (_quads(planes) * weights).sum(2) / weights.sum(2)


def _quads(planes: Tensor) -> Tensor:
    """Return blocks of 2x2 pixels, (B, C, 4, h, w)."""
    height, width = planes.shape[-2:]
    if height % 2 or width % 2:
        planes = F.pad(planes, (0, width % 2, 0, height % 2), mode="replicate")
    blocks = F.pixel_unshuffle(planes, 2)
    return blocks.reshape(planes.shape[0], planes.shape[1], 4, *blocks.shape[-2:])


class HalfImage(NamedTuple):
    """What comes back from half resolution, sizes (ceil(H/2), ceil(W/2))."""

    color: Tensor
    """Scene-linear, not multiplied by alpha, (B, 3, h, w)."""
    alpha: Tensor
    """How much of it is to replace what is there at full resolution, [0, 1], (B, 1, h, w)."""
    depth: Tensor
    """Scene units, (B, 1, h, w)."""


class UpsampleRules(NamedTuple):
    """Which of the measures against leaks are taken, and the width of the depth test."""

    extent: float | Tensor
    """Distance behind a pixel at which a sample no longer counts, scene units or relative."""
    relative: bool = False
    depth_weights: bool = True
    """Weight alphas by depth: what is behind a pixel does not blur over it."""
    alpha_weighted: bool = True
    """Weight colors by their alpha: what is sharp lends no color."""
    fallback: bool = True
    """Where no alpha has a weight, take them without the depth weights."""


def upsample_over(
    color: Tensor, depth: Tensor, half: HalfImage, rules: UpsampleRules
) -> tuple[Tensor, Tensor]:
    """Return a half-resolution image over one of full resolution.

    Args:
        color: Scene-linear, full resolution, (B, 3, H, W).
        depth: Scene units, finite, (B, 1, H, W).
        half: The image to put over it.
        rules: How.

    Returns:
        Color (B, 3, H, W) and the alpha that it was mixed with (B, 1, H, W).

    Differentiable: in all tensors.
    Border: replicated.
    Reference: 2025 notes, Half Resolution Rendering (computeUpsampleDepthWeight and after).
    """
    texture = torch.cat(half, 1)
    corners = [(lookup(texture, x, y), weight) for x, y, weight in _corners(color)]
    depth_weighted = [
        (planes[:, 3:4], weight * _depth_weight(depth, planes[:, 4:], rules))
        for planes, weight in corners
    ]
    alpha, total = _weighted_sum(depth_weighted)
    plain, _ = _weighted_sum([(planes[:, 3:4], weight) for planes, weight in corners])
    lost = plain if rules.fallback else torch.zeros_like(plain)
    alpha = torch.where(total > 0, alpha / torch.where(total > 0, total, 1.0), lost)
    shares = [
        (planes[:, :3], weight * planes[:, 3:4] if rules.alpha_weighted else weight)
        for planes, weight in corners
    ]
    mixed, share = _weighted_sum(shares)
    mixed = mixed / torch.where(share > 0, share, 1.0)
    return torch.lerp(color, mixed, alpha.expand_as(color)), alpha


def _corners(like: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return columns, rows and bilinear weights of the four half-resolution pixels around each."""
    x, y = ((axis + 0.5) / 2 - 0.5 for axis in pixel_grid(like))
    left, top = x.floor(), y.floor()
    u, v = x - left, y - top
    return [
        (left + i, top + j, (u if i else 1 - u) * (v if j else 1 - v))
        for j in (0, 1)
        for i in (0, 1)
    ]


def _depth_weight(pixel: Tensor, sample: Tensor, rules: UpsampleRules) -> Tensor:
    if not rules.depth_weights:
        return torch.ones_like(pixel)
    extent = rules.extent * torch.minimum(pixel, sample) if rules.relative else rules.extent
    return 1 - saturate((sample - pixel) / extent)


def _weighted_sum(pairs: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    first = pairs[0][0] * pairs[0][1]
    weight = pairs[0][1]
    for planes, share in pairs[1:]:
        first = first + planes * share
        weight = weight + share
    return first, weight
