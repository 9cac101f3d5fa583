"""Quality against cost: all settings, the front, the hold-out, the presets."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from tuning.report.plots import GRAY, color_of, png_of, style, svg_of
from tuning.results.front import ParetoPoint, ParetoResult

__all__ = ["front_png", "front_svg"]

_TRIAL, _FRONT, _HOLDOUT, _PRESET = GRAY, color_of(0), color_of(1), color_of(2)
_MARKS = {
    "published": ("as published", "s", color_of(3)),
    "start": ("start values", "D", color_of(4)),
    "line": ("line blur", "^", color_of(5)),
}


def front_svg(found: ParetoResult) -> Markup:
    """Return the plot as SVG for a page.

    Args:
        found: The front; the hold-out's values are drawn where they are known.
    """
    with mpl.rc_context(style()):
        return svg_of(_figure(found), "front")


def front_png(found: ParetoResult) -> bytes:
    """Return the same plot as a PNG file on white."""
    with mpl.rc_context(style()):
        return png_of(_figure(found))


def _figure(found: ParetoResult) -> Figure:
    figure = Figure(figsize=(9.2, 4.6), layout="constrained")
    axes = figure.add_subplot()
    front = [found.point(number) for number in found.front]
    xs, ys = [p.cost for p in found.points], [p.objective for p in found.points]
    axes.plot(xs, ys, ".", color=_TRIAL, markersize=4, alpha=0.5, label="setting that was tried")
    _steps(axes, [(p.cost, p.objective) for p in front], _FRONT, "front, training frames")
    held = [(p.cost, p.holdout) for p in front if p.holdout is not None]
    if held:
        axes.plot(*zip(*held, strict=True), "o--", color=_HOLDOUT, markersize=3.5, linewidth=1,
                  label="the same settings, hold-out")  # fmt: skip
    for mark in found.landmarks:
        _landmark(axes, mark)
    _draw_limits(axes, found, front)
    _presets(axes, found)
    axes.set_xscale("log")
    _label_costs(axes)
    axes.set(xlabel="cost, relative to Guertin 2014 with 35 taps", ylabel="objective")
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


def _steps(axes: Axes, pairs: Sequence[tuple[float, float]], color: str, label: str) -> None:
    """Draw a front: between two of its points nothing better than the cheaper one is known."""
    xs, ys = zip(*pairs, strict=True)
    axes.step(xs, ys, where="post", color=color, linewidth=1.4)
    axes.plot(xs, ys, "o", color=color, markersize=4, label=label)


def _landmark(axes: Axes, mark: ParetoPoint) -> None:
    name, shape, color = _MARKS[mark.origin]
    axes.plot(mark.cost, mark.objective, shape, color=color, markersize=7, label=name)
    if mark.holdout is not None:
        axes.plot(mark.cost, mark.holdout, shape, color=color, markersize=7, fillstyle="none",
                  label=f"{name}, hold-out")  # fmt: skip


def _draw_limits(axes: Axes, found: ParetoResult, front: Sequence[ParetoPoint]) -> None:
    """Leave out what is worse than all that matters: the rest of the plot would be flat."""
    known = [*front, *found.landmarks]
    values = [p.objective for p in known] + [p.holdout for p in known if p.holdout is not None]
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_ylim(low - margin, high + 2 * margin)


def _presets(axes: Axes, found: ParetoResult) -> None:
    """Draw each budget as a line, and what it pays for as a ring."""
    top = axes.get_ylim()[1]
    label: str | None = "preset"
    for pick in found.picks:
        axes.axvline(pick.budget, color=_PRESET, linestyle=":", linewidth=1)
        axes.annotate(
            f"{pick.name} ", (pick.budget, top), color=_PRESET, fontsize=8, ha="right", va="top"
        )
        if pick.number is not None:
            point = found.point(pick.number)
            axes.plot(
                point.cost, point.objective, "o", color=_PRESET, markersize=10, fillstyle="none",
                label=label,
            )  # fmt: skip
            label = None


def _label_costs(axes: Axes) -> None:
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
