"""Arithmetic on 3-vectors held as three planes, so that a compiler keeps them in registers."""

from __future__ import annotations

from typing import TypeAlias

import torch
from torch import Tensor

__all__ = ["Vec", "add", "cross", "dot", "normalize", "scale", "select", "subtract"]

Vec: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""The x, y and z planes of N vectors: each of shape (N,), or 0-d for one vector."""


def add(a: Vec, b: Vec) -> Vec:
    """Return ``a + b``."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def subtract(a: Vec, b: Vec) -> Vec:
    """Return ``a - b``."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(a: Vec, factor: Tensor | float) -> Vec:
    """Return ``a`` times a number per vector."""
    return a[0] * factor, a[1] * factor, a[2] * factor


def dot(a: Vec, b: Vec) -> Tensor:
    """Return the inner products, (N,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec, b: Vec) -> Vec:
    """Return ``a x b``, right-handed."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def normalize(a: Vec) -> Vec:
    """Return the vectors at unit length; a zero vector is not allowed."""
    return scale(a, torch.rsqrt(dot(a, a)))


def select(mask: Tensor, a: Vec, b: Vec) -> Vec:
    """Return ``a`` where the mask holds, else ``b``."""
    return (
        torch.where(mask, a[0], b[0]),
        torch.where(mask, a[1], b[1]),
        torch.where(mask, a[2], b[2]),
    )
