"""Which cases the tables of the benchmark need."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal, get_args

from pydantic import Field

from torchblur.errors import ConfigError, nearest_name
from torchblur.filters import get_filter, list_filters
from torchblur.params import Config
from torchblur.presets import load_preset
from tuning.bench.calls import has_taps, refuse_unknown
from tuning.bench.cases import Case, What

__all__ = ["TABLES", "BenchOptions", "TablePlan", "plan_tables", "unique_cases"]

TableName = Literal["filters", "taps", "sizes", "moving", "batch", "notes", "step"]
TABLES: tuple[TableName, ...] = get_args(TableName)

_TAPS = (19, 27, 35, 47)  # Guertin 2014, table 1
_MOVING = (0, 10, 50, 100)
_SWEPT = ("guertin2014", "notes2025")
_BY_AREA = (*_SWEPT, "oberberger2022")
_NOTES = (("full", "two"), ("full", "one"), ("half", "two"), ("half", "one"))
_SIZE = re.compile(r"(\d+)x(\d+)")

Size = tuple[int, int]


class BenchOptions(Config):
    """What to measure; empty tuples are the default selection."""

    filters: tuple[str, ...] = ()
    sizes: tuple[str, ...] = ()
    num_samples: tuple[int, ...] = ()
    what: tuple[What, ...] = ()
    only: tuple[str, ...] = ()
    engines: tuple[Literal["eager", "compiled"], ...] = ()
    device: str = "cpu"
    quick: bool = False
    full: bool = False
    targets: bool = False
    runs: int | None = Field(None, ge=1)
    threads: int | None = Field(None, ge=1)
    params: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True)
class TablePlan:
    """A table before it is measured."""

    name: str
    title: str
    cases: list[Case]


@dataclass(frozen=True)
class _Scale:
    """Sizes of everything, whole or for a quick look."""

    base: Size
    swept: Size
    sizes: tuple[Size, ...]
    batch: int
    batched: Size
    sets: int
    set_size: Size
    crops: int
    crop: int


_WHOLE = _Scale(
    base=(480, 270),
    swept=(1280, 720),
    sizes=((640, 360), (1280, 720), (1920, 1080)),
    batch=4,
    batched=(320, 180),
    sets=32,
    set_size=(128, 128),
    crops=8,
    crop=256,
)
_QUICK = _Scale(
    base=(160, 90),
    swept=(160, 90),
    sizes=((96, 54), (160, 90), (240, 135)),
    batch=2,
    batched=(96, 54),
    sets=4,
    set_size=(32, 32),
    crops=2,
    crop=64,
)
_UHD = (3840, 2160)


def plan_tables(options: BenchOptions) -> list[TablePlan]:
    """Return the tables that were asked for, with their cases.

    Raises:
        ConfigError: an unknown filter, table or size, or parameters that a filter does not have.
    """
    for name in options.only:
        if name not in TABLES:
            raise ConfigError(
                f"unknown table `{name}`{nearest_name(name, TABLES)}; tables: {', '.join(TABLES)} "
                "(--only)"
            )
    if "num_samples" in options.params:
        raise ConfigError("`num_samples` is an option of its own: --num-samples (--set)")
    if options.params and not options.filters:
        raise ConfigError("parameters belong to a filter: name it with --filter (--set)")
    refuse_unknown(options.filters, options.params)
    planner = _Planner(options)
    plans: list[TablePlan] = [getattr(planner, name)() for name in options.only or TABLES]
    return [plan for plan in plans if plan.cases]


def unique_cases(plans: list[TablePlan]) -> list[Case]:
    """Return all cases once, those of one process together."""
    cases = {case.key: case for plan in plans for case in plan.cases}
    processes = dict.fromkeys(case.process for case in cases.values())
    return [case for name in processes for case in cases.values() if case.process == name]


def size_of(text: str) -> Size:
    """Return width and height from "1280x720".

    Raises:
        ConfigError: it is no size.
    """
    match = _SIZE.fullmatch(text)
    if match is None or not (int(match[1]) and int(match[2])):
        raise ConfigError(f"`size` must be WIDTHxHEIGHT in px, such as 1280x720, got {text!r}")
    return int(match[1]), int(match[2])


class _Planner:
    """One method for each table."""

    def __init__(self, options: BenchOptions) -> None:
        self.options = options
        self.scale = _QUICK if options.quick else _WHOLE
        self.given = tuple(size_of(size) for size in options.sizes)
        self.num_samples = options.num_samples or (35,)

    def filters(self) -> TablePlan:
        sizes = self.given or (self.scale.base,)
        if self.options.full and not self.given:
            sizes = (*self.scale.sizes, _UHD)
        engines = self.options.engines or (("eager",) if self.options.quick else _ENGINES)
        cases = self._copies(sizes)
        for name in self.options.filters or tuple(list_filters()):
            for engine in engines:
                for size in sizes:
                    for case in self._cases(name, size, self.num_samples, engine):
                        cases += [case.but(what=w) for w in self._whats("forward", "backward")]
        return TablePlan("filters", "filters, everything moves", cases)

    def taps(self) -> TablePlan:
        taps = self.options.num_samples or _TAPS
        cases = [
            case.but(what=what)
            for name, engine in self._swept()
            for size in self.given or (self.scale.swept,)
            for what in self._whats("forward")
            for case in self._cases(name, size, taps, engine)
            if case.num_samples is not None
        ]
        return TablePlan("taps", "cost by the number of taps N", cases)

    def sizes(self) -> TablePlan:
        sizes = self.given or (*self.scale.sizes, *((_UHD,) if self.options.full else ()))
        cases = self._copies(sizes)
        for name, engine in self._swept():
            for what in self._whats("forward"):
                for size in sizes:
                    some = self._cases(name, size, self.num_samples[:1], engine)
                    cases += [case.but(what=what) for case in some]
        return TablePlan("sizes", "cost by the number of pixels", cases)

    def moving(self) -> TablePlan:
        cases = [
            case.but(what=what, moving=moving)
            for name, engine in self._swept(_BY_AREA)
            for size in self.given or (self.scale.swept,)
            for what in self._whats("forward")
            for case in self._cases(name, size, self.num_samples[:1], engine)
            for moving in _MOVING
        ]
        return TablePlan("moving", "cost by the share of the area that moves", cases)

    def batch(self) -> TablePlan:
        scale, cases = self.scale, []
        for name, engine in self._swept():
            for what in self._whats("forward"):
                frames = self._cases(
                    name, self._one(scale.batched), self.num_samples[:1], engine, batch=scale.batch
                )
                sets = self._cases(
                    name, self._one(scale.set_size), self.num_samples[:1], engine, sets=scale.sets
                )
                for case in (*frames, *sets):
                    cases += [case.but(what=what, apart=apart) for apart in (True, False)]
        return TablePlan("batch", "frames, and parameter sets of one frame, in one call", cases)

    def notes(self) -> TablePlan:
        if self.options.filters and "notes2025" not in self.options.filters:
            return TablePlan("notes", "", [])
        size = (self.given or (self.scale.swept,))[0]
        cases = [
            case.but(params=case.params | {"resolution": resolution, "directions": directions})
            for resolution, directions in _NOTES
            for case in self._cases("notes2025", size, (None,), self._engines()[0])
        ]
        return TablePlan("notes", "variants of the 2025 notes, with the text's taps", cases)

    def step(self) -> TablePlan:
        crop = self._one((self.scale.crop, self.scale.crop))
        taps = self.options.num_samples[:1] or (15,)
        engines = self.options.engines or (("eager",) if self.options.quick else _ENGINES)
        cases = [
            case.but(kind="step", what="parameters")
            for name in self.options.filters or ("guertin2014",)
            for engine in engines
            for case in self._cases(name, crop, taps, engine, batch=self.scale.crops)
        ]
        renders = Case(kind="render", device=self.options.device, width=crop[0], height=crop[1])
        cases.append(renders.but(engine=engines[-1]))
        return TablePlan("step", "one gradient step of a fit, FLIP loss", cases)

    # -- what the tables share ---------------------------------------------------------------------

    def _cases(
        self, name: str, size: Size, taps: tuple[int | None, ...], engine: str, **more: Any
    ) -> list[Case]:
        """Return a filter's cases for each number of taps; one if it has none."""
        numbers = taps if _kind_has_taps(name) else (None,)
        return [
            Case.model_validate(
                {
                    "filter": name,
                    "engine": engine,
                    "device": self.options.device,
                    "width": size[0],
                    "height": size[1],
                    "num_samples": number,
                    "params": self.options.params,
                    **more,
                }
            )
            for number in numbers
        ]

    def _copies(self, sizes: tuple[Size, ...]) -> list[Case]:
        return [
            Case(kind="copy", device=self.options.device, width=width, height=height)
            for width, height in sizes
        ]

    def _swept(self, default: tuple[str, ...] = _SWEPT) -> list[tuple[str, str]]:
        names = self.options.filters or default
        if self.options.full and not self.options.filters:
            names = tuple(list_filters())
        return [(name, engine) for name in names for engine in self._engines()]

    def _engines(self) -> tuple[str, ...]:
        if self.options.engines:
            return self.options.engines
        if self.options.full:
            return _ENGINES
        return ("eager",) if self.options.quick else ("compiled",)

    def _whats(self, *default: What) -> tuple[What, ...]:
        return self.options.what or default

    def _one(self, size: Size) -> Size:
        return self.given[0] if self.given else size


_ENGINES = ("eager", "compiled")


def _kind_has_taps(name: str) -> bool:
    if name in list_filters():
        return has_taps(get_filter(name))
    return has_taps(get_filter(load_preset(name).filter))
