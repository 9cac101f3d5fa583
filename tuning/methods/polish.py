"""Gradient steps from a promising trial of a search.

A trial is promising if it is among the best share of all trials drawn so far. What the steps find
joins the study as a further trial, with its own parameters and its own loss: so the sampler
learns from it, and every trial of the study is what the objective says of its parameters.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tuning.config.methods import GradientMethod, PolishSteps
from tuning.methods.gradient import fit_gradient
from tuning.methods.gradient_state import FitError, GradientJob
from tuning.objective.problem import Problem
from tuning.objective.space import Space

__all__ = ["PolishStart", "Polished", "is_promising", "polish"]


@dataclass(frozen=True, kw_only=True)
class Polished:
    """What the steps found.

    Args:
        params: All parameters of the search; None if no step had a finite loss.
        loss: Mean objective over all windows.
        evaluations: Parameter sets evaluated.
        cpu_seconds: Of this process.
    """

    params: Mapping[str, Any] | None
    loss: float
    evaluations: int
    cpu_seconds: float


@dataclass(frozen=True)
class PolishStart:
    """Where steps begin.

    Args:
        params: Values of the trial.
        seed: Of the windows of each step.
    """

    params: Mapping[str, Any]
    seed: int


def is_promising(loss: float, before: Sequence[float], quantile: float) -> bool:
    """Return whether a loss is among the best share of the losses so far.

    Args:
        loss: Of this trial.
        before: Of all complete trials that were drawn before it.
        quantile: The share; at least one trial is in it.
    """
    rank = 1 + sum(other <= loss for other in before)
    return math.isfinite(loss) and rank <= math.ceil(quantile * (len(before) + 1))


def polish(
    spec: PolishSteps, space: Space, fixed: Mapping[str, Any], problem: Problem, start: PolishStart
) -> Polished:
    """Go down the gradient from a trial.

    Args:
        spec: Number and size of the steps.
        space: The parameters that are polished.
        fixed: Values of the free parameters that the search does not have.
        problem: The objective.
        start: Where it begins.
    """
    params = start.params
    method = GradientMethod(
        kind="gradient",
        steps=spec.steps,
        starts=1,
        learning_rate=spec.learning_rate,
        batch=spec.batch,
        unroll=spec.unroll,
    )
    others = {n: v for n, v in (dict(fixed) | dict(params)).items() if n not in space.names}
    job = GradientJob(
        method=method,
        index=0,
        name="polish",
        space=space,
        fixed=others,
        first=(params,),
        seed=start.seed,
    )
    began = time.process_time()
    found: Mapping[str, Any] | None = None
    loss = math.inf
    try:
        result = fit_gradient(problem, job)
        found = {name: result.params[name] for name in params}
        loss = result.objective
    except FitError:
        pass
    return Polished(
        params=found, loss=loss, evaluations=spec.steps + 1, cpu_seconds=time.process_time() - began
    )
