"""Plots of a study as PNG: errors over the frames, and what filters are worth in samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from tuning.experiments.study.run import Row
from tuning.report.plots import GRAY, color_of, save_png, style

__all__ = ["plot_samples", "plot_time"]


def plot_time(path: Path, title: str, rows: Sequence[Row]) -> None:
    """Draw mean and weighted median FLIP of each frame, as Oberberger 2022, figure 12.

    Args:
        path: A PNG file; it is replaced.
        title: Heading.
        rows: One color each.
    """
    with mpl.rc_context(style()):
        figure = Figure(figsize=(8.2, 3.9), layout="constrained")
        axes = figure.add_subplot()
        for index, row in enumerate(rows):
            _draw(axes, row.figures["flip"], index, "-", row.variant)
            _draw(axes, row.figures["flip_median"], index, ":", None)
        axes.set(title=title, xlabel="frame", ylabel="FLIP")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        handles, _ = axes.get_legend_handles_labels()
        gray = mpl.rcParams["text.color"]
        handles += [
            Line2D([], [], color=gray, linestyle="-", label="mean"),
            Line2D([], [], color=gray, linestyle=":", label="weighted median"),
        ]
        figure.legend(handles=handles, loc="outside right upper", fontsize=8)
        save_png(figure, path)


def plot_samples(
    path: Path, title: str, curve: Sequence[tuple[int, float]], levels: dict[str, float], label: str
) -> None:
    """Draw the error of n raw samples per pixel, and the errors of filters as levels.

    Args:
        path: A PNG file; it is replaced.
        title: Heading.
        curve: Numbers of samples and the figure of their mean.
        levels: Figures of filters by name.
        label: Name of the figure.
    """
    with mpl.rc_context(style()):
        figure = Figure(figsize=(7.6, 3.9), layout="constrained")
        axes = figure.add_subplot()
        numbers = [n for n, _ in curve]
        axes.plot(
            numbers, [v for _, v in curve], "o-", color=GRAY, label="raw samples", markersize=4
        )
        for index, (name, value) in enumerate(levels.items()):
            line = "-" if index % 2 == 0 else "--"  # some levels lie upon each other
            axes.axhline(value, color=color_of(index), linestyle=line, linewidth=1.4, label=name)
        axes.set_xscale("log", base=2)
        axes.set_xticks(numbers, [str(n) for n in numbers])
        axes.set(title=title, xlabel="samples per pixel", ylabel=label)
        figure.legend(loc="outside right upper", fontsize=8)
        save_png(figure, path)


def _draw(
    axes: Axes, values: Sequence[float | None], index: int, line: str, label: str | None
) -> None:
    ys = [math.nan if value is None else value for value in values]
    marker = "o" if len(ys) == 1 else ""
    axes.plot(
        range(len(ys)), ys, linestyle=line, marker=marker, color=color_of(index), linewidth=1.3,
        label=label,
    )  # fmt: skip
