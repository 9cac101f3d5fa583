"""Curves of a sequence: error over the frames, one line for each variant, as inline SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tuning.report.plots import GRAY, color_of, style, svg_of
from tuning.results.fit import CaseScore, FrameScore

__all__ = ["frame_curves", "score_curves"]

_PANELS = (
    ("flip", "FLIP, mean"),
    ("flip_median", "FLIP, weighted median"),
    ("temporal", "error of the change between frames"),
)
_WIDTH, _HEIGHT = 4.0, 2.9


def score_curves(scores: Sequence[CaseScore], names: Sequence[str], salt: str) -> Markup:
    """Return mean FLIP, its weighted median and the temporal error over the frames of one case.

    Frames of the warm-up lie in a gray field.

    Args:
        scores: Figures of one sequence, by variant.
        names: The variants that are drawn, in this order.
        salt: Unique name within the page.
    """
    found = {score.variant: score.frames for score in scores}
    return frame_curves({name: found[name] for name in names if name in found}, salt)


def frame_curves(lines: Mapping[str, Sequence[FrameScore]], salt: str) -> Markup:
    """Return the curves of several lines over the same frames.

    Args:
        lines: Figures of each frame, by the name of the line.
        salt: Unique name within the page.
    """
    with mpl.rc_context(style()):
        figure = Figure(figsize=(_WIDTH * len(_PANELS), _HEIGHT), layout="constrained")
        panels = figure.subplots(1, len(_PANELS))
        for axes, (key, title) in zip(panels, _PANELS, strict=True):
            _draw(axes, lines, key)
            axes.set_title(title, fontsize=10)
            axes.set_xlabel("frame")
            axes.set_ylim(bottom=0)
        panels[0].legend(fontsize=8)
        return svg_of(figure, salt)


def _draw(axes: Axes, lines: Mapping[str, Sequence[FrameScore]], key: str) -> None:
    for index, (name, frames) in enumerate(lines.items()):
        ys = [_number(frame.scores.get(key)) for frame in frames]
        axes.plot(
            range(len(frames)), ys, "o-", color=color_of(index), linewidth=1.3, markersize=3,
            label=name,
        )  # fmt: skip
    frames = next(iter(lines.values()))
    warm = sum(not frame.scored for frame in frames)
    if warm:
        axes.axvspan(-0.5, warm - 0.5, color=GRAY, alpha=0.15, linewidth=0)
    every = max(1, math.ceil(len(frames) / 12))
    axes.set_xticks(range(0, len(frames), every), [f.label for f in frames[::every]])


def _number(value: float | None) -> float:
    return math.nan if value is None else value
