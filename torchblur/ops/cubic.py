"""Cubic lookups: as sharp as the texture, where bilinear ones soften it between its pixels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.gather import Inputs, Planes, read

__all__ = ["read_cubic", "second_differences"]


def second_differences(planes: Tensor) -> Tensor:
    """Return ``f(x − 1) − 2 f(x) + f(x + 1)`` of each plane, along x and then along y.

    Args:
        planes: (B, C, H, W).

    Returns:
        (B, 2C, H, W): all planes along x, then all along y.

    Differentiable: yes.
    Border: replicated.
    """
    padded = F.pad(planes, (1, 1, 1, 1), mode="replicate")
    along_x = padded[..., 1:-1, 2:] + padded[..., 1:-1, :-2] - 2 * planes
    along_y = padded[..., 2:, 1:-1] + padded[..., :-2, 1:-1] - 2 * planes
    return torch.cat((along_x, along_y), 1)


def read_cubic(inputs: Inputs, x: Tensor, y: Tensor, channels: slice) -> Planes:
    """Return a tap's view of the texture, interpolated by Catmull-Rom's cubic; for tap functions.

    With the bilinear value L, the place (u, v) between the four pixels around it, and second
    differences D, the value is ``L(f) − u (1 − u) / 2 · L(D_x) − v (1 − v) / 2 · L(D_y)``. Each
    of the two parts, and both together, keep within the range of what is around: no dark rings
    around highlights.

    Args:
        inputs: "texture", and "texture_detail": the `second_differences` of its `channels`.
        x: Columns, px; 0 is the center of the first pixel, (P, 1, 1, M).
        y: Rows, px, likewise.
        channels: Those of "texture" that are wanted.

    Returns:
        One plane (P, 1, 1, M) per channel.

    Border: replicated.
    Differentiable: in both textures and in the positions.
    Reference: Catmull and Rom 1974. We differ: no term for both axes together, at most 1/64 of a
        mixed difference; the range is kept.
    """
    last = inputs["width"] - 1, inputs["height"] - 1
    x, y = (torch.minimum(p.clamp(min=0), end) for p, end in zip((x, y), last, strict=True))
    # At the last pixel the one before it, so that both borders are alike.
    left, top = (
        torch.minimum(p.detach().floor(), end - 1).clamp(min=0)
        for p, end in zip((x, y), last, strict=True)
    )
    u, v = x - left, y - top
    places = [(left + i, top + j) for j in (0, 1) for i in (0, 1)]
    corners = [read(inputs, *place, channels=channels) for place in places]
    detail = [read(inputs, *place, name="texture_detail") for place in places]
    bends = [_bilinear(four, u, v) for four in zip(*detail, strict=True)]
    count = len(bends) // 2
    cubic = []
    for four, bend_x, bend_y in zip(
        zip(*corners, strict=True), bends[:count], bends[count:], strict=True
    ):
        cubic.append(_bent(four, u, v, u * (1 - u) / 2 * bend_x, v * (1 - v) / 2 * bend_y))
    return tuple(cubic)


def _bent(four: Planes, u: Tensor, v: Tensor, bend_x: Tensor, bend_y: Tensor) -> Tensor:
    """Return the bilinear value less both bends, along each axis and in all within the range."""
    upper_left, upper_right, lower_left, lower_right = four
    left, right = torch.lerp(upper_left, lower_left, v), torch.lerp(upper_right, lower_right, v)
    upper, lower = torch.lerp(upper_left, upper_right, u), torch.lerp(lower_left, lower_right, u)
    value = torch.lerp(left, right, u)
    along_x = _between(value - bend_x, left, right)
    along_y = _between(value - bend_y, upper, lower)
    rows = (upper_left, upper_right), (lower_left, lower_right)
    least = torch.minimum(*(torch.minimum(*row) for row in rows))
    most = torch.maximum(*(torch.maximum(*row) for row in rows))
    return torch.minimum(torch.maximum(along_x + along_y - value, least), most)


def _between(value: Tensor, one: Tensor, other: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(value, torch.minimum(one, other)), torch.maximum(one, other))


def _bilinear(four: Planes, u: Tensor, v: Tensor) -> Tensor:
    return torch.lerp(torch.lerp(four[0], four[1], u), torch.lerp(four[2], four[3], u), v)
