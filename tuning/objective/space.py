"""The free parameters as a unit cube, the one space in which both kinds of fit work."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import get_filter
from torchblur.params import Param, choices, declared
from tuning.config.fit import FilterSpec

__all__ = ["FreeParameter", "Space", "make_space"]

_DIGITS = 6


@dataclass(frozen=True)
class FreeParameter:
    """One free parameter.

    Args:
        name: Its name in the filter's config.
        spec: Its declaration, with the range narrowed as the configuration says.
        is_integer: Whole numbers only.
        choices: Values to choose from, or empty for a number.
        start: Value before the fit, within the range.
        default: The filter's own default (the paper's).
    """

    name: str
    spec: Param
    is_integer: bool
    choices: tuple[Any, ...]
    start: Any
    default: Any

    @property
    def is_continuous(self) -> bool:
        """Whether it is a float with a range."""
        return not self.choices and not self.is_integer

    def rounded(self, value: Any) -> Any:
        """Return a value as it is written to a preset: six digits, never outside the range."""
        if not self.is_continuous:
            return value
        low, high = self.spec.bounds
        return min(max(float(f"{float(value):.{_DIGITS}g}"), low), high)


class Space:
    """The free parameters of a method, in order.

    Args:
        parameters: The parameters.
    """

    def __init__(self, parameters: tuple[FreeParameter, ...]) -> None:
        self.parameters = parameters

    @property
    def names(self) -> tuple[str, ...]:
        """Names, in order."""
        return tuple(p.name for p in self.parameters)

    def subset(self, names: tuple[str, ...]) -> Space:
        """Return the space of some of the parameters, in the order of this one."""
        return Space(tuple(p for p in self.parameters if p.name in names))

    def continuous(self) -> Space:
        """Return the space of the floats alone."""
        return Space(tuple(p for p in self.parameters if p.is_continuous))

    def start(self) -> dict[str, Any]:
        """Return the values before the fit."""
        return {p.name: p.start for p in self.parameters}

    def rounded(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values of these parameters as a preset has them."""
        return {p.name: p.rounded(values[p.name]) for p in self.parameters}

    def to_unit(self, values: Mapping[str, Any]) -> Tensor:
        """Return the point of the unit cube, (P,), float64; numbers only.

        Args:
            values: A number for each parameter.
        """
        numbers = [
            torch.tensor(float(values[p.name]), dtype=torch.float64) for p in self.parameters
        ]
        pairs = zip(self.parameters, numbers, strict=True)
        return torch.stack([p.spec.to_unit(n).clamp(0, 1) for p, n in pairs])

    def from_unit(self, unit: Tensor) -> dict[str, Tensor]:
        """Return the values at points of the unit cube; numbers only.

        Args:
            unit: Points, (K, P).

        Returns:
            (K,) for each parameter, within its range.

        Differentiable: yes.
        """
        columns = zip(self.parameters, unit.unbind(dim=-1), strict=True)
        return {p.name: p.spec.from_unit(column) for p, column in columns}


def make_space(spec: FilterSpec) -> Space:
    """Return the space of all free parameters of a configuration.

    Args:
        spec: A checked filter specification.
    """
    model = get_filter(spec.kind).config_class
    specs = declared(model)
    parameters = []
    for name, limits in spec.free.items():
        default = model.model_fields[name].default
        start = spec.params.get(name, default)
        options = limits.choices or (choices(model, name) if specs[name].low is None else ())
        narrowed = specs[name]
        if not options:
            low, high = narrowed.bounds
            low = low if limits.low is None else limits.low
            high = high if limits.high is None else limits.high
            narrowed = dataclasses.replace(narrowed, low=low, high=high)
            start = min(max(start, _whole(low, start)), _whole(high, start))
        elif start not in options:
            start = options[0]
        is_integer = model.model_fields[name].annotation is int
        parameters.append(FreeParameter(name, narrowed, is_integer, options, start, default))
    return Space(tuple(parameters))


def _whole(limit: float, like: Any) -> Any:
    """Return a limit in the type of a value; infinite limits do not occur."""
    return math.floor(limit) if isinstance(like, int) else float(limit)
