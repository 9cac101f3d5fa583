"""Lists of pixels: what is computed for a list costs nothing where the list does not reach.

Planes (B, C, H, W) are laid flat as (C, B·H·W); a list holds positions in them. Values of a list
are (C, N), one column per pixel. The taps of a gather (`ops.taps`) look up at positions near
the listed pixels, and may leave the list but not the image.
"""

from __future__ import annotations

from collections import abc
from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.ops.taps import Inputs

__all__ = [
    "Points",
    "flat",
    "nearest_index",
    "per_point",
    "points_where",
    "put",
    "take",
    "total",
    "unflat",
]


class Points(NamedTuple):
    """Some pixels of a batch of images."""

    place: Tensor
    """Positions in the flat planes, integers, (N,)."""
    x: Tensor
    """Columns, px, in the planes' type, (1, N)."""
    y: Tensor
    """Rows, px, (1, N)."""
    first: Tensor
    """Position of the first pixel of each one's image, integers, (1, N)."""
    shape: tuple[int, int, int]
    """Batch, height and width of the images."""

    @property
    def number(self) -> int:
        """Number of pixels, N."""
        return self.place.shape[0]

    def inputs(self) -> Inputs:
        """Return what the taps of a gather need to look up near these pixels."""
        size = self.x.new_tensor([self.shape[2], self.shape[1]])
        return {"x": self.x, "y": self.y, "first": self.first, "size": size}

    def among(self, chosen: Tensor) -> Points:
        """Return those of the pixels where a mask (1, N) is true."""
        keep = chosen[0]
        return Points(
            self.place[keep], self.x[:, keep], self.y[:, keep], self.first[:, keep], self.shape
        )


def points_where(mask: Tensor, dtype: torch.dtype = torch.float32) -> Points:
    """Return the pixels where a mask is true, image by image and row by row.

    Args:
        mask: bool, (B, 1, H, W).
        dtype: Floating type of the positions.
    """
    batch, _, height, width = mask.shape
    index = mask.flatten().nonzero()[:, 0]
    image = torch.div(index, height * width, rounding_mode="floor")
    inside = index - image * (height * width)
    y = torch.div(inside, width, rounding_mode="floor")
    x = inside - y * width
    return Points(
        index,
        x.to(dtype)[None],
        y.to(dtype)[None],
        (image * (height * width))[None],
        (batch, height, width),
    )


def flat(planes: Tensor) -> Tensor:
    """Return planes (B, C, H, W) as (C, B·H·W)."""
    return planes.transpose(0, 1).reshape(planes.shape[1], -1)


def unflat(values: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return values (C, B·H·W) as planes (B, C, H, W); the inverse of `flat`."""
    return values.reshape(values.shape[0], *shape).transpose(0, 1)


def take(planes: Tensor, points: Points) -> Tensor:
    """Return the values of planes (B, C, H, W) at the pixels, (C, N).

    Differentiable: in the planes.
    """
    return flat(planes).index_select(1, points.place)


def put(values: Tensor, points: Points, rest: Tensor | None = None) -> Tensor:
    """Return planes that hold values at the pixels, and something else in between.

    Args:
        values: (C, N).
        points: Where they belong.
        rest: Planes for the other pixels, (B, C, H, W); zeros if left out.

    Returns:
        (B, C, H, W).

    Differentiable: in both.
    """
    batch, height, width = points.shape
    if rest is None:
        base = values.new_zeros(values.shape[0], batch * height * width)
    else:
        base = flat(rest)
    return unflat(base.index_copy(1, points.place, values), points.shape)


def per_point(value: Tensor | float, points: Points, like: Tensor) -> Tensor:
    """Return a parameter's value for each pixel: 0-d as it is, planes as (1, N).

    Args:
        value: A number, a 0-d tensor, or one that broadcasts to (B, 1, H, W).
        points: The pixels.
        like: A tensor of the wanted type and device.
    """
    value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if value.ndim == 0:
        return value
    batch, height, width = points.shape
    return take(value.expand(batch, 1, height, width), points)


def nearest_index(x: Tensor, y: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixels nearest to positions: index in the flat planes, column and row.

    Args:
        x: Columns, px; 0 is the center of the first pixel, (1, N).
        y: Rows, px.
        inputs: What `Points.inputs` returned.

    Returns:
        Index (N,), and the pixels' own x and y (1, N): rounded (ties to even), inside the image.

    Border: replicated: positions outside give the nearest pixel inside.
    """
    size = inputs["size"]
    x = torch.minimum(x.round().clamp(min=0), size[0] - 1)
    y = torch.minimum(y.round().clamp(min=0), size[1] - 1)
    index = inputs["first"] + y.long() * size[0].long() + x.long()
    return index[0], x, y


def total(parts: abc.Sequence[tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """Return the sums of several gathers over the same pixels, accumulator by accumulator.

    Args:
        parts: What each gather returned.
    """
    sums = parts[0]
    for part in parts[1:]:
        sums = tuple(a + b for a, b in zip(sums, part, strict=True))
    return sums
