"""The figures that torchblur aims at, and which of them a machine reaches.

A target is a statement about a benchmark, never a test: tests do not look at clocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tuning.bench.cases import Case, Row, TargetRow, cost_of

__all__ = ["KNOWN", "Target", "judge_targets", "targets_for"]

KNOWN: tuple[tuple[str, float], ...] = (
    ("1280x720: prototype, eager, one lookup per layer", 16.0),
    ("1280x720: prototype, eager, packed lookup", 2.1),
    ("1280x720: prototype, compiled tap", 1.1),
    ("1280x720: hand-written fused C++ loop", 0.6),
    ("1920x1080: Blender 4.5, Vector Blur node, 32 samples", 10.5),
    ("1920x1080: hand-written fused C++ loop", 1.4),
)
"""CPU-seconds per frame of other programs like Guertin's filter, N = 35, two quiet cores."""

_OURS = "torchblur"
_FIRST = "prototype on two cores"
_SHRINK = 8  # a quick look: edges of the images are so much shorter

Value = Callable[[Mapping[str, Row]], float | None]


@dataclass(frozen=True, kw_only=True)
class Target:
    """One figure that is aimed at.

    Args:
        name: What it says.
        unit: Of the figure; "" for ratios.
        limit: Most, or least if `at_least`.
        cases: What must be measured for it.
        value: The figure from all rows, by the key of their case; None if it cannot be had.
        at_least: Whether larger is better.
        source: Where the limit is from.
        note: What the reader should know.
    """

    name: str
    unit: str
    limit: float
    cases: tuple[Case, ...]
    value: Value
    at_least: bool = False
    source: str = _OURS
    note: str = ""


def targets_for(device: str, *, quick: bool = False) -> list[Target]:
    """Return the targets of a device.

    Args:
        device: "cpu", "cuda", "cuda:1" …
        quick: With small images: only to see that everything works.
    """
    shrink = _SHRINK if quick else 1
    guertin = Case(
        filter="guertin2014",
        engine="compiled",
        device=device,
        width=1920 // shrink,
        height=1080 // shrink,
        num_samples=35,
    )
    own = _on_gpu(guertin, device) if device.startswith("cuda") else _on_cpu(guertin, shrink)
    return own + _ratios(guertin, shrink)


def judge_targets(
    targets: list[Target], measured: Mapping[str, Row], *, judged: bool = True
) -> list[TargetRow]:
    """Return value, limit and verdict of each target.

    Args:
        targets: What was aimed at.
        measured: All rows, by the key of their case.
        judged: Whether the values can be held against the limits.
    """
    return [_judge(target, measured, judged) for target in targets]


def _judge(target: Target, measured: Mapping[str, Row], judged: bool) -> TargetRow:
    rows = [measured[case.key] for case in target.cases if case.key in measured]
    value = target.value(measured)
    met = None
    if judged and value is not None:
        met = value >= target.limit if target.at_least else value <= target.limit
    reasons = [row.error for row in rows if row.error] + [
        f"{name}: {text}"
        for row in rows
        for name, text in row.checks.items()
        if not met and text not in ("no", "captured")
    ]
    return TargetRow(
        name=target.name,
        unit=target.unit,
        value=value,
        limit=target.limit,
        at_least=target.at_least,
        met=met,
        source=target.source,
        disturbed=any(row.disturbed for row in rows),
        note="; ".join(dict.fromkeys([*reasons, *([target.note] if target.note else [])])),
    )


# -- targets of one kind of device -----------------------------------------------------------------


