"""Peak signal-to-noise ratio, per image."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.metrics.images import check_pair
from torchblur.metrics.masks import masked_mean

__all__ = ["psnr"]


def psnr(
    image: Tensor, reference: Tensor, *, mask: Tensor | None = None, peak: float = 1.0
) -> Tensor:
    """Return the peak signal-to-noise ratio of each image in dB.

    ``10 log10(peak² / mean((image - reference)²))``, with the mean over the pixels and channels of
    one image; a batch is not pooled. It works on the numbers given: scene-linear color gives the
    PSNR in linear space. For the PSNR of what a display shows, give `display_encode` of both.

    Args:
        image: Image to judge, (B, C, H, W), any range.
        reference: What it should be, (B, C, H, W) or (1, C, H, W).
        mask: Pixels that count, bool or weights >= 0, (B, 1, H, W) or (1, 1, H, W); all if None.
        peak: Greatest value of a perfect image, above 0, in the unit of the images.

    Returns:
        PSNR in dB, (B,): +inf for equal images, NaN where the mask is empty.

    Differentiable: yes; zero gradient at equality and for an empty mask.

    Raises:
        FrameError: images that cannot be compared, a mask of another size, or a bad `peak`.

    Example:
        >>> psnr(torch.full((1, 3, 4, 4), 0.1), torch.zeros(1, 3, 4, 4))
        tensor([20.])
    """
    check_pair(image, reference, channels=None)
    if not (math.isfinite(peak) and peak > 0):
        raise FrameError(f"`peak` must be above 0, got {peak}")
    return decibels(masked_mean((image - reference) ** 2, mask), peak)


def decibels(mean_square: Tensor, peak: float = 1.0) -> Tensor:
    """Return the PSNR of a mean squared error, any shape: +inf at 0, with zero gradient there."""
    equal = mean_square == 0
    ratio = torch.where(equal, 1.0, mean_square) / peak**2
    return torch.where(equal, math.inf, -10 * torch.log10(ratio))
