"""What a fit evaluates: full frames, or windows of them where something moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.frame import Frame, Shutter
from tuning.config import Crops
from tuning.data import Case

__all__ = ["Sample", "make_samples"]

_MOVING = 0.5  # px over the open shutter; less is not seen as blur
_CANDIDATE_STEPS = 8  # windows are placed on a grid of 1/8 of their size


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """A window of a case: what is filtered, and the part of it that is scored.

    Args:
        frame: The window with its context, a batch of 1.
        reference: The scored part of the reference, (1, 3, h, w).
        band: The scored part of the band, (1, 1, h, w).
        inner: Top, left, height and width of the scored part within the window, px.
        shutter: The shutter of the reference.
    """

    frame: Frame
    reference: Tensor
    band: Tensor
    inner: tuple[int, int, int, int]
    shutter: Shutter


def make_samples(
    cases: Sequence[Case], crops: Crops | None, *, tile_size: int, seed: int
) -> list[Sample]:
    """Return what a fit evaluates: the full frames, or windows of them.

    Windows are drawn where something moves: the chance of a place is its number of moving pixels.
    A window is filtered with context around it, so that the filter's reach does not end at its
    edge, and only the inner part is scored. Its origin is a multiple of the tile, so that tiles
    lie as in the full frame.

    Args:
        cases: The frames.
        crops: Windows, or None for full frames.
        tile_size: Tile of the filter, px.
        seed: Of the places.
    """
    if crops is None:
        return [_full(case) for case in cases]
    generator = torch.Generator().manual_seed(seed)
    return [
        _window(case, top, left, crops, tile_size)
        for case in cases
        for top, left in _places(case, crops, generator)
    ]


def _full(case: Case) -> Sample:
    return Sample(
        frame=case.frame,
        reference=case.reference,
        band=case.band,
        inner=(0, 0, *case.frame.size),
        shutter=case.shutter,
    )


def _places(case: Case, crops: Crops, generator: torch.Generator) -> list[tuple[int, int]]:
    """Draw top left corners, without repetition, where pixels move."""
    height, width = (min(crops.size, edge) for edge in case.frame.size)
    length = case.frame.velocity.norm(dim=1, keepdim=True) * case.shutter.open
    moving = (length > _MOVING).to(device="cpu", dtype=torch.float64)
    stride = max(1, crops.size // _CANDIDATE_STEPS)
    share = F.avg_pool2d(moving, (height, width), stride=stride)[0, 0]
    if not bool((share > 0).any()):
        share = torch.ones_like(share)
    count = min(crops.per_frame, int((share > 0).sum()))
    chosen = torch.multinomial(share.flatten(), count, generator=generator)
    columns = share.shape[1]
    return [(int(i) // columns * stride, int(i) % columns * stride) for i in chosen]


def _window(case: Case, top: int, left: int, crops: Crops, tile_size: int) -> Sample:
    height, width = (min(crops.size, edge) for edge in case.frame.size)
    context = 2 * tile_size if crops.context is None else crops.context
    rows, columns = case.frame.size
    outer_top, outer_height = _outer(top, height, rows, context, tile_size)
    outer_left, outer_width = _outer(left, width, columns, context, tile_size)
    inner = (top - outer_top, left - outer_left, height, width)
    scored = (..., slice(top, top + height), slice(left, left + width))
    return Sample(
        frame=case.frame.crop(outer_top, outer_left, outer_height, outer_width),
        reference=case.reference[scored],
        band=case.band[scored],
        inner=inner,
        shutter=case.shutter,
    )


def _outer(start: int, length: int, edge: int, context: int, tile_size: int) -> tuple[int, int]:
    """Return first pixel and length of a window with context along one axis."""
    wanted = math.ceil((length + 2 * context) / tile_size + 1) * tile_size
    if wanted >= edge:
        return 0, edge
    first = max(0, start - context) // tile_size * tile_size
    return min(first, edge - wanted), wanted
