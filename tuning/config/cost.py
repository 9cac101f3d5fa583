"""What a filter costs per pixel, by its name: what searches for a cheaper one ask."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from torchblur.filters import BlurFilter, get_filter
from torchblur.filters.parts.base import FilterConfig
from torchblur.filters.parts.cost import Cost
from torchblur.params import build

__all__ = ["Cost", "cost_at", "cost_of"]


def cost_of(name: str, params: FilterConfig | Mapping[str, Any] | None = None) -> Cost:
    """Return what a filter costs.

    Args:
        name: Registered name of the filter.
        params: Its configuration, or the parameters that differ from its defaults.

    Raises:
        ConfigError: unknown filter or parameter, or a filter whose cost is not known.
    """
    kind = get_filter(name)
    if not isinstance(params, FilterConfig):
        params = build(kind.config_class, dict(params or {}), name)
    return kind.cost(params)


def cost_at(blur: BlurFilter, values: Mapping[str, Any]) -> Cost:
    """Return what a filter costs with other values of its parameters.

    Args:
        blur: The filter; its config has all other values.
        values: By name. Tensors are numbers of continuous parameters, which change no cost.
    """
    plain = {name: value for name, value in values.items() if not isinstance(value, Tensor)}
    return cost_of(blur.name, blur.config.model_dump() | plain)
