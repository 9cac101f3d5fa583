"""Curves of a fit as inline SVG, in colors that are readable on light and on dark pages."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from torchblur.io.paths import output_file
from tuning.results.fit import FitResult, MethodResult, ParameterResult

__all__ = [
    "GRAY",
    "color_of",
    "loss_curves",
    "parameter_paths",
    "png_of",
    "save_png",
    "style",
    "svg_of",
]

GRAY = "#7d8590"
"""Of text and axes: readable on light and on dark."""

_COLORS = ("#3b82f6", "#f59e0b", "#10b981", "#ec4899", "#8b5cf6", "#14b8a6", "#ef4444", "#a3a300")
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "torchblur",
    "font.family": "sans-serif",
    "font.size": 9,
    "text.color": GRAY,
    "axes.labelcolor": GRAY,
    "axes.edgecolor": GRAY,
    "xtick.color": GRAY,
    "ytick.color": GRAY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRAY,
    "grid.alpha": 0.2,
    "legend.frameon": False,
}
_DPI = 130
_WIDE = 60  # ratio of the ends of an axis above which only powers of ten are labeled
Records = Sequence[Mapping[str, Any]]


def png_of(figure: Figure) -> bytes:
    """Return a plot as a PNG file on white."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, facecolor="white")
    return buffer.getvalue()


def save_png(figure: Figure, path: Path) -> None:
    """Save a plot as a PNG file on white; one that is there is replaced."""
    with output_file(path, overwrite=True) as temporary:
        temporary.write_bytes(png_of(figure))


def style() -> Any:
    """Return the settings of matplotlib that all plots share, for `rc_context`."""
    return _STYLE


def color_of(index: int) -> str:
    """Return the color of a line; they come around again."""
    return _COLORS[index % len(_COLORS)]


def loss_curves(result: FitResult, records: Records) -> Markup:
    """Return the objective over the steps of each method, all starts, as SVG.

    Args:
        result: The run's result.
        records: Lines of the run's log.
    """
    count = len(result.methods)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(4.6 * count, 3.0), layout="constrained")
        for index, method in enumerate(result.methods):
            axes = figure.add_subplot(1, count, index + 1)
            steps = _records_of(records, index)
            if method.kind == "gradient":
                _draw_starts(axes, steps)
            else:
                _draw_trials(axes, steps)
            axes.axhline(result.start_objective, color=GRAY, linestyle="--", linewidth=1)
            axes.set(
                title=method.name,
                xlabel="step" if method.kind == "gradient" else "trial",
                ylabel="objective on the training frames" if index == 0 else "",
            )
            axes.title.set_fontsize(10)
            axes.legend(fontsize=8)
        return svg_of(figure, "loss")


def parameter_paths(result: FitResult, records: Records, index: int) -> Markup:
    """Return how the parameters moved (gradient) or what was tried (black box), as SVG.

    Args:
        result: The run's result.
        records: Lines of the run's log.
        index: Position of the method.
    """
    method = result.methods[index]
    steps = _records_of(records, index)
    named = [p for p in result.parameters if steps and p.name in steps[0]["params"]]
    drawn = [p for p in named if p.low is not None]
    columns = min(4, max(1, len(drawn)))
    rows = math.ceil(max(1, len(drawn)) / columns)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(2.75 * columns, 1.85 * rows), layout="constrained")
        for position, parameter in enumerate(drawn):
            axes = figure.add_subplot(rows, columns, position + 1)
            draw = _draw_path if method.kind == "gradient" else _draw_slice
            draw(axes, steps, parameter, method)
            axes.set_title(_label(parameter), fontsize=9)
        return svg_of(figure, f"paths{index}")


def _draw_starts(axes: Axes, steps: Records) -> None:
    xs = [record["step"] for record in steps]
    for start in range(len(steps[0]["loss"]) if steps else 0):
        ys = [_number(record["loss"][start]) for record in steps]
        axes.plot(xs, ys, color=color_of(start), linewidth=1.4, label=f"start {start + 1}")


