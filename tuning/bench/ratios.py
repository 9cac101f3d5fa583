"""What the rows of a benchmark say about each other: ratios, and lines through them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from tuning.bench.cases import Case, LinearFit, Row, cost_of

__all__ = ["fits_of", "linear_fit", "with_ratios"]

_AXES: Mapping[str, tuple[str, Callable[[Case], float | None], dict[str, object]]] = {
    # name of the table: the axis, its value, and what makes its cases alike but for it
    "taps": ("N", lambda case: case.num_samples, {"num_samples": None}),
    "sizes": ("Mpx", lambda case: case.pixels / 1e6, {"width": 1, "height": 1}),
    "moving": ("% moving", lambda case: case.moving, {"moving": 0}),
}


def with_ratios(rows: Sequence[Row], measured: Mapping[str, Row]) -> list[Row]:
    """Return the rows with their ratios to others.

    Args:
        rows: Some rows.
        measured: All rows, by the key of their case.
    """
    return [row.model_copy(update={"ratios": _ratios(row, measured)}) for row in rows]


def _ratios(row: Row, measured: Mapping[str, Row]) -> dict[str, float]:
    case = row.case
    if case.kind not in ("blur", "step"):
        return {}
    others = {"of_eager": case.but(engine="eager"), "of_whole": case.but(moving=100)}
    if case.kind == "blur":
        others["of_forward"] = case.but(what="forward")
        others["of_apart"] = case.but(apart=True)
        if case.sets == 1:
            others["of_copy"] = Case(
                kind="copy",
                device=case.device,
                width=case.width,
                height=case.height,
                batch=case.batch,
            )
    if {"resolution", "directions"} <= case.params.keys():
        whole = case.params | {"resolution": "full", "directions": "two"}
        others["of_full_two"] = case.but(params=whole)
    found = {name: _over(cost_of(row), cost_of(measured.get(o.key))) for name, o in others.items()}
    if case.what != "forward" and "of_forward" in others:
        forward = measured.get(others["of_forward"].key)
        memory = None if forward is None else forward.peak_mib
        found["memory_of_forward"] = _over(row.peak_mib, memory)
    return {name: value for name, value in found.items() if value is not None}


def _over(value: float | None, other: float | None) -> float | None:
    if value is None or not other or other <= 0:
        return None
    return value / other


def linear_fit(name: str, x: str, points: Sequence[tuple[float, float]]) -> LinearFit | None:
    """Return the least-squares line through points, or None if there are fewer than two.

    Args:
        name: Whose points.
        x: What grows.
        points: (x, cost) each.
    """
    if len({position for position, _ in points}) < 2:
        return None
    xs, costs = np.array(points, dtype=np.float64).T
    design = np.stack((np.ones_like(xs), xs), axis=1)
    (intercept, slope), *_ = np.linalg.lstsq(design, costs, rcond=None)
    missed = costs - design @ (intercept, slope)
    total = float(((costs - costs.mean()) ** 2).sum())
    mean = float(costs.mean())
    exact = len(points) == 2  # a line through two points misses nothing and says nothing
    return LinearFit(
        name=name,
        x=x,
        points=len(points),
        intercept=float(intercept),
        slope=float(slope),
        r2=None if exact or total == 0 else 1 - float((missed**2).sum()) / total,
        residual=None if exact or mean == 0 else math.sqrt(float((missed**2).mean())) / mean,
    )


def fits_of(table: str, rows: Sequence[Row]) -> list[LinearFit]:
    """Return a line for each group of rows that differ only in what the table varies.

    Args:
        table: Name of the table.
        rows: Its rows.
    """
    if table not in _AXES:
        return []
    axis, value, same = _AXES[table]
    groups: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        cost, x = cost_of(row), value(row.case)
        if cost is not None and x is not None:
            alike = row.case.model_copy(update=same)
            groups.setdefault(_name(alike, table), []).append((x, 1000 * cost))
    fits = [linear_fit(name, axis, points) for name, points in groups.items()]
    return [fit for fit in fits if fit is not None]


def _name(case: Case, table: str) -> str:
    size = "" if table == "sizes" else f" {case.width}x{case.height}"
    taps = f" N={case.num_samples}" if case.num_samples else ""
    who = case.filter if case.kind == "blur" else case.kind
    how = f" {case.engine} {case.what}" if case.kind == "blur" else ""
    return f"{who}{how}{size}{taps}"
