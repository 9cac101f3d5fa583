"""What a race is written to: JSON with every point, tables, and a plot for each problem."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from torchblur.io.paths import output_file
from tuning.experiments.kept import slug
from tuning.experiments.race.config import RaceConfig, RaceProblem
from tuning.experiments.race.plot import plot_race
from tuning.experiments.race.run import Curve
from tuning.experiments.race.summary import NEAR, Standing, standings
from tuning.files.outputs import make_folders

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
    make_folders([folder / name for name in texts])
    files = []
    for name, text in texts.items():
        with output_file(folder / name, overwrite=True) as temporary:
            temporary.write_text(text, encoding="utf-8")
        files.append(folder / name)
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
        lines += _table(["method", *COLUMNS], [[one.entrant, *cells(config, one)] for one in found])
        if problem.planted is not None:
            names = list(problem.planted)
            rows = [["planted", *(_text(problem.planted[n]) for n in names), ""]]
            for one in found:
                distance = "–" if one.distance is None else f"{100 * one.distance:.2f} %"
                rows.append([one.entrant, *(_text(one.params[n]) for n in names), distance])
            lines += _table(["method", *names, "largest distance, of the range"], rows)
    return "\n".join(lines)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [_line(head), _line(["---", *["---:"] * (len(head) - 1)])]
    return [*lines, *(_line(row) for row in rows), ""]


def _line(values: Sequence[str]) -> str:
    return "| " + " | ".join(value.replace("|", "\\|") for value in values) + " |"


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _json(config: RaceConfig, curves: Sequence[Curve]) -> str:
    data = {
        "title": config.title,
        "torchblur": version("torchblur"),
        "standings": {
            problem.name: [dataclasses.asdict(one) for one in standings(config, problem, curves)]
            for problem in config.problems
        },
        "fits": [dataclasses.asdict(curve) for curve in curves],
        "config": config.model_dump(mode="json"),
    }
    return json.dumps(data, indent=1, ensure_ascii=False) + "\n"


def _csv(curves: Sequence[Curve]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    figures = ("passes", "cpu_seconds", "train", "holdout", "distance")
    writer.writerow(["problem", "entrant", "seed", *figures])
    for curve in curves:
        for point in curve.points:
            values = [getattr(point, name) for name in figures]
            texts = ["" if value is None else f"{value:.6g}" for value in values]
            writer.writerow([curve.problem, curve.entrant, curve.seed, *texts])
    return buffer.getvalue()
