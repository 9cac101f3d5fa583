"""What a fit evaluates: full frames and sequences, or windows where it moves or goes wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.filters import BlurFilter, get_filter
from torchblur.filters.parts.reach import ReachingBlur
from torchblur.frame import Frame, Shutter
from torchblur.metrics import flip_ldr
from tuning.config.data import Crops
from tuning.data.blurring import arguments, blurred, blurred_sequence
from tuning.data.cases import AnyCase, Case
from tuning.data.framing import MOVING

__all__ = ["AnySample", "Sample", "SequenceSample", "error_map", "make_samples", "window_weights"]

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
        weight: How much it counts in the mean over windows; on average 1.
        item: Key of the data's item that it comes from.
        origin: As in `Case`.
    """

    frame: Frame
    reference: Tensor
    band: Tensor
    inner: tuple[int, int, int, int]
    shutter: Shutter
    weight: float = 1.0
    item: str = ""
    origin: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of what is filtered, px."""
        return self.frame.size

    @property
    def device(self) -> torch.device:
        """Where it lies."""
        return self.frame.device


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceSample:
    """A window of a sequence, the same in all of its frames.

    Args:
        steps: The window with its context: for each time step one frame, a batch of 1, or several
            of the same pixels.
        cuts: Positions of frames that begin a new shot.
        warm_up: So many frames at the start are not scored.
        references: The scored part of each reference, (1, 3, h, w).
        bands: The scored part of each band, (1, 1, h, w).
        inner: Top, left, height and width of the scored part within the window, px.
        shutter: The shutter of the references.
        weight: How much it counts in the mean over windows; on average 1.
        item: Key of the data's item that it comes from.
        origin: As in `Case`.
    """

    steps: tuple[tuple[Frame, ...], ...]
    cuts: tuple[int, ...]
    warm_up: int
    references: tuple[Tensor, ...]
    bands: tuple[Tensor, ...]
    inner: tuple[int, int, int, int]
    shutter: Shutter
    weight: float = 1.0
    item: str = ""
    origin: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of what is filtered, px."""
        return self.steps[0][0].size

    @property
    def device(self) -> torch.device:
        """Where it lies."""
        return self.steps[0][0].device


AnySample = Sample | SequenceSample


def make_samples(
    cases: Sequence[AnyCase],
    crops: Crops | None,
    *,
    tile_size: int,
    seed: int,
    blur: BlurFilter | None = None,
) -> list[AnySample]:
    """Return what a fit evaluates: the full frames, or windows of them.

    Windows are drawn without repetition where something moves, or where the filter is wrong at
    the start of the fit: the chance of a place is its number of moving pixels, or its FLIP.
    A window is filtered with context around it, so that the filter's reach does not end at its
    edge, and only the inner part is scored. Its origin is a multiple of the tile, so that tiles
    lie as in the full frame. A window of a sequence is the same in all of its frames.

    Args:
        cases: The frames and sequences.
        crops: Windows, or None for full frames.
        tile_size: Tile of the filter, px.
        seed: Of the places.
        blur: The filter that is fitted, with its start values: it decides which frames of a
            sequence it takes, see `SequenceCase.steps`, where its error is, and, if it reaches as
            far as the frame moves, how wide the context is. Without one the error is that of a
            blur along the pixel's own velocity.
    """
    generator = torch.Generator().manual_seed(seed)
    places = [_places(case, crops, generator, blur) for case in cases]
    weights = window_weights(cases, [len(some) for some in places])
    samples = []
    for case, some, weight in zip(cases, places, weights, strict=True):
        context = _context(case, crops, tile_size, blur)
        for place in some:
            box = _box(case.size, place, crops, tile_size, context)
            samples.append(_cut_out(case, box, blur, weight * place.weight))
    return samples


@dataclass(frozen=True)
class _Place:
    """Top left corner of a window's scored part, px, and its weight among those of its case."""

    top: int
    left: int
    weight: float = 1.0


@dataclass(frozen=True)
class _Box:
    """A window: what is filtered, and where the scored part lies within it; (y, x, h, w), px."""

    outer: tuple[int, int, int, int]
    inner: tuple[int, int, int, int]

    def scored(self, image: Tensor) -> Tensor:
        top, left = self.outer[0] + self.inner[0], self.outer[1] + self.inner[1]
        return image[..., top : top + self.inner[2], left : left + self.inner[3]]

    def filtered(self, frame: Frame) -> Frame:
        return frame if frame.size == self.outer[2:] else frame.crop(*self.outer)


def _cut_out(case: AnyCase, box: _Box, blur: BlurFilter | None, weight: float) -> AnySample:
    if isinstance(case, Case):
        return Sample(
            frame=box.filtered(case.frame),
            reference=box.scored(case.reference),
            band=box.scored(case.band),
            inner=box.inner,
            shutter=case.shutter,
            weight=weight,
            item=case.item,
            origin=case.origin,
        )
    return SequenceSample(
        steps=tuple(tuple(box.filtered(f) for f in step) for step in case.steps(blur)),
        cuts=case.cuts,
        warm_up=case.warm_up,
        references=tuple(box.scored(reference) for reference in case.references),
        bands=tuple(box.scored(band) for band in case.bands),
        inner=box.inner,
        shutter=case.shutter,
        weight=weight,
        item=case.item,
        origin=case.origin,
    )


