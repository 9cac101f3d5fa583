"""Where in a pixel its samples lie."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["spread_positions"]

_STEP_X, _STEP_Y = 0.7548776662466927, 0.5698402909980532  # R2 sequence: 1/p, 1/p², p³ = p + 1


def spread_positions(spp: int, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions that cover a pixel evenly: an R2 sequence, shifted per pixel.

    Args:
        spp: Samples per pixel.
        shift: Uniform random numbers per pixel, in [0, 1), float32, (2, N).

    Returns:
        x and y in the pixel, in [0, 1), float32, (spp, N) each.
    """
    index = torch.arange(spp, dtype=torch.float64, device=shift.device)[:, None]
    x = ((index * _STEP_X % 1).float() + shift[:1]) % 1
    y = ((index * _STEP_Y % 1).float() + shift[1:]) % 1
    return x, y
