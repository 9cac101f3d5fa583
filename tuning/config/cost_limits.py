"""What a configuration asks of the cost of a filter, checked before anything runs."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.params import choices, declared
from tuning.config.cost import cost_of
from tuning.config.methods import ParetoMethod

if TYPE_CHECKING:
    from tuning.config.fit import FilterSpec, FreeRange, TuneConfig

__all__ = ["check_costs"]

_TAKEN = ("ceiling", "default", "input", "line", "noise", "sharp", "start", "tuned")


def check_costs(config: TuneConfig, names: Sequence[Collection[str]], place: str = "") -> None:
    """Refuse a search for a front that cannot have one, and a cost that is not known.

    Args:
        config: A configuration whose filter and methods are checked.
        names: The parameters that each method fits.
        place: Name for messages.

    Raises:
        ConfigError: no cost of this filter; two such searches; a cost that is part of the
            objective, too; no free parameter that changes the cost; a preset's name that another
            image of the report has.
    """
    where = f"{place}: " if place else ""
    if config.objective.cost > 0:
        _require_cost(config.filter, f"{where}objective.cost")
    searches = [i for i, m in enumerate(config.methods) if isinstance(m, ParetoMethod)]
    for index in searches[1:]:
        raise ConfigError(
            "one `pareto` method is enough: its presets have their names from the budgets "
            f"({where}methods.{index}.kind)"
        )
    for index in searches:
        _check_search(config, index, names[index], where)


def _check_search(config: TuneConfig, index: int, names: Collection[str], where: str) -> None:
    method = config.methods[index]
    assert isinstance(method, ParetoMethod)
    _require_cost(config.filter, f"{where}methods.{index}.kind")
    if config.objective.cost > 0:
        raise ConfigError(
            "a `pareto` method has the cost as an objective of its own: leave `cost` out of the "
            f"sum, got {config.objective.cost:g} ({where}objective.cost)"
        )
    for name in method.budgets:
        if name in _TAKEN:
            raise ConfigError(
                f"`{name}` is the name of another image in the report; call the preset something "
                f"else ({where}methods.{index}.budgets.{name})"
            )
    if not any(_changes_cost(config.filter, name) for name in names):
        model = get_filter(config.filter.kind).config_class
        known = [n for n in declared(model) if _changes_cost(config.filter, n)]
        raise ConfigError(
            f"none of {', '.join(names)} changes what the filter costs, so there is no front; "
            f"free one that does: {', '.join(known)} ({where}methods.{index}.free)"
        )


def _require_cost(spec: FilterSpec, place: str) -> None:
    try:
        cost_of(spec.kind, spec.params)
    except ConfigError as error:
        raise ConfigError(f"{error} ({place})") from error


def _changes_cost(spec: FilterSpec, name: str) -> bool:
    costs = {
        cost_of(spec.kind, spec.params | {name: value}).total
        for value in _ends(spec.kind, name, spec.free)
    }
    return len(costs) > 1


def _ends(kind: str, name: str, free: Mapping[str, FreeRange]) -> tuple[Any, ...]:
    """Return the choices of a parameter, or the ends of its range; nothing if it is continuous."""
    model = get_filter(kind).config_class
    limits, spec = free.get(name), declared(model)[name]
    if limits is not None and limits.choices:
        return limits.choices
    if spec.low is None:
        return choices(model, name)
    if model.model_fields[name].annotation is not int:
        return ()
    low, high = spec.bounds
    if limits is not None:
        low = low if limits.low is None else limits.low
        high = high if limits.high is None else limits.high
    return math.ceil(low), math.floor(high)
