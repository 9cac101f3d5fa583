"""Plot of a crossfit: FLIP to that of line, on cases that the fits did not see."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from tuning.experiments.crossfit.config import CrossfitConfig
from tuning.experiments.crossfit.run import Crossfit
from tuning.experiments.crossfit.summary import Row, final_variants, mean_names
from tuning.report.plots import GRAY, color_of, save_png, style

__all__ = ["plot_crossfit"]

_WIDTH = 0.72  # of a case's filters, where cases are 1 apart
_TICKS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
_ALIKE = 5  # this color is too close to another one for dots


def plot_crossfit(path: Path, config: CrossfitConfig, found: Crossfit, rows: Sequence[Row]) -> None:
    """Draw the ratios with their intervals: full dots tuned, rings the filters' defaults.

    Args:
        path: A PNG file; it is replaced.
        config: The crossfit.
        found: What `run_crossfit` returned.
        rows: What `summary_of` returned.
    """
    final = final_variants(config, found)
    names = [name for name in config.filters if (name, final.get(name)) != ("line", "default")]
    cases = [*config.data.cases, *mean_names(config, rows)]
    with mpl.rc_context(style()):
        figure = Figure(figsize=(2.2 + 1.35 * len(cases), 4.6), layout="constrained")
        axes = figure.add_subplot()
        axes.axhline(1, color=GRAY, linewidth=1)
        limit = config.targets.get("flip_ratio")
        if limit is not None:
            axes.axhline(limit, color=GRAY, linewidth=1, linestyle=":")
        for index, name in enumerate(names):
            shift = _WIDTH * ((index + 0.5) / len(names) - 0.5)
            own = {
                row.case: row for row in rows if (row.filter, row.variant) == (name, final[name])
            }
            _draw(axes, [(cases.index(c) + shift, r) for c, r in own.items()], index, name)
            if final[name] != "default":
                own = {r.case: r for r in rows if (r.filter, r.variant) == (name, "default")}
                _rings(axes, [(cases.index(c) + shift, r) for c, r in own.items()], index)
        axes.set_xticks(range(len(cases)), [case.replace(", ", ",\n") for case in cases])
        axes.set(title=config.title, ylabel="FLIP, to that of line", yscale="log")
        axes.axvline(len(config.data.cases) - 0.5, color=GRAY, linewidth=0.6)
        axes.grid(visible=False, axis="x")
        axes.yaxis.set_major_locator(FixedLocator(_TICKS))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        if any(final[name] != "default" for name in names):
            axes.plot([], [], "o", color=GRAY, markerfacecolor="none", label="default")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=8)
        save_png(figure, path)


def _draw(axes: Axes, points: Sequence[tuple[float, Row]], index: int, label: str) -> None:
    color = _color(index)
    axes.plot(*_known(points), "o", color=color, markersize=5, label=label)
    for x, row in points:
        found = row.figures["flip_ratio"]
        if found.low is not None and found.high is not None:
            axes.plot([x, x], [found.low, found.high], "-", color=color, linewidth=1.6, alpha=0.7)


def _rings(axes: Axes, points: Sequence[tuple[float, Row]], index: int) -> None:
    color = _color(index)
    axes.plot(*_known(points), "o", color=color, markerfacecolor="none", markersize=5, alpha=0.8)


def _color(index: int) -> str:
    return color_of(index + (index >= _ALIKE))


def _known(points: Sequence[tuple[float, Row]]) -> tuple[list[float], list[float]]:
    known = [(x, v) for x, row in points if (v := row.figures["flip_ratio"].value) is not None]
    return [x for x, _ in known], [y for _, y in known]
