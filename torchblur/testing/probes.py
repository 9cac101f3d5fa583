"""What the contract tests try out: other values of parameters, mirrored frames, a box blur."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.params import Param, choices, declared

__all__ = ["box_blur", "inside", "mirrored", "mirrored_frame", "numbers", "other_values"]


def numbers(filter_class: type[BlurFilter], *, discrete: bool = False) -> list[tuple[str, Param]]:
    """Return the declared numbers of a filter, with or without the integers."""
    return [
        (name, spec)
        for name, spec in declared(filter_class.config_class).items()
        if spec.low is not None and (discrete or spec.grad != "discrete")
    ]


def other_values(config: Any) -> list[tuple[str, Any]]:
    """Return, for each parameter, values that are not its default."""
    pairs: list[tuple[str, Any]] = []
    for name, spec in declared(config).items():
        default = config.model_fields[name].default
        if spec.low is None:
            pairs += [(name, c) for c in choices(config, name) if c != default]
        elif config.model_fields[name].annotation is int:
            pairs.append((name, max(default // 4, 1) if default else 4))
        else:
            pairs.append((name, round(float(inside(spec, default, 0.2)), 6)))
    return pairs


def inside(spec: Param, value: float, step: float = 0.05) -> Tensor:
    """Return a value some way from the given one, and from both ends of the range."""
    unit = spec.to_unit(torch.tensor(float(value), dtype=torch.float64))
    unit = unit + step if float(unit) < 0.5 else unit - step
    return spec.from_unit(unit.clamp(0.11, 0.89))


def box_blur(color: Tensor, length: float, shift: float) -> Tensor:
    """Average over a horizontal line of a length in px, moved by a shift: many linear lookups."""
    width = color.shape[-1]
    total = torch.zeros_like(color)
    steps = 120
    for i in range(steps):
        offset = shift + ((i + 0.5) / steps - 0.5) * length
        position = (torch.arange(width) - offset).clamp(0, width - 1)
        low = position.floor().long()
        high = (low + 1).clamp(max=width - 1)
        share = position - low
        total += color[..., low] * (1 - share) + color[..., high] * share
    return total / steps


def mirrored(plane: Tensor, kind: str) -> Tensor:
    """Return a plane turned over: "mirror_x", "mirror_y" or "transpose"."""
    if kind == "transpose":
        return plane.transpose(2, 3)
    return plane.flip(3 if kind == "mirror_x" else 2)


def mirrored_frame(frame: Frame, kind: str) -> Frame:
    """Return a frame turned over, its velocities with it."""
    turned = frame.map(lambda plane: mirrored(plane, kind))
    velocity = turned.velocity
    if kind == "transpose":
        return dataclasses.replace(turned, velocity=velocity.flip(1))
    sign = torch.tensor([-1.0, 1.0] if kind == "mirror_x" else [1.0, -1.0])
    return dataclasses.replace(turned, velocity=velocity * sign.view(1, 2, 1, 1))