def _draw_trials(axes: Axes, steps: Records) -> None:
    xs = [record["step"] for record in steps]
    ys = [_number(record["loss"][0]) for record in steps]
    axes.plot(xs, ys, ".", color=color_of(0), markersize=3.5, alpha=0.6, label="trial")
    _mark(axes, [(r["step"], r["pruned"]) for r in steps if "pruned" in r], "x", 3, "pruned")
    polished = [(r["step"], _number(r["loss"][0])) for r in steps if "polish_of" in r]
    _mark(axes, polished, "D", 2, "polished")
    best, lowest = [], math.inf
    for y in ys:
        lowest = lowest if math.isnan(y) else min(lowest, y)
        best.append(lowest)
    axes.plot(xs, best, color=color_of(1), linewidth=1.4, label="best so far")
    finite = sorted(y for y in ys if math.isfinite(y))
    if finite:
        top = finite[min(len(finite) - 1, int(0.9 * len(finite)))]
        margin = 0.15 * (top - finite[0]) or 0.1 * abs(top) or 1.0
        axes.set_ylim(finite[0] - margin, top + margin)


def _mark(
    axes: Axes, points: Sequence[tuple[float, float]], marker: str, index: int, label: str
) -> None:
    """Draw trials of a special kind, if there are any."""
    if points:
        xs, ys = zip(*points, strict=True)
        axes.plot(xs, ys, marker, color=color_of(index), markersize=3, alpha=0.8, label=label)


def _draw_path(axes: Axes, steps: Records, parameter: ParameterResult, _: MethodResult) -> None:
    xs = [record["step"] for record in steps]
    for start in range(len(steps[0]["loss"])):
        ys = [record["params"][parameter.name][start] for record in steps]
        axes.plot(xs, ys, color=color_of(start), linewidth=1.2)
    if parameter.scale == "log":
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis)
    axes.axhline(parameter.tuned, color=GRAY, linestyle=":", linewidth=1)


def _draw_slice(
    axes: Axes, steps: Records, parameter: ParameterResult, method: MethodResult
) -> None:
    pairs = [(r["params"][parameter.name][0], _number(r["loss"][0])) for r in steps]
    colors = [r["step"] for r in steps]
    xs, ys = [x for x, _ in pairs], [y for _, y in pairs]
    axes.scatter(xs, ys, c=colors, cmap="cool", s=5, alpha=0.8)
    if parameter.scale == "log":
        axes.set_xscale("log")
        _plain_numbers(axes.xaxis)
    axes.axvline(method.params[parameter.name], color=GRAY, linestyle=":", linewidth=1)
    finite = sorted(y for y in ys if math.isfinite(y))
    if finite and finite[-1] > finite[0]:
        top = finite[int(0.9 * (len(finite) - 1))]
        margin = 0.1 * (top - finite[0]) or 0.1 * abs(top) or 1.0
        axes.set_ylim(finite[0] - margin, top + margin)


def _plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis with a few plain numbers."""
    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high / low < _WIDE else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=6))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _label(parameter: ParameterResult) -> str:
    unit = "" if parameter.unit == "1" else f" [{parameter.unit}]"
    return f"{parameter.name}{unit}"


def _records_of(records: Records, index: int) -> Records:
    return [r for r in records if r.get("method") == index and "loss" in r]


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def svg_of(figure: Figure, salt: str) -> Markup:
    """Return a figure as an `svg` element that scales with the page and has ids of its own.

    Args:
        figure: What was drawn.
        salt: Unique name within the page.
    """
    buffer = io.StringIO()
    salted: Any = {"svg.hashsalt": salt}
    with mpl.rc_context(salted):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(id="|url\(#|xlink:href="#)', rf"\g<1>{salt}-", text)
    return Markup(text)
