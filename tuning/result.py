"""What a run finds out, as it stands in result.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from torchblur.errors import ConfigError
from torchblur.params import Config, build
from tuning.pareto_result import ParetoResult

__all__ = [
    "CaseScore",
    "FitResult",
    "FrameScore",
    "MethodResult",
    "ParameterResult",
    "SensitivityResult",
    "StartResult",
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

    def mean(self, variant: str, split: str, metric: str) -> float | None:
        """Return the mean of a metric over the cases of a split, or None if there is none.

        Args:
            variant: As in `CaseScore.variant`.
            split: "train" or "holdout".
            metric: "flip", "psnr", "ssim", "flip_band" …; of sequences also "flip_median" and
                "temporal"
        """
        values = [
            value
            for score in self.scores
            if score.variant == variant
            and score.split == split
            and (value := score.scores.get(metric)) is not None
        ]
        return sum(values) / len(values) if values else None

    def variants(self) -> tuple[str, ...]:
        """Return the names of what was scored, in order."""
        return tuple(dict.fromkeys(score.variant for score in self.scores))

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
