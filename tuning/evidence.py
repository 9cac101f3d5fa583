"""What a preset says of itself: the data, the objective, the figures, and how to make it again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tuning.cases import AnyCase
from tuning.objective_config import ObjectiveSpec
from tuning.result import FitResult

__all__ = ["evidence_of"]

_HEADLINE = (
    "flip",
    "psnr",
    "ssim",
    "flip_band",
    "psnr_band",
    "ssim_band",
    "flip_median",
    "temporal",
)


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
    figures = {
        split: {
            variant: {m: v for m in _HEADLINE if (v := result.mean(variant, split, m)) is not None}
            for variant in variants
        }
        for split in ("train", "holdout")
        if any(case.split == split for case in cases)
    }
    return {
        "train": [case.name for case in cases if case.split == "train"],
        "holdout": [case.name for case in cases if case.split == "holdout"],
        "objective": objective.model_dump(mode="json"),
        **found,
        "figures": figures,
        "seed": result.seed,
        "command": result.command,
        "versions": result.versions,
    }
