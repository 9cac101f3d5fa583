"""Smaller windows out of windows: where the most moves, with less context around it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import torch
from torch import Tensor

from torchblur.frame import Frame
from tuning.data.framing import MOVING
from tuning.objective.windows import AnySample, Sample

__all__ = ["pixels_of", "smaller"]

_Box = tuple[int, int, int, int]


def pixels_of(sample: AnySample) -> int:
    """Return how many pixels are filtered in one evaluation of a window."""
    frames = 1 if isinstance(sample, Sample) else sum(len(step) for step in sample.steps)
    return math.prod(sample.size) * frames


def smaller(sample: AnySample, share: float, tile_size: int) -> AnySample:
    """Return the part of a window where the most moves.

    What is filtered, what is scored and the context between them shrink alike, so the cost is
    that of ``share ** 2`` of the window whatever its size. A full frame has no context, and its
    part has none: the figure near its edges is an estimate. Tiles lie as in the window, where
    there is room for that; of equal parts the most central one is taken.

    Args:
        sample: The window.
        share: Edge of the part, as a share of the window's, in (0, 1).
        tile_size: Tile of the filter, px.
    """
    moving = _moving(sample)
    axes = [
        _places(sample.size[axis], sample.inner[axis], sample.inner[axis + 2], share, tile_size)
        for axis in (0, 1)
    ]
    boxes = [_box(sample, share, top, left) for top in axes[0] for left in axes[1]]
    outer, inner = max(boxes, key=lambda pair: (_sum(moving, *pair), -_distance(sample, *pair)))
    top = outer[0] + inner[0] - sample.inner[0]
    left = outer[1] + inner[1] - sample.inner[1]

    def scored(image: Tensor) -> Tensor:
        return image[..., top : top + inner[2], left : left + inner[3]]

    if isinstance(sample, Sample):
        return dataclasses.replace(
            sample,
            frame=sample.frame.crop(*outer),
            reference=scored(sample.reference),
            band=scored(sample.band),
            inner=inner,
        )
    return dataclasses.replace(
        sample,
        steps=tuple(tuple(frame.crop(*outer) for frame in step) for step in sample.steps),
        references=tuple(map(scored, sample.references)),
        bands=tuple(map(scored, sample.bands)),
        inner=inner,
    )


def _places(edge: int, first: int, scored: int, share: float, tile_size: int) -> list[int]:
    """Return where the filtered part may begin along one axis, so that all its scores are known."""
    offset = math.floor(share * first)
    least = first - offset
    most = min(first + scored - math.ceil(share * scored) - offset, edge - math.ceil(share * edge))
    least = min(least, most)
    return [*range(-(-least // tile_size) * tile_size, most + 1, tile_size)] or [
        (least + most) // 2
    ]


def _box(sample: AnySample, share: float, top: int, left: int) -> tuple[_Box, _Box]:
    """Return what is filtered, within the window, and what is scored, within that."""
    y, x, height, width = sample.inner
    size = [math.ceil(share * edge) for edge in (*sample.size, height, width)]
    return (top, left, size[0], size[1]), (
        math.floor(share * y),
        math.floor(share * x),
        size[2],
        size[3],
    )


def _moving(sample: AnySample) -> Tensor:
    """Return how often each filtered pixel moves, in [0, 1], (H, W)."""
    frames: Iterable[Frame] = (
        (sample.frame,) if isinstance(sample, Sample) else (step[0] for step in sample.steps)
    )
    moves = [frame.velocity[0].norm(dim=0) * sample.shutter.open > MOVING for frame in frames]
    return torch.stack(moves).double().mean(dim=0).cpu()


def _sum(moving: Tensor, outer: _Box, inner: _Box) -> float:
    top, left = outer[0] + inner[0], outer[1] + inner[1]
    return float(moving[top : top + inner[2], left : left + inner[3]].sum())


def _distance(sample: AnySample, outer: _Box, inner: _Box) -> float:
    """Return how far the scored part's middle is from that of the window's, px."""
    y = outer[0] + inner[0] + inner[2] / 2 - sample.inner[0] - sample.inner[2] / 2
    x = outer[1] + inner[1] + inner[3] / 2 - sample.inner[1] - sample.inner[3] / 2
    return math.hypot(y, x)
