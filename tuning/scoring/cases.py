"""How good the parameters are, on frames that were fitted and on frames that were not."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchblur.metrics import evaluate
from tuning.data.cases import AnyCase, Case, SequenceCase
from tuning.data.variants import Variant, cut_of, render, render_frames
from tuning.progress import Stage
from tuning.results.fit import CaseScore, finite_or_none
from tuning.scoring.sequences import noisy_frames, score_frames

__all__ = ["noise_scores", "score_cases", "score_image", "score_variant"]


def score_cases(
    cases: Sequence[AnyCase], variants: Sequence[Variant], stage: Stage | None = None
) -> list[CaseScore]:
    """Return the figures of all variants on all cases, and the noise of the references.

    Args:
        cases: Frames and sequences of both splits.
        variants: What is scored, where a case has it.
        stage: Is told of each case.
    """
    scores: list[CaseScore] = []
    for done, case in enumerate(cases):
        scores += [score_variant(case, variant) for variant in variants if variant.fits(case)]
        if isinstance(case, SequenceCase):
            if case.variances is not None:
                scores.append(score_frames(case, "noise", noisy_frames(case)))
        elif case.variance is not None:
            scores.append(noise_scores(case))
        if stage is not None:
            stage.step(done + 1, message=case.name)
    return scores


def score_variant(case: AnyCase, variant: Variant) -> CaseScore:
    """Return the figures of a variant on a case."""
    if isinstance(case, SequenceCase):
        score = score_frames(case, variant.name, render_frames(variant, case))
    else:
        score = score_image(case, variant.name, render(variant, case))
    cut = cut_of(variant, case)
    if cut is None:
        return score
    return score.model_copy(update={"cut": cut.share, "longest": cut.longest})


def noise_scores(case: Case) -> CaseScore:
    """Return what a perfect image would score, as its reference is itself noisy.

    The reference plus noise of its own variance stands for the reference of a perfect image. As
    that variance is an upper estimate, the figures are on the pessimistic side.

    Args:
        case: A case with a variance.
    """
    assert case.variance is not None
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(case.reference.shape, generator=generator).to(case.reference)
    return score_image(case, "noise", case.reference + noise * case.variance.sqrt())


def score_image(case: Case, variant: str, image: Tensor) -> CaseScore:
    """Return the figures of one image, over the image and over the band at moving borders.

    Args:
        case: The frame and its reference.
        variant: The image's name in tables.
        image: Scene-linear radiance, (1, 3, H, W).
    """
    figures = evaluate(image, case.reference, masks={"band": case.band})
    return CaseScore(
        case=case.name,
        split="train" if case.split == "train" else "holdout",
        variant=variant,
        scores={name: finite_or_none(float(value)) for name, value in figures.items()},
        lines=case.lines,
    )
