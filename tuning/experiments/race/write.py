"""What a race is written to: JSON with every point, tables, and a plot for each problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from tuning.experiments.kept import slug
from tuning.experiments.race.config import RaceConfig, RaceProblem
from tuning.experiments.race.plot import plot_race
from tuning.experiments.race.run import Curve
from tuning.experiments.race.summary import NEAR, Standing, standings
from tuning.experiments.tables import csv_text, json_text, markdown_table, write_texts
from tuning.report.page import short_text

__all__ = ["COLUMNS", "SHORT", "cells", "note_of", "write_race"]

COLUMNS = (
    "evaluations",
    "CPU s",
    "training",
    "hold-out",
    "best to worst seed",
    "reached",
    "evaluations until then",
    "CPU s until then",
)
"""Columns of a standing's figures."""

SHORT = {
    "evaluations": "evaluations",
    "CPU s": "CPU s",
    "hold-out": "hold-out",
    "reached": "reached",
    "evaluations until then": "after",
    "CPU s until then": "CPU s",
}
"""Those that fit into a terminal, and what they are called there."""


def write_race(folder: Path, config: RaceConfig, curves: Sequence[Curve]) -> list[Path]:
    """Write `race.json`, `tables.md`, `points.csv` and a PNG for each problem; older ones go.

    Args:
        folder: Where to.
        config: The race.
        curves: What `run_race` returned.

    Raises:
        OutputError: a file cannot be written.
    """
    texts = {
        "race.json": _json(config, curves),
        "tables.md": _markdown(config, curves),
        "points.csv": _csv(curves),
    }
    files = write_texts(folder, texts)
    for problem in config.problems:
        path = folder / f"{slug(problem.name)}.png"
        plot_race(path, config, problem, [c for c in curves if c.problem == problem.name])
        files.append(path)
    return files


def cells(config: RaceConfig, standing: Standing) -> list[str]:
    """Return the figures of a standing as text, in the order of `COLUMNS`."""
    return [
        f"{standing.passes:.0f}",
        f"{standing.cpu_seconds:.1f}",
        f"{standing.train:.4g}",
        f"{standing.holdout:.4g}",
        f"{standing.best:.4g} to {standing.worst:.4g}",
        f"{standing.reached} of {len(config.seeds)}",
        "–" if standing.passes_to is None else f"{standing.passes_to:.0f}",
        "–" if standing.cpu_seconds_to is None else f"{standing.cpu_seconds_to:.1f}",
    ]


def note_of(config: RaceConfig, problem: RaceProblem) -> str:
    """Return what the table of a problem shows, in a few sentences."""
    reached = (
        f"every planted value within {100 * config.tolerance:g} % of its range"
        if problem.planted is not None
        else f"a hold-out objective within {100 * (NEAR - 1):.0f} % of the best median"
    )
    return (
        f"Medians over {len(config.seeds)} seeds. An evaluation is one parameter set on all "
        f"training windows, with or without its gradient. Reached: {reached}, from then on."
    )


def _markdown(config: RaceConfig, curves: Sequence[Curve]) -> str:
    lines = [f"# {config.title}", ""]
    for problem in config.problems:
        found = standings(config, problem, curves)
        lines += [f"## {problem.name}", "", note_of(config, problem), ""]
        lines += markdown_table(
            ["method", *COLUMNS], [[one.entrant, *cells(config, one)] for one in found]
        )
        if problem.planted is not None:
            names = list(problem.planted)
            rows = [["planted", *(short_text(problem.planted[n]) for n in names), ""]]
            for one in found:
                distance = "–" if one.distance is None else f"{100 * one.distance:.2f} %"
                rows.append([one.entrant, *(short_text(one.params[n]) for n in names), distance])
            lines += markdown_table(["method", *names, "largest distance, of the range"], rows)
    return "\n".join(lines)


def _json(config: RaceConfig, curves: Sequence[Curve]) -> str:
    ranks = {
        problem.name: [dataclasses.asdict(one) for one in standings(config, problem, curves)]
        for problem in config.problems
    }
    fits = [dataclasses.asdict(curve) for curve in curves]
    return json_text(config, standings=ranks, fits=fits)


def _csv(curves: Sequence[Curve]) -> str:
    figures = ("passes", "cpu_seconds", "train", "holdout", "distance")
    rows = [
        (curve.problem, curve.entrant, curve.seed, *(getattr(point, name) for name in figures))
        for curve in curves
        for point in curve.points
    ]
    return csv_text(["problem", "entrant", "seed", *figures], rows)
