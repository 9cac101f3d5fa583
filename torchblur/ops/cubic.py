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
    differences D, the value is ``L(f) − u (1 − u) / 2 · L(D_x) − v (1 − v) / 2 · L(D_y)``, kept
    within the four pixels' range: no dark rings around highlights.

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
        mixed difference; the range of the four pixels is kept.
    """
    x = x.clamp(0, inputs["texture"].shape[2] - 1)
    y = torch.minimum(y.clamp(min=0), inputs["height"] - 1)
    left, top = x.detach().floor(), y.detach().floor()
    u, v = x - left, y - top
    places = [(left + i, top + j) for j in (0, 1) for i in (0, 1)]
    corners = [read(inputs, *place, channels=channels) for place in places]
    detail = [read(inputs, *place, name="texture_detail") for place in places]
    values = [_bilinear(four, u, v) for four in zip(*corners, strict=True)]
    bends = [_bilinear(four, u, v) for four in zip(*detail, strict=True)]
    count = len(values)
    cubic = []
    for i, four in enumerate(zip(*corners, strict=True)):
        value = values[i] - u * (1 - u) / 2 * bends[i] - v * (1 - v) / 2 * bends[count + i]
        least = torch.minimum(torch.minimum(four[0], four[1]), torch.minimum(four[2], four[3]))
        most = torch.maximum(torch.maximum(four[0], four[1]), torch.maximum(four[2], four[3]))
        cubic.append(torch.minimum(torch.maximum(value, least), most))
    return tuple(cubic)


def _bilinear(four: Planes, u: Tensor, v: Tensor) -> Tensor:
    return torch.lerp(torch.lerp(four[0], four[1], u), torch.lerp(four[2], four[3], u), v)
