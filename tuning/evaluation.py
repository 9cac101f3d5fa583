"""How good the parameters are, on frames that were fitted and on frames that were not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.metrics import evaluate
from tuning.blurring import blurred
from tuning.config import GradientMethod, ObjectiveSpec
from tuning.data import Case
from tuning.gradient import GradientJob, fit_gradient
from tuning.problem import Problem
from tuning.progress import Stage
from tuning.result import CaseScore
from tuning.space import Space
from tuning.windows import make_samples

__all__ = [
    "Variant",
    "ceiling",
    "noise_scores",
    "render",
    "score_cases",
    "score_image",
    "sensitivities",
]

_STEP = 0.05  # of each range, for the sensitivities


@dataclass(frozen=True, kw_only=True, eq=False)
class Variant:
    """An image to be scored: a filter with values, or the sharp frame.

    Args:
        name: Its name in tables.
        blur: The filter; None leaves the frame as it is.
        values: Values over the filter's own.
        free: Names of the free parameters, whose values are not taken from the data.
    """

    name: str
    blur: BlurFilter | None = None
    values: Mapping[str, Any] | None = None
    free: tuple[str, ...] = ()


@torch.no_grad()
def render(variant: Variant, case: Case) -> Tensor:
    """Return the image of a variant for a case, (1, 3, H, W), scene-linear."""
    if variant.blur is None:
        return case.frame.color
    return blurred(
        variant.blur,
        case.frame,
        case.shutter.open,
        case.shutter.position,
        variant.values or {},
        variant.free,
    )


def score_cases(
    cases: Sequence[Case], variants: Sequence[Variant], stage: Stage | None = None
) -> list[CaseScore]:
    """Return the figures of all variants on all cases, and the noise of the references.

    Args:
        cases: Frames of both splits.
        variants: What is scored.
        stage: Is told of each case.
    """
    scores: list[CaseScore] = []
    for done, case in enumerate(cases):
        for variant in variants:
            scores.append(score_image(case, variant.name, render(variant, case)))
        if case.variance is not None:
            scores.append(noise_scores(case))
        if stage is not None:
            stage.step(done + 1, message=case.name)
    return scores


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


def ceiling(
    case: Case,
    blur: BlurFilter,
    space: Space,
    values: Mapping[str, Any],
    objective: ObjectiveSpec,
    steps: int,
) -> Mapping[str, Any]:
    """Return the parameters that suit one frame best: what no common set can beat by much.

    Args:
        case: The frame.
        blur: The filter.
        space: All free parameters; the smooth ones are fitted.
        values: The tuned values, where this fit begins.
        objective: As in the fit.
        steps: Steps of Adam.
    """
    specs = {p.name: p.spec for p in space.parameters}
    smooth = space.subset(tuple(n for n, s in specs.items() if s.grad == "smooth"))
    if not smooth.names:
        return values
    job = GradientJob(
        method=GradientMethod(kind="gradient", steps=steps, starts=1),
        index=0,
        name=f"ceiling of {case.name}",
        space=smooth,
        fixed={name: value for name, value in values.items() if name not in smooth.names},
        first=(values,),
        seed=0,
    )
    samples = make_samples([case], None, tile_size=1, seed=0)
    return fit_gradient(Problem(blur, samples, objective, space.names), job).params


def sensitivities(problem: Problem, space: Space, values: Mapping[str, Any]) -> dict[str, float]:
    """Return how much the objective rises when a parameter moves by 5 % of its range.

    Args:
        problem: The objective.
        space: The parameters; choices and integers are left out.
        values: Where to start, the optimum.

    Returns:
        Relative rise by name, the worse of both directions that lie within the range. Below 0
        if the objective would still fall.
    """
    floats = space.continuous()
    if not floats.names:
        return {}
    fixed = {name: value for name, value in values.items() if name not in floats.names}
    center = floats.to_unit(values)
    moves = torch.eye(len(floats.names), dtype=torch.float64) * _STEP
    points = torch.cat([center[None], center + moves, center - moves])
    inside = ((points >= 0) & (points <= 1)).all(dim=1)
    losses = problem.mean(fixed | floats.from_unit(points.clamp(0, 1)), len(points))
    rises = torch.where(inside, losses / losses[0].clamp_min(1e-12) - 1, -math.inf)[1:]
    worst = rises.view(2, -1).max(dim=0).values.tolist()
    return dict(zip(floats.names, worst, strict=True))


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
        scores={name: _finite_or_none(float(value)) for name, value in figures.items()},
    )


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
