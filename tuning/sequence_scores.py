"""Figures of a sequence: of each frame, of the change between frames, and their means."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchblur.metrics import evaluate, prepare_flip_ldr, temporal_errors
from torchblur.metrics.pooling import weighted_median
from tuning.cases import SequenceCase
from tuning.result import CaseScore, FrameScore

__all__ = ["finite_or_none", "mean_of_frames", "noisy_frames", "score_frames", "sequence_figures"]


def score_frames(case: SequenceCase, variant: str, images: Sequence[Tensor]) -> CaseScore:
    """Return the figures of a sequence: means over the scored frames, and each frame's own.

    Args:
        case: The sequence and its references.
        variant: Name in tables.
        images: Scene-linear radiance of each frame, (1, 3, H, W).
    """
    figures = sequence_figures(images, case.references, bands=case.bands, cuts=case.cuts)
    first = case.warm_up
    if first < len(figures):
        # Its change is from a frame that is not scored.
        figures[first] = {**figures[first], "temporal": None}
    return CaseScore(
        case=case.name,
        split="train" if case.split == "train" else "holdout",
        variant=variant,
        scores=mean_of_frames(figures[first:]),
        frames=tuple(
            FrameScore(label=label, scored=index >= first, scores=scores)
            for index, (label, scores) in enumerate(zip(case.labels, figures, strict=True))
        ),
    )


@torch.no_grad()
def sequence_figures(
    images: Sequence[Tensor],
    references: Sequence[Tensor],
    *,
    bands: Sequence[Tensor] | None = None,
    cuts: Sequence[int] = (),
) -> list[dict[str, float | None]]:
    """Return the figures of each frame.

    Args:
        images: Scene-linear radiance, (1, 3, H, W) each.
        references: The same of the references.
        bands: Band at moving borders of each frame, bool, (1, 1, H, W).
        cuts: Positions of frames that begin a new shot.

    Returns:
        For each frame what `evaluate` returns; "flip_median", the weighted median of its FLIP map;
        and "temporal", the mean error of the change from the frame before in display values. None
        where there is no finite figure.
    """
    changes = temporal_errors(images, references, cuts=cuts)[:, 0]
    figures = []
    for index, (image, reference) in enumerate(zip(images, references, strict=True)):
        prepared = prepare_flip_ldr(reference)
        masks = {} if bands is None else {"band": bands[index]}
        found = evaluate(image, reference, masks=masks, prepared=prepared)
        found |= {"flip_median": weighted_median(prepared.error(image)), "temporal": changes[index]}
        figures.append({name: finite_or_none(float(value)) for name, value in found.items()})
    return figures


def mean_of_frames(figures: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Return the mean of each figure over the frames that have it; None where no frame has."""
    means: dict[str, float | None] = {}
    for name in figures[0]:
        known = [value for frame in figures if (value := frame[name]) is not None]
        means[name] = sum(known) / len(known) if known else None
    return means


def noisy_frames(case: SequenceCase) -> list[Tensor]:
    """Return references with noise of their own variance added, as `noise_scores` has them."""
    assert case.variances is not None
    generator = torch.Generator().manual_seed(0)
    return [
        reference
        + torch.randn(reference.shape, generator=generator).to(reference) * variance.sqrt()
        for reference, variance in zip(case.references, case.variances, strict=True)
    ]


def finite_or_none(value: float) -> float | None:
    """Return a figure, or None if it is infinite or NaN."""
    return value if math.isfinite(value) else None
