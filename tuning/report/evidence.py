"""What a preset says of itself: the data, the objective, the figures, and how to make it again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tuning.config.objective import ObjectiveSpec
from tuning.data.cases import AnyCase
from tuning.report.page import FIGURES
from tuning.results.fit import FitResult, height_name

__all__ = ["evidence_of"]


def evidence_of(
    result: FitResult,
    objective: ObjectiveSpec,
    cases: Sequence[AnyCase],
    variants: Sequence[str],
    **found: Any,
) -> dict[str, Any]:
    """Return the evidence of a preset, as plain data.

    Args:
        result: The run's result.
        objective: What was made small.
        cases: Frames and sequences of both splits.
        variants: Names of the images whose figures are given.
        **found: What is said of this preset alone; it stands before the figures.
    """
    groups = {"train": (None,), "holdout": result.height_groups()}
    figures = {
        split if lines is None else f"{split}, {height_name(lines)}": {
            name: _figures(result, name, split, lines) for name in variants
        }
        for split, heights in groups.items()
        if any(case.split == split for case in cases)
        for lines in heights
    }
    cuts = {
        name: cut._asdict()
        for name in variants
        if (cut := result.cuts(name, "holdout")) is not None
    }
    return {
        "train": [case.name for case in cases if case.split == "train"],
        "holdout": [case.name for case in cases if case.split == "holdout"],
        "objective": objective.model_dump(mode="json"),
        **found,
        "figures": figures,
        **({"cut": cuts} if cuts else {}),
        "seed": result.seed,
        "command": result.command,
        "versions": result.versions,
    }


def _figures(result: FitResult, variant: str, split: str, lines: int | None) -> dict[str, float]:
    means = {metric: result.mean(variant, split, metric, lines) for metric in FIGURES}
    return {metric: value for metric, value in means.items() if value is not None}
