"""Structural similarity as a map."""

from __future__ import annotations

import kornia.metrics
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.metrics.images import check_pair, display_encode

__all__ = ["ssim"]

_WINDOW = 11
_SMALLEST = _WINDOW // 2 + 1


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Return the structural similarity of each pixel's neighborhood.

    **Works on display values**: both images are clipped to [0, 1] and sRGB-encoded first, as SSIM
    was made for encoded images and is reported on them. On linear radiance it would hardly see
    the dark parts. Gaussian window of 11 px with sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1;
    the mean of the three channels.

    Args:
        image: Scene-linear radiance to judge, (B, 3, H, W), H and W at least 6 px.
        reference: Scene-linear radiance, (B, 3, H, W) or (1, 3, H, W).

    Returns:
        Similarity in [-1, 1], 1 where equal, shape (B, 1, H, W).

    Differentiable: yes; zero gradient where a radiance is clipped.
    Border: reflect.
    Reference: Wang et al. 2004, through `kornia.metrics.ssim`. We differ: per pixel up to the
        border; the paper leaves a margin of 5 px out of the mean.

    Raises:
        FrameError: images that cannot be compared, or smaller than 6 px.
    """
    check_pair(image, reference)
    if min(image.shape[2:]) < _SMALLEST:
        raise FrameError(
            f"SSIM needs images of at least {_SMALLEST}x{_SMALLEST} px for its window of "
            f"{_WINDOW}, got {image.shape[3]}x{image.shape[2]}"
        )
    shown, wanted = display_encode(image), display_encode(reference).expand_as(image)
    # eps=0: the constants keep the denominator above 0, and equal images score exactly 1.
    similarity: Tensor = kornia.metrics.ssim(shown, wanted, _WINDOW, eps=0.0)
    return similarity.mean(dim=1, keepdim=True)
