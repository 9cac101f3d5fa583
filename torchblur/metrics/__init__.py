"""How far images are from their references: FLIP, PSNR, SSIM, over time, and where to measure.

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
from torchblur.metrics.temporal import flip_change_error, temporal_error, temporal_errors

__all__ = [
    "DEFAULT_PPD",
    "FlipReference",
    "border_band",
    "display_encode",
    "evaluate",
    "exposure_range",
    "flip_change_error",
    "flip_hdr",
    "flip_ldr",
    "masked_mean",
    "prepare_flip_hdr",
    "prepare_flip_ldr",
    "psnr",
    "ssim",
    "temporal_error",
    "temporal_errors",
]
