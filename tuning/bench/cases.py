"""What the benchmark measures: one case is one call of a filter, one row is what it cost.

The models here are the schema of the JSON that `torchblur bench --json` writes
(`torchblur bench --json-schema` prints it).
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from torchblur.params import Config

__all__ = ["COST", "Case", "LinearFit", "Report", "Row", "Table", "TargetRow", "cost_of"]

Kind = Literal["blur", "copy", "step", "render"]
What = Literal["forward", "backward", "parameters"]

COST = "device time on a GPU, CPU-seconds on a CPU"
"""What ratios and fits are made of."""


class Case(Config):
    """One thing to measure; with defaults it is one frame through one filter."""

    kind: Kind = Field(
        "blur",
        description="blur: call a filter. copy: move as many bytes as the planes of the frame have "
        "(color, velocity, depth in; color out). step: one gradient step of a fit. render: what a "
        "new crop costs",
    )
    filter: str = Field("", description="registered name, or path of a preset")
    engine: Literal["eager", "compiled"] = "eager"
    device: str = "cpu"
    width: int = Field(640, ge=1, description="px")
    height: int = Field(360, ge=1, description="px")
    num_samples: int | None = Field(None, description="taps N; null: the filter's own number")
    what: What = Field(
        "forward",
        description="forward: no gradient. backward: forward, and backward to color and to all "
        "smooth parameters. parameters: forward, and backward to the smooth parameters",
    )
    moving: int = Field(
        100, ge=0, le=100, description="share of the area that moves, percent: a rectangle"
    )
    batch: int = Field(1, ge=1, description="frames")
    sets: int = Field(1, ge=1, description="parameter sets of one frame")
    shared: tuple[str, ...] = Field((), description="smooth parameters that all sets have alike")
    apart: bool = Field(False, description="one call for each frame or set, instead of one for all")
    storage: Literal["full", "half"] = Field("full", description="of what the taps look up")
    params: dict[str, Any] = Field(default_factory=dict, description="parameters of the filter")

    @property
    def key(self) -> str:
        """The case as text: equal for equal cases."""
        return self.model_dump_json()

    @property
    def pixels(self) -> int:
        """Pixels of one frame."""
        return self.width * self.height

    @property
    def process(self) -> tuple[str, ...]:
        """Cases with the same are measured in one process, and share what it compiled."""
        return (self.kind, self.filter, self.engine, self.device)

    def but(self, **changes: Any) -> Case:
        """Return the same case with some fields replaced."""
        return Case.model_validate(self.model_dump() | changes)

    @property
    def label(self) -> str:
        """The case in a few words, for progress and errors."""
        parts = [self.filter or self.kind, self.engine, f"{self.width}x{self.height}"]
        parts += [f"N={self.num_samples}"] if self.num_samples else []
        parts += [self.what] if self.kind == "blur" else []
        parts += [f"{self.moving} % moving"] if self.moving < 100 else []
        parts += [f"batch {self.batch}"] if self.batch > 1 else []
        parts += [f"{self.sets} sets"] if self.sets > 1 else []
        parts += ["half storage"] if self.storage == "half" else []
        return " ".join(parts + (["apart"] if self.apart else []))


class Row(Config):
    """What a case cost: medians over the runs after a warm-up. Null: not measured."""

    case: Case
    runs: int = Field(0, description="timed runs")
    wall_s: float | None = Field(None, description="wall time of one call, seconds")
    cpu_s: float | None = Field(None, description="CPU-seconds of one call, all threads")
    device_ms: float | None = Field(
        None, description="CUDA: between events before and after the call, milliseconds"
    )
    graph_ms: float | None = Field(
        None, description="CUDA: replay of the call captured as a CUDA graph, milliseconds"
    )
    spread: float | None = Field(
        None, description="(slowest - fastest) / median of the runs: how far to trust the median"
    )
    first_s: float | None = Field(
        None, description="wall time of the first call of its kind in a process: with compiling"
    )
    compile_s: float | None = Field(
        None, description="of that, what later calls do not take; null unless compiled"
    )
    peak_mib: float | None = Field(
        None, description="memory at its peak during the call, above what was there before, MiB"
    )
    parts: dict[str, float] = Field(
        default_factory=dict, description="seconds of the parts of a step: wall, with waiting"
    )
    ratios: dict[str, float] = Field(
        default_factory=dict,
        description=f"this over another row ({COST}): of_eager, of_copy, of_forward, of_whole "
        "(everything moves), of_apart, of_full_two (variants of notes2025); memory_of_forward: "
        "peak memory likewise",
    )
    others: float | None = Field(
        None, description="cores that other programs used meanwhile; the figure is marked if > 0.15"
    )
    waited: bool = Field(
        False, description="less CPU time than wall time: the process waited for a core"
    )
    checks: dict[str, str] = Field(
        default_factory=dict,
        description="CUDA: sync (no, or where the call waits for the device), graph (captured, or "
        "why not)",
    )
    error: str | None = Field(None, description="why there are no figures")

    @property
    def disturbed(self) -> bool:
        """Whether something else used the machine: the figures are inflated."""
        return self.waited or (self.others is not None and self.others > 0.15)


class LinearFit(Config):
    """A least-squares line through rows: cost = intercept + slope · x."""

    name: str = Field(description="whose rows")
    x: str = Field(description="what grows: N, Mpx, % moving")
    unit: str = Field("ms", description="of the cost")
    points: int
    intercept: float = Field(description="cost at x = 0")
    slope: float = Field(description="cost per unit of x")
    r2: float | None = Field(description="share of the variance that the line explains")
    residual: float | None = Field(
        description="root mean square of what the line misses, over the mean cost"
    )


class Table(Config):
    """Rows that belong together."""

    name: str
    title: str
    rows: list[Row]
    fits: list[LinearFit] = Field(default_factory=list)


class TargetRow(Config):
    """A figure that was aimed at."""

    name: str
    unit: str
    value: float | None = Field(description="measured; null: could not be")
    limit: float
    at_least: bool = Field(False, description="whether the value must reach the limit, not stay")
    met: bool | None = Field(description="null: not judged")
    source: str
    disturbed: bool = Field(False, description="whether something else used the machine")
    note: str = ""


class Report(Config):
    """Everything that one run of the benchmark found."""

    format: Literal["torchblur-bench"] = "torchblur-bench"
    version: int = 1
    started: str = Field(description="date and time, ISO 8601, UTC")
    complete: bool = Field(
        False, description="false while the benchmark runs, or if it was stopped"
    )
    machine: dict[str, Any] = Field(
        description="processor, cores, memory, gpu, torch, threads, python, system, commit"
    )
    settings: dict[str, Any] = Field(description="what was asked for")
    warnings: list[str] = Field(default_factory=list)
    tables: list[Table] = Field(default_factory=list)
    targets: list[TargetRow] = Field(default_factory=list)


def cost_of(row: Row | None) -> float | None:
    """Return what a row cost, seconds: device time on a GPU, CPU time on a CPU."""
    if row is None:
        return None
    return row.device_ms / 1000 if row.device_ms is not None else row.cpu_s
