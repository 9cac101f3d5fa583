"""What is scored and shown: images of a filter with values, or the frames as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.filters.parts.reach import Cut, ReachingBlur
from tuning.data.blurring import arguments, blurred, blurred_sequence
from tuning.data.cases import AnyCase, Case, SequenceCase

__all__ = ["Variant", "cut_of", "render", "render_frames", "shown_image", "shown_reference"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Variant:
    """An image to be scored: a filter with values, or a frame as it is.

    Args:
        name: Its name in tables.
        blur: The filter; None leaves the frame as it is.
        values: Values over the filter's own.
        free: Names of the free parameters, whose values are not taken from the data.
        stream: Without a filter: the mean of a stream's samples, instead of the sharp frame.
    """

    name: str
    blur: BlurFilter | None = None
    values: Mapping[str, Any] | None = None
    free: tuple[str, ...] = ()
    stream: bool = False

    def fits(self, case: AnyCase) -> bool:
        """Return whether a case has what is to be shown."""
        if isinstance(case, Case):
            return not self.stream
        return self.blur is not None or self.stream or case.sharp is not None


@torch.no_grad()
def render(variant: Variant, case: Case) -> Tensor:
    """Return the image of a variant for a case, (1, 3, H, W), scene-linear."""
    if variant.blur is None:
        return case.frame.color
    return blurred(
        variant.blur,
        case.frame,
        case.shutter.open,
        case.shutter.position,
        variant.values or {},
        variant.free,
    )


@torch.no_grad()
def render_frames(variant: Variant, case: SequenceCase) -> list[Tensor]:
    """Return the images of a variant for a sequence, (1, 3, H, W) each, scene-linear."""
    blur = variant.blur
    if blur is None:
        if not variant.stream and case.sharp is not None:
            return [frame.color for frame in case.sharp]
        return [torch.stack([f.color for f in step]).mean(dim=0) for step in case.steps()]
    given = arguments(
        case.shutter.open,
        case.shutter.position,
        variant.values or {},
        variant.free,
        case.references[0].device,
    )
    return list(blurred_sequence(blur, case.steps(blur), case.cuts, given))


def shown_image(variant: Variant, case: AnyCase) -> Tensor:
    """Return what is shown of a variant, (1, 3, H, W): of a sequence one frame."""
    if isinstance(case, Case):
        return render(variant, case)
    return render_frames(variant, case)[case.middle]


def shown_reference(case: AnyCase) -> Tensor:
    """Return the reference of what is shown, (1, 3, H, W)."""
    return case.reference if isinstance(case, Case) else case.references[case.middle]


def cut_of(variant: Variant, case: AnyCase) -> Cut | None:
    """Return how much of a case moves farther than a variant blurs, or None if it has no limit.

    Of a sequence: the mean share, and the longest half spread.
    """
    blur = variant.blur
    if not isinstance(blur, ReachingBlur):
        return None
    frames = [frame for step in case.steps(blur) for frame in step]
    shutter, device = case.shutter, frames[0].device
    values = variant.values or {}
    given = arguments(shutter.open, shutter.position, values, variant.free, device)
    cuts = [blur.cut(frame, **given) for frame in frames]
    share = sum(cut.share for cut in cuts) / len(cuts)
    return Cut(share, max(cut.longest for cut in cuts), cuts[0].reach)