def _on_cpu(guertin: Case, shrink: int) -> list[Target]:
    small = guertin.but(width=1280 // shrink, height=720 // shrink)
    eager = small.but(engine="eager")
    return [
        Target(
            name="guertin2014, 1920x1080, N = 35, everything moves",
            unit="CPU-s",
            limit=2.2,
            cases=(guertin,),
            value=_cost(guertin),
            note="Blender's node 10 to 11, a fused C++ loop 1.4",
        ),
        Target(
            name="the same, compiling, once",
            unit="s",
            limit=8.0,
            cases=(guertin,),
            value=lambda rows: _field(rows, guertin, "compile_s"),
            source=_FIRST,
        ),
        Target(
            name="guertin2014, 1280x720, N = 35, compiled",
            unit="CPU-s",
            limit=1.1,
            cases=(small,),
            value=_cost(small),
            source=_FIRST,
            note="a fused C++ loop 0.6",
        ),
        Target(
            name="guertin2014, 1280x720, N = 35, eager",
            unit="CPU-s",
            limit=2.1,
            cases=(eager,),
            value=_cost(eager),
            source=_FIRST,
        ),
    ]


def _on_gpu(guertin: Case, device: str) -> list[Target]:
    size = {"width": guertin.width, "height": guertin.height, "device": device}
    oberberger = Case(filter="oberberger2022", engine="compiled", **size)
    notes = Case(filter="notes2025", engine="compiled", **size).but(
        params={"resolution": "full", "directions": "two"}
    )
    limits = (
        ("guertin2014, 1920x1080, N = 35, everything moves", guertin, 0.5),
        ("oberberger2022, 1920x1080, all stages, everything moves", oberberger, 1.5),
        ("notes2025, 1920x1080, full resolution, two directions", notes, 0.3),
    )
    targets = []
    for name, case, limit in limits:
        shared = {"unit": "ms", "limit": limit, "cases": (case,), "source": "H100, H200"}
        targets += [
            Target(name=name, value=_device_ms(case), **shared),  # type: ignore[arg-type]
            Target(name=f"{case.filter}, as a CUDA graph", value=_graph_ms(case), **shared),  # type: ignore[arg-type]
            Target(
                name=f"{case.filter}, times it waits for the GPU: none (0) or some (1)",
                unit="",
                limit=0,
                cases=(case,),
                value=_waits(case),
            ),
        ]
    return targets


def _ratios(guertin: Case, shrink: int) -> list[Target]:
    some, still = guertin.but(moving=10), guertin.but(moving=0)
    backward, step = guertin.but(what="backward"), guertin.but(what="parameters")
    sets = guertin.but(width=128 // shrink, height=128 // shrink, sets=32)
    weights = sets.but(shared=("min_length",))
    small = backward.but(width=1280 // shrink, height=720 // shrink)
    few = small.but(num_samples=5)
    return [
        _ratio("10 % of the area moves, over all of it", 0.2, some, guertin),
        _ratio("nothing moves, over all of it", 0.03, still, guertin),
        _ratio("half-precision storage, over full", 1.0, guertin.but(storage="half"), guertin),
        _ratio("forward and backward of a fit (all parameters), over forward", 4.0, step, guertin),
        _ratio("the same, with the gradient of the color", 4.0, backward, guertin),
        Target(
            name="forward and backward, over forward: peak memory",
            unit="",
            limit=3.0,
            cases=(backward, guertin),
            value=_quotient(backward, guertin, "peak_mib"),
        ),
        Target(
            name="backward, 1280x720, N = 35 over N = 5: peak memory",
            unit="",
            limit=1.1,
            cases=(small, few),
            value=_quotient(small, few, "peak_mib"),
            note="memory must not grow with the taps",
        ),
        _sets("32 parameter sets of one 128x128 frame, all weights: 32 calls over one", weights),
        _sets("the same, min_length too, which moves the taps", sets),
    ]


def _sets(name: str, together: Case) -> Target:
    apart = together.but(apart=True)
    return Target(
        name=name,
        unit="",
        limit=3.0,
        at_least=True,
        cases=(apart, together),
        value=_quotient(apart, together),
    )


def _ratio(name: str, limit: float, over: Case, under: Case) -> Target:
    cases = (over, under)
    return Target(name=name, unit="", limit=limit, cases=cases, value=_quotient(over, under))


# -- figures from rows -----------------------------------------------------------------------------


def _cost(case: Case) -> Value:
    return lambda rows: cost_of(rows.get(case.key))


def _device_ms(case: Case) -> Value:
    return lambda rows: _field(rows, case, "device_ms")


def _graph_ms(case: Case) -> Value:
    return lambda rows: _field(rows, case, "graph_ms")


def _waits(case: Case) -> Value:
    def value(rows: Mapping[str, Row]) -> float | None:
        found = rows[case.key].checks.get("sync") if case.key in rows else None
        return None if found is None else float(found != "no")

    return value


def _quotient(over: Case, under: Case, field: str = "") -> Value:
    """Return the quotient of two rows: of their cost, or of one field."""

    def value(rows: Mapping[str, Row]) -> float | None:
        pair = [
            _field(rows, c, field) if field else cost_of(rows.get(c.key)) for c in (over, under)
        ]
        if pair[0] is None or not pair[1]:
            return None
        return pair[0] / pair[1]

    return value


def _field(rows: Mapping[str, Row], case: Case, field: str) -> float | None:
    row = rows.get(case.key)
    found: float | None = None if row is None else getattr(row, field)
    return found
