"""What a run finds out, as it stands in result.json."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from torchblur.errors import ConfigError
from torchblur.params import Config, build
from tuning.results.cuts import Cuts, cuts_over
from tuning.results.front import ParetoResult

__all__ = [
    "CaseScore",
    "FitResult",
    "FrameScore",
    "MethodResult",
    "ParameterResult",
    "SensitivityResult",
    "StartResult",
    "cut_text",
    "finite_or_none",
    "height_name",
    "worse_text",
]

Split = Literal["train", "holdout"]


class StartResult(Config):
    """Where one start of a gradient fit ended."""

    first: dict[str, Any]
    params: dict[str, Any]
    objective: float | None
    """On the training frames; null if the start was dropped for a loss that was not finite."""


class MethodResult(Config):
    """What one method found."""

    name: str
    kind: str
    params: dict[str, Any]
    objective: float
    """On all training frames or windows; the choice between methods goes by it."""
    evaluations: int
    """Parameter sets evaluated, with or without gradient."""
    passes: float = 0.0
    """The same in passes over all windows: a pruned trial counts for those that it saw."""
    seconds: float
    cpu_seconds: float = 0.0
    """Of the process, all threads."""
    spent: dict[str, float] = Field(default_factory=dict)
    """Of a gradient method: CPU-seconds by what they went into: "render" (new scenes), "filter",
    "metric", "other"."""
    starts: tuple[StartResult, ...] = ()
    dropped: int = 0
    """Starts or trials with a loss that was not finite."""
    pruned: int = 0
    """Trials that were stopped before they saw all windows."""
    polished: int = 0
    """Trials that gradient steps found."""
    importances: dict[str, float] = Field(default_factory=dict)
    """Share of each parameter in the spread of the objective, as Optuna estimates it."""
    pareto: ParetoResult | None = None
    """Of a search for the front of quality against cost."""


class SensitivityResult(Config):
    """How the objective depends on one float; null where it is not finite.

    Slopes are relative changes per range: at -2, moving it up by 1 % of its range makes the
    objective 2 % smaller.
    """

    start_gradient: float | None
    """Slope before the fit, by autograd."""
    start_difference: float | None
    """The same by steps of 1 % of the range."""
    gradient: float | None
    """Slope after the fit, by autograd."""
    difference: float | None
    """The same by steps of 5 % of the range."""
    rise: float | None
    """Rise after the fit when it moves by 5 % of its range, the worse of both directions."""


class ParameterResult(Config):
    """One free parameter before and after the fit."""

    name: str
    symbol: str
    unit: str
    meaning: str
    source: str
    default: Any
    start: Any
    tuned: Any
    low: float | None
    high: float | None
    choices: tuple[Any, ...] = ()
    scale: str
    sensitivity: float | None = None
    """Rise of the training objective, relative, when it moves by 5 % of its range (the worse of
    both directions); null for choices."""
    slopes: SensitivityResult | None = None
    """By gradient and by differences; null for choices and integers."""


class FrameScore(Config):
    """Figures of one frame of a sequence."""

    label: str
    """Its number."""
    scored: bool
    """Whether it counts; frames of the warm-up do not."""
    scores: dict[str, float | None]


class CaseScore(Config):
    """Figures of one image against one reference, or of a sequence against its references."""

    case: str
    split: Split
    variant: str
    """"default", "start", "tuned", "gradient", "sharp", "input", "line", "ceiling", "noise" …"""
    scores: dict[str, float | None]
    """flip, psnr, ssim and the same with _band; null where the band is empty. Of a sequence the
    means over its scored frames, and flip_median and temporal beside them."""
    frames: tuple[FrameScore, ...] = ()
    """Of a sequence: its frames in order."""
    lines: int | None = None
    """Height of the camera's whole image, px; null in results that do not say it."""
    cut: float | None = None
    """Share of the pixels that move farther than the filter blurs, of a sequence the mean; null
    where there is no such limit."""
    longest: float | None = None
    """Longest half spread of the case, px; null where `cut` is."""


