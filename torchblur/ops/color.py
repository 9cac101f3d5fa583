"""Color: the sRGB transfer curve and luma."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["REC_601", "REC_709", "linear_to_srgb", "luma", "srgb_to_linear"]

REC_709 = (0.2126, 0.7152, 0.0722)
REC_601 = (0.299, 0.587, 0.114)


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Encode linear values with the sRGB curve: a line near black, a power above it.

    Args:
        linear: Linear values of any shape; those below 0 stay on the line, those above 1 follow
            the power.

    Differentiable: everywhere, with finite gradients.
    Reference: IEC 61966-2-1.
    """
    curve = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def srgb_to_linear(encoded: Tensor) -> Tensor:
    """Decode sRGB values to linear ones: the inverse of `linear_to_srgb`.

    Args:
        encoded: Encoded values of any shape.

    Differentiable: everywhere, with finite gradients.
    Reference: IEC 61966-2-1.
    """
    curve = ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, curve)


def luma(color: Tensor, weights: tuple[float, float, float] = REC_709) -> Tensor:
    """Return the weighted sum of red, green and blue.

    Args:
        color: (B, 3, H, W), in whichever encoding.
        weights: Weights of the three channels, with the sum 1.

    Returns:
        Luma, (B, 1, H, W).

    Differentiable: yes.
    """
    return (color * color.new_tensor(weights).view(1, 3, 1, 1)).sum(1, keepdim=True)
