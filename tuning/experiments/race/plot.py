"""Plots of a race: how good each method is after so many evaluations, and after so many seconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tuning.experiments.race.config import RaceConfig, RaceProblem
from tuning.experiments.race.run import Curve, Point, grid
from tuning.experiments.race.summary import Figure as PointFigure
from tuning.experiments.race.summary import median_curve, target_of
from tuning.report.plots import GRAY, color_of, save_png, style

__all__ = ["plot_race"]

_COLORS = 8  # then dashed
_STEPS = 60  # along the seconds


def plot_race(
    path: Path, config: RaceConfig, problem: RaceProblem, curves: Sequence[Curve]
) -> None:
    """Draw medians over the seeds, and bands from the best to the worst seed.

    Args:
        path: A PNG file; it is replaced.
        config: The race.
        problem: One of its problems.
        curves: Its fits.
    """
    panels: list[tuple[Callable[[Point], float], PointFigure, str, str]] = [
        (_passes, lambda p: p.holdout, "evaluations of all training frames", "hold-out objective"),
        (_seconds, lambda p: p.holdout, "CPU seconds", "hold-out objective"),
    ]
    if problem.planted is not None:
        label = "distance from what was planted"
        panels.append((_passes, lambda p: p.distance, "evaluations", label))
    with mpl.rc_context(style()):
        figure = Figure(figsize=(4.6 * len(panels), 4.9), layout="constrained")
        count = len(config.seeds)
        seeds = "one seed" if count == 1 else f"median of {count} seeds"
        figure.suptitle(f"{config.title}: {problem.name}, {seeds}")
        for position, (key, value, across, up) in enumerate(panels):
            axes = figure.add_subplot(1, len(panels), position + 1)
            _draw(axes, curves, key, value)
            axes.set(xlabel=across, ylabel=up, xscale="log")
            if problem.planted is not None:
                axes.set_yscale("log")
            elif position < 2:
                axes.axhline(target_of(curves), color=GRAY, linestyle=":", linewidth=1)
            if position == 2:
                axes.axhline(config.tolerance, color=GRAY, linestyle=":", linewidth=1)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
        save_png(figure, path)


def _draw(
    axes: Axes, curves: Sequence[Curve], key: Callable[[Point], float], value: PointFigure
) -> None:
    names = dict.fromkeys(curve.entrant for curve in curves)
    last = max(key(curve.points[-1]) for curve in curves)
    first = min(key(curve.points[0]) for curve in curves)
    places = grid(last) if key is _passes else _between(first, last)
    for index, name in enumerate(names):
        own = [curve for curve in curves if curve.entrant == name]
        ends = [*places, max(key(curve.points[-1]) for curve in own)]
        found = median_curve(own, key, value, sorted(set(ends)))
        if not found:
            continue
        xs, middle, low, high = zip(*found, strict=True)
        line = "-" if index < _COLORS else "--"
        color = color_of(index)
        axes.step(xs, middle, line, where="post", color=color, linewidth=1.5, label=name)
        axes.plot(xs[-1:], middle[-1:], "o", color=color, markersize=4)
        axes.fill_between(xs, low, high, color=color, alpha=0.07, linewidth=0, step="post")


def _passes(point: Point) -> float:
    return point.passes


def _seconds(point: Point) -> float:
    return point.cpu_seconds


def _between(first: float, last: float) -> list[float]:
    ratio = (last / max(first, 1e-6)) ** (1 / _STEPS)
    return [max(first, 1e-6) * ratio**step for step in range(_STEPS + 1)]
