"""What a race is told: problems, the methods that run on each of them, seeds; one YAML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from torchblur.errors import ConfigError, nearest_name
from torchblur.filters import get_filter
from torchblur.io import load_yaml
from torchblur.params import Config, build, declared
from tuning.config.data import DataSpec
from tuning.config.fit import FilterSpec, TuneConfig, resolve
from tuning.config.methods import GradientMethod, Method, smooth_by_default
from tuning.config.objective import ObjectiveSpec
from tuning.config.overrides import apply_overrides

__all__ = ["Entrant", "RaceConfig", "RaceProblem", "load_race_config"]


class RaceProblem(Config):
    """What is fitted to what: a fit's configuration without methods."""

    name: str = Field(min_length=1, description="short label, unique")
    filter: FilterSpec
    data: DataSpec
    objective: ObjectiveSpec = Field(default_factory=ObjectiveSpec)
    planted: dict[str, Any] | None = Field(
        None,
        min_length=1,
        description="values of free parameters with which the filter itself makes all references: "
        "a good method finds them again",
    )


class Entrant(Config):
    """One method, or several in a row; a gradient without `free` takes what is smooth."""

    name: str = Field(min_length=1, description="short label, unique")
    methods: tuple[Method, ...] = Field(min_length=1, description="as in a fit; run in this order")
    only: tuple[str, ...] | None = Field(
        None, min_length=1, description="names of problems; all if left out"
    )


class RaceConfig(Config):
    """One race: `torchblur race CONFIG`."""

    title: str = Field("Methods", description="heading")
    problems: tuple[RaceProblem, ...] = Field(min_length=1, description="what is fitted")
    entrants: tuple[Entrant, ...] = Field(min_length=1, description="who fits it")
    seeds: tuple[int, ...] = Field(
        (1, 2, 3, 4, 5), min_length=1, description="each entrant runs once with each"
    )
    tolerance: float = Field(
        0.02, gt=0, lt=1, description="a planted value counts as found within this share of range"
    )
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1 …")
    engine: str | None = Field(None, description="as in a fit; its default if left out")

    def entrants_of(self, problem: RaceProblem) -> tuple[Entrant, ...]:
        """Return who runs on a problem."""
        return tuple(e for e in self.entrants if e.only is None or problem.name in e.only)

    def fit(self, problem: RaceProblem, entrant: Entrant, seed: int = 0) -> TuneConfig:
        """Return the configuration of one fit, which is not yet resolved.

        Args:
            problem: What is fitted.
            entrant: Who fits it.
            seed: Of this fit; windows are the same for all.
        """
        specs = declared(get_filter(problem.filter.kind).config_class)
        methods = smooth_by_default(entrant.methods, problem.filter.free, specs)
        return _tune_config(self, problem, methods, seed)


def load_race_config(path: str | Path, overrides: Sequence[str] = ()) -> RaceConfig:
    """Read a race's configuration and check all of it.

    Args:
        path: A YAML file; paths in it are relative to it.
        overrides: "key.path=value", value in YAML: ``seeds=[1]``, ``entrants.0.methods.0.steps=9``.

    Returns:
        The configuration with absolute paths and without reference to a preset.

    Raises:
        ConfigError: a mistake in a problem or a method, two of one name, a problem without a
            hold-out, new scenes for a planted problem, a planted value that is not free or out of
            range; with file and key.
        FileFormatError: no such file.
    """
    path = Path(path)
    config = build(RaceConfig, apply_overrides(load_yaml(path), overrides), str(path))
    _check_names(config, str(path))
    problems = []
    for index, problem in enumerate(config.problems):
        where = f"{path}: problems.{index}"
        base = resolve(_tune_config(config, problem, [{"kind": "blackbox"}]), where, path.parent)
        resolved = problem.model_copy(update={"filter": base.filter, "data": base.data})
        _check_problem(resolved, where)
        if not config.entrants_of(resolved):
            raise ConfigError(f"{problem.name!r} has no entrant ({where})")
        for entrant in config.entrants_of(resolved):
            resolve(config.fit(resolved, entrant), f"{where} for {entrant.name!r}")
            if resolved.planted is not None:
                _check_unplanted(entrant, where)
        problems.append(resolved)
    return config.model_copy(update={"problems": tuple(problems)})


def _tune_config(
    config: RaceConfig, problem: RaceProblem, methods: Sequence[Mapping[str, Any]], seed: int = 0
) -> TuneConfig:
    engine = {} if config.engine is None else {"engine": config.engine}
    data = {
        "filter": problem.filter.model_dump(),
        "data": problem.data.model_dump(),
        "objective": problem.objective.model_dump(),
        "methods": list(methods),
        "seed": seed,
        "device": config.device,
    }
    return build(TuneConfig, data | engine, problem.name)


def _check_names(config: RaceConfig, place: str) -> None:
    for key, items in (("problems", config.problems), ("entrants", config.entrants)):
        names = [item.name for item in items]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise ConfigError(f"two {key} are called {name!r} ({place}: {key}.{index}.name)")
    if len(set(config.seeds)) < len(config.seeds):
        raise ConfigError(f"`seeds` has one twice: {list(config.seeds)} ({place}: seeds)")
    known = [problem.name for problem in config.problems]
    for index, entrant in enumerate(config.entrants):
        for name in entrant.only or ():
            if name not in known:
                raise ConfigError(
                    f"no problem is called {name!r}{nearest_name(name, known)} "
                    f"({place}: entrants.{index}.only)"
                )


def _check_unplanted(entrant: Entrant, where: str) -> None:
    for method in entrant.methods:
        if isinstance(method, GradientMethod) and method.refresh is not None:
            raise ConfigError(
                f"`refresh` of {entrant.name!r} renders references, and those of a planted problem "
                f"are made by the filter: name its problems in `only` ({where}.planted)"
            )


def _check_problem(problem: RaceProblem, where: str) -> None:
    if not problem.data.holdout:
        raise ConfigError(f"a race is judged on a hold-out, and there is none ({where}.data)")
    for name, value in (problem.planted or {}).items():
        limits = problem.filter.free.get(name)
        if limits is None:
            hint = nearest_name(name, problem.filter.free)
            raise ConfigError(f"`{name}` is planted and not free{hint} ({where}.planted)")
        build(get_filter(problem.filter.kind).config_class, {name: value}, f"{where}.planted")
        is_outside = (limits.low is not None and value < limits.low) or (
            limits.high is not None and value > limits.high
        )
        if is_outside or (limits.choices is not None and value not in limits.choices):
            raise ConfigError(
                f"`{name}` is planted at {value}, where the fit cannot find it: {limits!r} "
                f"({where}.planted)"
            )
