"""How far an image is from its reference: FLIP, PSNR, SSIM, and where to measure them.

All metrics take `(image, reference)` in this order, in batches, and are differentiable.
"""

from torchblur.metrics.evaluation import evaluate
from torchblur.metrics.flip import (
    DEFAULT_PPD,
    FlipReference,
    exposure_range,
    flip_hdr,
    flip_ldr,
    prepare_flip_hdr,
    prepare_flip_ldr,
)
from torchblur.metrics.images import display_encode
from torchblur.metrics.masks import border_band, masked_mean
from torchblur.metrics.psnr import psnr
from torchblur.metrics.ssim import ssim

__all__ = [
    "DEFAULT_PPD",
    "FlipReference",
    "border_band",
    "display_encode",
    "evaluate",
    "exposure_range",
    "flip_hdr",
    "flip_ldr",
    "masked_mean",
    "prepare_flip_hdr",
    "prepare_flip_ldr",
    "psnr",
    "ssim",
]
