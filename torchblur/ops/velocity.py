"""Velocities: half spreads, lengths and directions, and their storage in eight bits."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchblur.errors import FrameError

__all__ = [
    "clamp_length",
    "direction",
    "half_velocity",
    "length",
    "quantize_gamma2",
    "quantize_linear",
    "quantize_uint8",
    "velocity_from_depth",
]

_STILL_PX = 1e-3
_UINT8_STEPS = 127


def length(vector: Tensor, epsilon: float = 1e-12) -> Tensor:
    """Return ``sqrt(x² + y² + ε)``, which has a gradient at zero.

    Args:
        vector: Two planes, (B, 2, H, W).
        epsilon: ε, in the square of the vector's unit.

    Returns:
        Lengths, (B, 1, H, W).

    Differentiable: everywhere.
    """
    return (vector.square().sum(1, keepdim=True) + epsilon).sqrt()


def direction(vector: Tensor) -> Tensor:
    """Return the unit vectors; a vector shorter than a thousandth of a pixel gives zero.

    Args:
        vector: Displacements in px, (B, 2, H, W).

    Differentiable: yes; zero gradient at vectors that count as zero.
    """
    size = length(vector)
    return torch.where(size < _STILL_PX, torch.zeros_like(vector), vector / size)


def clamp_length(vector: Tensor, longest: float | Tensor) -> Tensor:
    """Return the vectors, those that are longer than a length shortened to it.

    Args:
        vector: Displacements in px, (B, 2, H, W).
        longest: Length in px.

    Reference: Guertin 2014, section 5: the length is clamped, not each component.
    """
    return vector * (longest / length(vector)).clamp(max=1.0)


def half_velocity(
    velocity: Tensor, shutter: float | Tensor, longest: float | None = None
) -> Tensor:
    """Return the half spread ``V = shutter · velocity / 2``: the blur reaches V to both sides.

    Args:
        velocity: Displacement in px/frame, (B, 2, H, W).
        shutter: Open time in frames, in [0, 8].
        longest: Clamp to this length, px; None leaves the vectors as they are.

    Returns:
        Half spread in px, (B, 2, H, W).

    Differentiable: yes.
    Reference: McGuire 2012, section 3.1 (V). We differ: no floor of half a pixel here; the
        weights floor the length instead, so that a still pixel keeps the vector 0.
    """
    half = velocity * (shutter * 0.5)
    return half if longest is None else clamp_length(half, longest)


class _RoundThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return value.round()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return grad


class _StandIn(torch.autograd.Function):
    """Another value in the place of one, with its gradient."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, other: Tensor) -> Tensor:
        return other.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad, None


def quantize_uint8(vector: Tensor, largest: float) -> Tensor:
    """Return the vectors as they come back from storage in eight bits per component.

    Args:
        vector: Displacements with components in [-largest, largest] px, (B, 2, H, W).
        largest: The component that the greatest code stands for, px.

    Returns:
        The nearest of the 255 values that can be stored, same shape.

    Differentiable: straight through, the gradient of the identity.
    Reference: Guertin 2014, section 5. We differ: 0 has a code of its own (127), as a still pixel
        would otherwise move by half a step.
    """
    scale = _UINT8_STEPS / largest
    rounded: Tensor = _RoundThrough.apply(vector * scale)  # type: ignore[no-untyped-call]
    return rounded.clamp(-_UINT8_STEPS, _UINT8_STEPS) / scale


def quantize_gamma2(vector: Tensor, largest: float) -> Tensor:
    """Return the vectors as they come back from eight bits per component with a gamma of 2.

    The code is ``sgn(v) · √|v|``, so that slow vectors keep more of their precision.

    Args:
        vector: Displacements with components in [-largest, largest] px, (B, 2, H, W).
        largest: The component that the greatest code stands for, px.

    Returns:
        The nearest (in code) of the 255 values that can be stored, same shape.

    Differentiable: straight through, the gradient of the identity.
    Reference: Sousa 2013. We differ: symmetric codes around a 0 of its own, as in
        `quantize_uint8`.
    """
    exact = vector.detach()
    root = (exact.abs() / largest).sqrt().clamp(max=1.0)
    code = (root * _UINT8_STEPS).round() / _UINT8_STEPS
    stored: Tensor = _StandIn.apply(  # type: ignore[no-untyped-call]
        vector, exact.sign() * code.square() * largest
    )
    return stored


def quantize_linear(value: Tensor, largest: float | Tensor) -> Tensor:
    """Return values as they come back from storage in eight bits; what is larger is cut.

    Args:
        value: Values >= 0, any shape.
        largest: The value that the greatest code, 255, stands for.

    Returns:
        The nearest of the 256 values that can be stored.

    Differentiable: straight through in the values, the gradient of the identity.
    Reference: Sousa 2013 (length of the velocity, and depth).
    """
    code = ((value / largest).clamp(max=1.0) * 255).round()
    stored: Tensor = _StandIn.apply(  # type: ignore[no-untyped-call]
        value, (code / 255 * largest).detach()
    )
    return stored


def velocity_from_depth(
    depth: Tensor, view_projection: Tensor, previous_view_projection: Tensor
) -> Tensor:
    """Return the velocity that a moving camera gives a still world.

    Each pixel is taken to the world by the inverse of this frame's matrix and back to the screen
    by the last frame's.

    Args:
        depth: Device depth z/w that belongs to the matrices, (B, 1, H, W).
        view_projection: World to clip space of this frame, column vectors, (4, 4) or (B, 4, 4).
        previous_view_projection: The same of the frame before.

    Returns:
        Displacement from the last frame to this one in px, x right, y down, (B, 2, H, W).

    Differentiable: in depth and matrices.
    Reference: Rosado 2007. We differ: y points down, and the result is the full displacement in
        px, not half of it in clip space.
    Raises: FrameError if a matrix is not (4, 4) or (B, 4, 4).
    """
    for matrix in (view_projection, previous_view_projection):
        if matrix.shape[-2:] != (4, 4) or matrix.ndim not in (2, 3):
            raise FrameError(f"a matrix must be (4, 4) or (B, 4, 4), got {tuple(matrix.shape)}")
    batch, _, height, width = depth.shape
    x = (torch.arange(width, device=depth.device, dtype=depth.dtype) + 0.5) / width * 2 - 1
    y = 1 - (torch.arange(height, device=depth.device, dtype=depth.dtype) + 0.5) / height * 2
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    z = depth.reshape(batch, -1)
    xy = torch.stack((columns.flatten(), rows.flatten())).expand(batch, -1, -1)
    here = torch.cat((xy, z[:, None], torch.ones_like(z)[:, None]), 1)
    before = previous_view_projection @ torch.linalg.solve(view_projection, here)
    moved = here[:, :2] - before[:, :2] / before[:, 3:]
    scale = torch.tensor([width / 2, -height / 2], device=depth.device, dtype=depth.dtype)
    result: Tensor = (moved * scale[None, :, None]).reshape(batch, 2, height, width)
    return result
