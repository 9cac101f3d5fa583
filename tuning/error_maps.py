"""Where a filter is wrong, before it is fitted."""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur.filters import BlurFilter, get_filter
from torchblur.metrics import flip_ldr
from tuning.data.blurring import arguments, blurred, blurred_sequence
from tuning.data.cases import AnyCase, Case

__all__ = ["error_map"]


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