def _moving(case: AnyCase) -> Tensor:
    """Return how often each pixel moves, in [0, 1], (1, 1, H, W)."""
    frames = [case.frame] if isinstance(case, Case) else list(case.sharp or case.samples[0])
    moves = [f.velocity.norm(dim=1, keepdim=True) * case.shutter.open > MOVING for f in frames]
    return torch.stack([m.to(device="cpu", dtype=torch.float64) for m in moves]).mean(dim=0)


def _places(
    case: AnyCase, crops: Crops | None, generator: torch.Generator, blur: BlurFilter | None
) -> list[_Place]:
    """Draw windows, without repetition, by how much moves or how much is wrong in them."""
    if crops is None:
        return [_Place(0, 0)]
    height, width = (min(crops.size, edge) for edge in case.size)
    stride = max(1, crops.size // _CANDIDATE_STEPS)
    map = _moving(case) if crops.choose == "motion" else error_map(case, blur)
    share = F.avg_pool2d(map, (height, width), stride=stride)[0, 0]
    if not bool((share > 0).any()):
        share = torch.ones_like(share)
    count = min(crops.per_frame, int((share > 0).sum()))
    chosen = torch.multinomial(share.flatten(), count, generator=generator)
    inverse = 1 / share.flatten()[chosen] if crops.unbiased else torch.ones(count)
    weights = (inverse / inverse.mean()).tolist()
    columns = share.shape[1]
    return [
        _Place(int(i) // columns * stride, int(i) % columns * stride, weight)
        for i, weight in zip(chosen, weights, strict=True)
    ]


def _context(case: AnyCase, crops: Crops | None, tile_size: int, blur: BlurFilter | None) -> int:
    """Return how many px around a window are filtered and not scored."""
    if crops is None:
        return 0
    if crops.context is not None:
        return crops.context
    if not isinstance(blur, ReachingBlur) or getattr(blur.config, "reach", "tile") == "tile":
        return 2 * tile_size
    given = {"shutter": case.shutter.open, "shutter_position": case.shutter.position}
    cuts = [blur.cut(frame, **given) for step in case.steps(blur) for frame in step]
    reach = max(min(cut.longest, cut.reach) for cut in cuts)
    # Taps of a shutter that is not centered lie on one side, twice as far from the pixel.
    return math.ceil(reach * (1 + abs(case.shutter.center))) + tile_size


def _box(
    size: tuple[int, int], place: _Place, crops: Crops | None, tile_size: int, context: int
) -> _Box:
    if crops is None:
        return _Box((0, 0, *size), (0, 0, *size))
    top, left = place.top, place.left
    height, width = (min(crops.size, edge) for edge in size)
    outer_top, outer_height = _outer(top, height, size[0], context, tile_size)
    outer_left, outer_width = _outer(left, width, size[1], context, tile_size)
    return _Box(
        (outer_top, outer_left, outer_height, outer_width),
        (top - outer_top, left - outer_left, height, width),
    )


def _outer(start: int, length: int, edge: int, context: int, tile_size: int) -> tuple[int, int]:
    """Return first pixel and length of a window with context along one axis."""
    wanted = math.ceil((length + 2 * context) / tile_size + 1) * tile_size
    if wanted >= edge:
        return 0, edge
    first = max(0, start - context) // tile_size * tile_size
    return min(first, edge - wanted), wanted


def window_weights(cases: Sequence[AnyCase], counts: Sequence[int]) -> list[float]:
    """Return the weight of each window of each case; over all windows their mean is 1.

    An item of the data counts by its weight, however many frames and windows it has, and each of
    its windows by the same share of it. Without any weights all windows count alike.

    Args:
        cases: The training frames and sequences; an item without a weight has 1 beside items that
            have one.
        counts: Number of windows of each case.
    """
    if all(case.weight is None for case in cases):
        return [1.0] * len(cases)
    shares: dict[str, float] = {}
    windows: dict[str, int] = {}
    for case, count in zip(cases, counts, strict=True):
        shares[case.item] = 1.0 if case.weight is None else case.weight
        windows[case.item] = windows.get(case.item, 0) + count
    scale = sum(windows.values()) / sum(shares.values())
    return [scale * shares[case.item] / windows[case.item] for case in cases]


@torch.no_grad()
def error_map(case: AnyCase, blur: BlurFilter | None = None) -> Tensor:
    """Return the FLIP of a filter's output against the reference, (1, 1, H, W), float64, CPU.

    A pixel that is not finite has error 1, the greatest. Of a sequence it is the mean over the
    frames that are scored.

    Args:
        case: The frame, or the sequence.
        blur: The filter with its values; a blur along the pixel's own velocity if left out.

    Differentiable: no.
    Reference: Andersson et al. 2020 (FLIP).
    """
    blur = get_filter("line")() if blur is None else blur
    if isinstance(case, Case):
        image = blurred(blur, case.frame, case.shutter.open, case.shutter.position, {})
        maps = [_flip(image, case.reference)]
    else:
        given = arguments(
            case.shutter.open, case.shutter.position, {}, (), case.references[0].device
        )
        images = blurred_sequence(blur, case.steps(blur), case.cuts, given)
        pairs = list(zip(images, case.references, strict=True))[case.warm_up :]
        maps = [_flip(image, reference) for image, reference in pairs]
    return torch.stack(maps).mean(dim=0)


def _flip(image: Tensor, reference: Tensor) -> Tensor:
    finite = torch.isfinite(image).all(dim=1, keepdim=True)
    map = flip_ldr(torch.where(finite, image, 0.0), reference)
    return torch.where(finite, map, 1.0).to(device="cpu", dtype=torch.float64)
