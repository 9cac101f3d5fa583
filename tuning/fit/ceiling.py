"""The best that a filter does when its smooth parameters suit one frame alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchblur.filters import BlurFilter
from tuning.config.methods import GradientMethod
from tuning.config.objective import ObjectiveSpec
from tuning.data.cases import AnyCase
from tuning.methods.gradient import fit_gradient
from tuning.methods.gradient_state import GradientJob
from tuning.objective.problem import Problem
from tuning.objective.space import Space
from tuning.objective.windows import make_samples

__all__ = ["ceiling"]


def ceiling(
    case: AnyCase,
    blur: BlurFilter,
    space: Space,
    values: Mapping[str, Any],
    objective: ObjectiveSpec,
    steps: int,
) -> Mapping[str, Any]:
    """Return the parameters that suit one frame or sequence best: no common set beats them by much.

    Args:
        case: The frame, or the sequence.
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
    samples = make_samples([case], None, tile_size=1, seed=0, blur=blur)
    return fit_gradient(Problem(blur, samples, objective, space.names), job).params
