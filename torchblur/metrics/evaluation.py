"""All image metrics of a batch in one call."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from torchblur.metrics.flip import FlipReference, flip_ldr
from torchblur.metrics.images import check_pair
from torchblur.metrics.masks import masked_mean
from torchblur.metrics.psnr import decibels
from torchblur.metrics.ssim import ssim

__all__ = ["evaluate"]


def evaluate(
    image: Tensor,
    reference: Tensor,
    *,
    masks: Mapping[str, Tensor] | None = None,
    prepared: FlipReference | None = None,
) -> dict[str, Tensor]:
    """Return FLIP, PSNR and SSIM of each image, over the whole image and over masks.

    "flip" is the mean of `flip_ldr` (less is better), "psnr" is in dB on the linear values with
    peak 1, "ssim" the mean of the map on display values. For each mask there are "flip_<mask>",
    "psnr_<mask>" and "ssim_<mask>", over its pixels alone; the filters of FLIP and SSIM still see
    the pixels around it.

    Args:
        image: Scene-linear radiance to judge, (B, 3, H, W), at least 6x6 px.
        reference: Scene-linear radiance, (B, 3, H, W) or (1, 3, H, W).
        masks: Pixels that count, by name: bool or weights >= 0, (B, 1, H, W) or (1, 1, H, W).
        prepared: The reference prepared for FLIP, to save its filtering or to take `flip_hdr`.

    Returns:
        Means by name, each (B,); NaN where a mask is empty, +inf as PSNR of equal images.

    Differentiable: yes, finite gradients also where values are NaN or inf.

    Raises:
        FrameError: images that cannot be compared or masks of another size.
    """
    check_pair(image, reference)
    flip = flip_ldr(image, reference) if prepared is None else prepared.error(image)
    similarity = ssim(image, reference)
    square = (image - reference) ** 2
    results: dict[str, Tensor] = {}
    for name, mask in ((None, None), *(masks or {}).items()):
        suffix = "" if name is None else f"_{name}"
        results[f"flip{suffix}"] = masked_mean(flip, mask)
        results[f"psnr{suffix}"] = decibels(masked_mean(square, mask))
        results[f"ssim{suffix}"] = masked_mean(similarity, mask)
    return results
