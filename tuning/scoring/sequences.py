"""Figures of a sequence: of each frame, of the change between frames, and their means."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchblur.metrics import FlipReference, masked_mean, prepare_flip_ldr, ssim, temporal_error
from torchblur.metrics.pooling import weighted_median
from torchblur.metrics.psnr import decibels
from tuning.data.cases import SequenceCase
from tuning.results.fit import CaseScore, FrameScore, finite_or_none

__all__ = ["FrameByFrame", "mean_of_frames", "noisy_frames", "score_frames", "sequence_figures"]


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
        lines=case.lines,
        frames=tuple(
            FrameScore(label=label, scored=index >= first, scores=scores)
            for index, (label, scores) in enumerate(zip(case.labels, figures, strict=True))
        ),
    )


class FrameByFrame:
    """Figures of one sequence, a frame at a time; it keeps the frame before and no more."""

    def __init__(self) -> None:
        self._before: tuple[Tensor, Tensor] | None = None

    @torch.no_grad()
    def figures(
        self,
        image: Tensor,
        reference: Tensor,
        *,
        masks: Mapping[str, Tensor] | None = None,
        prepared: FlipReference | None = None,
        begins_shot: bool = False,
    ) -> dict[str, float]:
        """Return the figures of the next frame.

        Args:
            image: Scene-linear radiance, (1, 3, H, W).
            reference: The same of the reference.
            masks: As in `evaluate`.
            prepared: The reference prepared for FLIP, if there are several images.
            begins_shot: Whether its change from the frame before is no error. One of another size
                begins a shot too.

        Returns:
            What `evaluate` returns; "flip_median", the weighted median of the FLIP map; and
            "temporal", the mean error of the change from the frame before in display values, NaN
            at the first frame of a shot.
        """
        # As `evaluate`, but for FLIP, of which the median is wanted as well.
        error = (prepared or prepare_flip_ldr(reference)).error(image)
        square, similarity = (image - reference) ** 2, ssim(image, reference)
        figures = {}
        for name, mask in {"": None, **(masks or {})}.items():
            suffix = f"_{name}" if name else ""
            figures[f"flip{suffix}"] = float(masked_mean(error, mask))
            figures[f"psnr{suffix}"] = float(decibels(masked_mean(square, mask)))
            figures[f"ssim{suffix}"] = float(masked_mean(similarity, mask))
        figures |= {"flip_median": float(weighted_median(error)), "temporal": math.nan}
        if self._before is not None and not begins_shot:
            previous, truth = self._before
            if truth.shape == reference.shape:
                change = temporal_error(image, previous, reference, truth)
                figures["temporal"] = float(change.mean())
        self._before = (image, reference)
        return figures


def sequence_figures(
    images: Sequence[Tensor],
    references: Sequence[Tensor],
    *,
    bands: Sequence[Tensor],
    cuts: Sequence[int] = (),
) -> list[dict[str, float | None]]:
    """Return the figures of each frame; None where there is no finite one.

    Args:
        images: Scene-linear radiance, (1, 3, H, W) each.
        references: The same of the references.
        bands: Band at moving borders of each frame, bool, (1, 1, H, W).
        cuts: Positions of frames that begin a new shot.
    """
    frames = FrameByFrame()
    found = []
    for index, (image, reference) in enumerate(zip(images, references, strict=True)):
        masks = {"band": bands[index]}
        figures = frames.figures(image, reference, masks=masks, begins_shot=index in cuts)
        found.append({name: finite_or_none(value) for name, value in figures.items()})
    return found


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
