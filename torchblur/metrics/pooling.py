"""One number for a map of errors, beside its mean."""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur.errors import FrameError

__all__ = ["weighted_median"]


def weighted_median(map: Tensor) -> Tensor:
    """Return the error below and above which half of the summed error lies, per image.

    Every pixel weighs as much as its own error, so pixels without error do not count, and an
    error that is large in few pixels shows.

    Args:
        map: Errors of at least 0 per pixel, (B, C, H, W), any unit, no NaN.

    Returns:
        The smallest error such that all errors up to it sum up to half of the total or more,
        (B,); 0 where there is no error.

    Differentiable: with respect to the chosen pixel.

    Raises:
        FrameError: if an error is below 0 or NaN.

    Reference: the weighted median of FLIP's own tool (Andersson et al. 2020), which Oberberger
        2022, figure 12, shows over time.

    Example:
        >>> weighted_median(torch.tensor([0.0, 0.1, 0.2, 0.3]).view(1, 1, 2, 2))
        tensor([0.2000])
    """
    values = map.flatten(1).sort(dim=1).values
    if not bool((values >= 0).all()):
        raise FrameError("`map` must hold errors of at least 0, got a negative one or NaN")
    sums = values.double().cumsum(dim=1)
    # A little below the half, so that rounding of float32 does not pass an error by.
    half = sums[:, -1:] * (0.5 - 1e-6)
    place = torch.searchsorted(sums, half).clamp_max(values.shape[1] - 1)
    return values.gather(1, place).squeeze(1)
