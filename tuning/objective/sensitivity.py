"""How much the objective depends on each parameter: by its gradient and by trying it out.

The slope is the relative change of the objective per range of the parameter: at −2, moving it up by
1 % of its range makes the objective 2 % smaller. By autograd it is exact where the parameter is
smooth; where it acts through sample positions or thresholds it may be far from what a real step
does, and the slope by differences shows that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tuning.objective.problem import Problem
from tuning.objective.space import Space
from tuning.progress import Progress, Stage
from tuning.results.fit import SensitivityResult

__all__ = ["Differences", "differences", "gradient_slopes", "measure_sensitivity", "sensitivities"]

_STEP = 0.05  # of each range, around the optimum
_START_STEP = 0.01  # where the objective is steep
_TINY = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class Differences:
    """The objective around a point; NaN beyond the end of a range.

    Args:
        center: At the point itself.
        up: With one parameter after the other moved up, (P,).
        down: The same downwards.
        step: By so much of each range.
    """

    center: float
    up: Tensor
    down: Tensor
    step: float

    def rises(self) -> Tensor:
        """Return the relative rise of the worse direction, (P,)."""
        both = torch.stack([self.up, self.down]).nan_to_num(nan=-math.inf)
        return both.max(dim=0).values / max(self.center, _TINY) - 1

    def slopes(self) -> Tensor:
        """Return the relative change per range, (P,): central, one-sided at an end."""
        is_up, is_down = ~self.up.isnan(), ~self.down.isnan()
        up = torch.where(is_up, self.up, self.center)
        down = torch.where(is_down, self.down, self.center)
        width = self.step * (is_up.double() + is_down.double())
        return (up - down) / width / max(self.center, _TINY)


def differences(
    problem: Problem, space: Space, values: Mapping[str, Any], step: float
) -> Differences:
    """Evaluate the objective a step away from a point along each parameter.

    Args:
        problem: The objective.
        space: Numbers with a range alone.
        values: The point, with all free parameters.
        step: Of each range.
    """
    fixed = {name: value for name, value in values.items() if name not in space.names}
    center = space.to_unit(values)
    moves = torch.eye(len(space.names), dtype=torch.float64) * step
    points = torch.cat([center[None], center + moves, center - moves])
    inside = ((points >= 0) & (points <= 1)).all(dim=1)
    losses = problem.mean(fixed | space.from_unit(points.clamp(0, 1)), len(points))
    losses = torch.where(inside, losses, math.nan)
    up, down = losses[1:].chunk(2)
    return Differences(center=float(losses[0]), up=up, down=down, step=step)


def gradient_slopes(
    problem: Problem, space: Space, values: Mapping[str, Any], unroll: int | None = None
) -> Tensor:
    """Return the relative change of the objective per range by autograd, (P,).

    Args:
        problem: The objective.
        space: Numbers with a range alone; of weak ones the gradient may be zero or biased.
        values: The point, with all free parameters.
        unroll: Of sequences: gradients go back through at most so many frames.
    """
    fixed = {name: value for name, value in values.items() if name not in space.names}
    unit = space.to_unit(values)[None].requires_grad_(True)
    moved = space.from_unit(unit)
    leaves = {name: value.detach().requires_grad_(True) for name, value in moved.items()}
    total = 0.0
    for part in problem.losses(fixed | leaves, 1, range(len(problem.samples)), unroll=unroll):
        total += float(part.detach().double())
        if part.requires_grad:
            part.sum().backward()
    grads = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves.values()]
    torch.autograd.backward(list(moved.values()), grads)
    assert unit.grad is not None
    return unit.grad[0] / max(total, _TINY)


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
    rises = differences(problem, floats, values, _STEP).rises().tolist()
    return dict(zip(floats.names, rises, strict=True))


def measure_sensitivity(
    problem: Problem,
    space: Space,
    start: Mapping[str, Any],
    tuned: Mapping[str, Any],
    unroll: int | None = None,
    progress: Progress | None = None,
) -> dict[str, SensitivityResult]:
    """Return slopes and rises of all floats, at the start values and at the tuned ones.

    Args:
        problem: The objective.
        space: All free parameters; choices and integers are left out.
        start: Values before the fit.
        tuned: Values after it.
        unroll: Of sequences: gradients go back through at most so many frames.
        progress: Told after each of the four parts.
    """
    floats = space.continuous()
    if not floats.names:
        return {}
    stage = Stage("sensitivity", 4, progress)
    before = differences(problem, floats, start, _START_STEP)
    stage.step(1)
    after = differences(problem, floats, tuned, _STEP)
    stage.step(2)
    columns = {"start_gradient": gradient_slopes(problem, floats, start, unroll)}
    stage.step(3)
    columns["gradient"] = gradient_slopes(problem, floats, tuned, unroll)
    stage.step(4)
    columns |= {
        "start_difference": before.slopes(),
        "difference": after.slopes(),
        "rise": after.rises(),
    }
    return {
        name: SensitivityResult(**{key: _finite(c[i]) for key, c in columns.items()})
        for i, name in enumerate(floats.names)
    }


def _finite(value: Tensor) -> float | None:
    return float(value) if math.isfinite(value) else None
