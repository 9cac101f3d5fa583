"""Whether a filter is compiled for a job: if there is so much to do that compiling pays.

The choice follows from the configuration and the data alone, never from what is done already, so
that a job that was stopped and goes on does the rest in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchblur.errors import TorchblurError
from torchblur.filters import BlurFilter
from torchblur.io.exr import read_size
from torchblur.ops.compiling import GRADIENT_CALLS
from torchblur.ops.gather import Engine
from tuning.config.fit import TuneConfig
from tuning.config.methods import GradientMethod, Method, ParetoMethod
from tuning.files.outputs import Job
from tuning.objective.cropping import pixels_of
from tuning.objective.problem import Problem
from tuning.objective.space import Space

__all__ = ["files_engine", "fit_engine"]


def fit_engine(config: TuneConfig, problem: Problem, space: Space) -> Engine:
    """Return the engine of a fit; "auto" weighs all evaluations of all methods.

    A switch or choice that is free makes several structures of the filter, each of which is
    compiled: the work is divided by their number.

    Args:
        config: The configuration.
        problem: Its filter and its windows.
        space: Its free parameters.
    """
    pixels = sum(pixels_of(sample) for sample in problem.samples)
    calls = sum(_calls(method, len(problem.samples)) for method in config.methods)
    structures = math.prod(
        len(p.choices)
        for p in space.parameters
        if any(isinstance(c, bool | str) for c in p.choices)
    )
    return problem.blur.engine_for(pixels * calls / structures)


def files_engine(blur: BlurFilter, jobs: Sequence[Job]) -> Engine:
    """Return the engine for files; "auto" weighs their number and the size of the first.

    Args:
        blur: The filter.
        jobs: All files, those that are done as well.
    """
    for job in jobs:
        try:
            height, width = read_size(job.source)
        except TorchblurError:  # it is told of when its turn comes
            continue
        return blur.engine_for(height * width * len(jobs) * (1 + len(job.samples)))
    return blur.engine


def _calls(method: Method, windows: int) -> float:
    """Return how often a method evaluates all windows; with its gradient counts several times."""
    if isinstance(method, GradientMethod):
        share = min(1.0, (method.batch or windows) / windows)
        return method.steps * method.starts * share * GRADIENT_CALLS
    calls: float = method.trials
    if method.polish is not None:
        share = min(1.0, (method.polish.batch or windows) / windows)
        polished = (
            len(method.budgets)
            if isinstance(method, ParetoMethod)
            else method.trials * method.polish.quantile
        )
        calls += polished * method.polish.steps * share * GRADIENT_CALLS
    return calls