class FitResult(Config):
    """All that a run found; `result.json` in its folder holds the same."""

    filter: str
    params: dict[str, Any]
    """All parameters that differ from the filter's defaults, the tuned ones included."""
    chosen: str
    """Name of the method whose parameters these are; "start" if none was better."""
    start_objective: float
    objective: float
    parameters: tuple[ParameterResult, ...]
    methods: tuple[MethodResult, ...]
    scores: tuple[CaseScore, ...]
    notes: tuple[str, ...] = ()
    seed: int
    command: str
    versions: dict[str, str]
    seconds: float

    def mean(self, variant: str, split: str, metric: str, lines: int | None = None) -> float | None:
        """Return the mean of a metric over the cases of a split, or None if there is none.

        Args:
            variant: As in `CaseScore.variant`.
            split: "train" or "holdout".
            metric: "flip", "psnr", "ssim", "flip_band" …; of sequences also "flip_median" and
                "temporal"
            lines: Over the cases of this height alone.
        """
        values = [
            value
            for score in self.scores
            if score.variant == variant
            and score.split == split
            and lines in (None, score.lines)
            and (value := score.scores.get(metric)) is not None
        ]
        return sum(values) / len(values) if values else None

    def variants(self) -> tuple[str, ...]:
        """Return the names of what was scored, in order."""
        return tuple(dict.fromkeys(score.variant for score in self.scores))

    def heights(self, split: str) -> tuple[int, ...]:
        """Return the heights of the cameras' images of a split, px, the tallest first."""
        known = {s.lines for s in self.scores if s.split == split and s.lines is not None}
        return tuple(sorted(known, reverse=True))

    def height_groups(self) -> tuple[int | None, ...]:
        """Return the heights that figures of the hold-out are given for, the tallest first.

        Returns:
            Of several heights each, and None for all cases together; of one height None alone.
        """
        heights = self.heights("holdout")
        return (*heights, None) if len(heights) > 1 else (None,)

    def worse_than_line(self, variant: str) -> list[tuple[int | None, float, float]]:
        """Return at which heights of the hold-out a variant's FLIP is above that of `line`.

        Args:
            variant: As in `CaseScore.variant`.

        Returns:
            Height (None where it is not known), the variant's FLIP, and that of `line`; what four
            digits do not show does not count.
        """
        found = []
        for lines in self.heights("holdout") or (None,):
            own, line = (self.mean(name, "holdout", "flip", lines) for name in (variant, "line"))
            if own is not None and line is not None and round(own, 4) > round(line, 4):
                found.append((lines, own, line))
        return found

    def cuts(self, variant: str, split: str) -> Cuts | None:
        """Return what a variant cuts short of the cases of a split, or None if nothing.

        Args:
            variant: As in `CaseScore.variant`.
            split: "train" or "holdout".
        """
        scores = [s for s in self.scores if (s.variant, s.split) == (variant, split)]
        return cuts_over([(score.cut or 0.0, score.longest or 0.0) for score in scores])

    @classmethod
    def load(cls, path: Path) -> FitResult:
        """Read a result.json.

        Raises:
            ConfigError: no such file, or not such a file.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} is no result of a fit: {error}") from error
        return build(cls, data, str(path))


def finite_or_none(value: float) -> float | None:
    """Return a number as JSON can have it: None if it is infinite or NaN."""
    return value if math.isfinite(value) else None


def cut_text(result: FitResult, variant: str) -> str:
    """Return what a variant cuts short of the hold-out, or of what was fitted, in words.

    Args:
        result: A fit's result.
        variant: As in `CaseScore.variant`.

    Returns:
        "on 1 of 5 hold-out frames it cuts short …", or nothing if nothing is cut of either.
    """
    for split, frames in (("holdout", "hold-out frames"), ("train", "training frames")):
        cuts = result.cuts(variant, split)
        if cuts is not None:
            return f"{cuts.text(frames)}."
    return ""


def height_name(lines: int | None) -> str:
    """Return what a height of `FitResult.height_groups` is called."""
    return "all heights" if lines is None else f"{lines} lines"


def worse_text(result: FitResult, variant: str) -> str:
    """Return where a variant is worse than a line blur on the hold-out, or nothing if nowhere.

    Args:
        result: A fit's result.
        variant: As in `CaseScore.variant`.
    """
    found = [
        f"{'on the hold-out' if lines is None else f'at {height_name(lines)}'} "
        f"({own:.4f} against {line:.4f})"
        for lines, own, line in result.worse_than_line(variant)
    ]
    return f"Worse than a line blur {' and '.join(found)}." if found else ""
