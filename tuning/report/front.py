"""The part of a report that shows a front: the plot, the presets, the settings of the front."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from tuning.report.front_files import front_method
from tuning.report.front_plots import front_svg
from tuning.report.page import Column, Row, Table, short_text
from tuning.results.fit import FitResult
from tuning.results.front import ParetoPoint, ParetoResult

__all__ = ["FrontSection", "front_section", "preset_names"]

_NAMES = {"published": "as published", "start": "start values", "line": "line blur"}


@dataclass(frozen=True)
class FrontSection:
    """What the template shows.

    Args:
        tried: Number of settings.
        figure: The plot.
        presets: Budget, cost and objective of the presets and the landmarks.
        columns: Names of the parameters.
        rows: The settings of the front, from the cheapest to the best.
    """

    tried: int
    figure: Markup
    presets: Table
    columns: list[str]
    rows: list[dict[str, Any]]


def preset_names(result: FitResult) -> tuple[str, ...]:
    """Return the names of the presets that a run's front gave, from cheap to dear."""
    method = front_method(result)
    return () if method is None or method.pareto is None else tuple(method.pareto.picked())


def front_section(result: FitResult) -> FrontSection | None:
    """Return the section on the front, or None if the run did not search for one."""
    method = front_method(result)
    if method is None or method.pareto is None:
        return None
    found = method.pareto
    return FrontSection(
        tried=len(found.points),
        figure=front_svg(found),
        presets=_presets(found),
        columns=list(found.points[0].params),
        rows=[_row(found, number) for number in found.front],
    )


def _presets(found: ParetoResult) -> Table:
    columns = [
        Column(name="budget", digits=2),
        Column(name="cost", digits=3),
        Column(name="taps", digits=1),
        Column(name="lookups", digits=0),
        Column(name="passes", digits=1),
        Column(name="objective, training", digits=4),
        Column(name="objective, hold-out", digits=4),
    ]
    rows = [
        Row(name=_NAMES[mark.origin], values=[None, *_figures(mark)]) for mark in found.landmarks
    ]
    for pick in found.picks:
        if pick.number is not None:
            values = [pick.budget, *_figures(found.point(pick.number))]
            rows.append(Row(name=pick.name, values=values, strong=True))
    return Table(title="", columns=columns, rows=rows)


def _figures(point: ParetoPoint) -> list[float | None]:
    return [
        point.cost, point.taps, point.lookups, point.passes, point.objective, point.holdout
    ]  # fmt: skip


def _row(found: ParetoResult, number: int) -> dict[str, Any]:
    point = found.point(number)
    names = [pick.name for pick in found.picks if pick.number == number]
    return {
        "number": number,
        "presets": ", ".join(names),
        "origin": point.origin,
        "cost": f"{point.cost:.3f}",
        "objective": f"{point.objective:.4f}",
        "holdout": "–" if point.holdout is None else f"{point.holdout:.4f}",
        "values": [short_text(value) for value in point.params.values()],
    }
