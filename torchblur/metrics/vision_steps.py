"""Steps of FLIP with gradients of their own: fewer passes over the image than autograd takes.

Each is an exact function with its exact derivative, once differentiable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["cube_root_curve", "length", "mix", "power"]

_Matrix = Sequence[Sequence[float]]


class _Mix(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, planes: Tensor, matrix: _Matrix) -> Tensor:
        ctx.matrix = matrix
        return _mixed(planes, matrix)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _mixed(grad, list(zip(*ctx.matrix, strict=True))), None


def _mixed(planes: Tensor, matrix: _Matrix) -> Tensor:
    # Written out: as a matrix product or a convolution it would lose digits to TF32 on a GPU.
    x, y, z = planes.unbind(1)
    out = torch.empty_like(planes, memory_format=torch.contiguous_format)
    for row, (a, b, c) in zip(out.unbind(1), matrix, strict=True):
        torch.mul(x, a, out=row)
        row.add_(y, alpha=b).add_(z, alpha=c)
    return out


class _CubeRootCurve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, knee: float, slope: float, offset: float) -> Tensor:
        root = x.clamp_min(knee).pow_(1 / 3)
        is_root = x > knee
        ctx.save_for_backward(root, is_root)
        ctx.slope = slope
        return torch.where(is_root, root, x * slope + offset)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        root, is_root = ctx.saved_tensors
        steep = torch.square(root).mul_(3).reciprocal_()
        return torch.where(is_root, steep, ctx.slope).mul_(grad), None, None, None


class _Length(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vector: Tensor, floor: float) -> Tensor:
        x, y = vector.unbind(1)
        square = (x * x).addcmul_(y, y)
        result = square.sqrt().masked_fill_(square <= floor, 0.0).unsqueeze(1)
        ctx.save_for_backward(vector, result)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        vector, result = ctx.saved_tensors
        scale = (grad / result).masked_fill_(result == 0, 0.0)
        return vector * scale, None


class _Power(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, exponent: float, line: float) -> Tensor:
        factor = x.clamp_min(line).pow_(exponent - 1)
        ctx.save_for_backward(factor, x > line)
        ctx.exponent = exponent
        return x * factor

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor, is_curve = ctx.saved_tensors
        slope = torch.where(is_curve, ctx.exponent * factor, factor)
        return slope.mul_(grad), None, None


_mix: Callable[..., Tensor] = _Mix.apply
_curve: Callable[..., Tensor] = _CubeRootCurve.apply
_vector_length: Callable[..., Tensor] = _Length.apply
_raised: Callable[..., Tensor] = _Power.apply


def mix(planes: Tensor, matrix: _Matrix) -> Tensor:
    """Return a matrix times the three channels of an image, (B, 3, H, W)."""
    return _mix(planes, matrix)


def cube_root_curve(x: Tensor, knee: float, slope: float, offset: float) -> Tensor:
    """Return the cube root above the knee, and a straight line below it."""
    return _curve(x, knee, slope, offset)


def length(vector: Tensor, floor: float) -> Tensor:
    """Return the length over two channels, (B, 1, H, W); 0 with zero gradient next to zero.

    Args:
        vector: (B, 2, H, W).
        floor: Squared length up to which it is taken as zero.
    """
    return _vector_length(vector, floor)


def power(x: Tensor, exponent: float, line: float) -> Tensor:
    """Return x ** exponent for x >= 0, but a straight line from 0 to x = `line`."""
    return _raised(x, exponent, line)
