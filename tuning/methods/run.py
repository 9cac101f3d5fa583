"""The methods of a fit, in their order: each may begin at the best of those before it."""

from __future__ import annotations

from typing import Any

from torchblur.filters import get_filter
from torchblur.params import declared
from tuning.config.fit import TuneConfig, free_names
from tuning.config.methods import GradientMethod, ParetoMethod, polished_names
from tuning.files.run_folder import RunFolder
from tuning.methods.blackbox import BlackBoxJob, fit_blackbox
from tuning.methods.gradient import fit_gradient
from tuning.methods.gradient_state import GradientJob, seed_of
from tuning.methods.pareto import ParetoJob, fit_pareto
from tuning.methods.scene_pool import Pool
from tuning.objective.problem import Problem
from tuning.objective.space import Space
from tuning.progress import Progress
from tuning.results.fit import MethodResult

__all__ = ["method_name", "run_methods"]


def run_methods(
    config: TuneConfig,
    problem: Problem,
    space: Space,
    folder: RunFolder | None = None,
    progress: Progress | None = None,
) -> list[MethodResult]:
    """Run all methods of a configuration.

    Args:
        config: A resolved configuration.
        problem: The objective on the training frames.
        space: All free parameters.
        folder: Where logs, checkpoints and journals go, and what is gone on from.
        progress: Who is told of each step.

    Returns:
        What each of them found.

    Raises:
        FitError: a method has no parameter set with a finite loss.
        ConfigError: too few windows for the rungs of a pruner; nothing to draw new scenes from.
    """
    results: list[MethodResult] = []
    for index, method in enumerate(config.methods):
        points: list[dict[str, Any]] = [space.start()]
        if method.continue_from_best and results:
            points.append(min(results, key=lambda r: r.objective).params)
        names = free_names(config, index)
        common: dict[str, Any] = {
            "index": index,
            "name": method_name(config, index),
            "space": space.subset(names),
            "fixed": {name: value for name, value in points[-1].items() if name not in names},
            "first": tuple(points),
            "seed": config.seed,
        }
        if isinstance(method, GradientMethod):
            gradient = GradientJob(method=method, **common)
            pool = _pool(config, problem, index, method)
            result = fit_gradient(problem, gradient, folder, progress, pool)
        elif isinstance(method, ParetoMethod):
            front = ParetoJob(method=method, **common)
            result = fit_pareto(problem, front, folder, progress)
        else:
            specs = declared(get_filter(config.filter.kind).config_class)
            polished = polished_names(method, names, specs)
            search = BlackBoxJob(method=method, polished=polished, **common)
            result = fit_blackbox(problem, search, folder, progress)
        results.append(result)
    return results


def _pool(config: TuneConfig, problem: Problem, index: int, method: GradientMethod) -> Pool | None:
    if method.refresh is None:
        return None
    return Pool(problem, config.data, method.refresh, seed_of(config.seed, index))


def method_name(config: TuneConfig, index: int) -> str:
    """Return a short name, unique in the run: "gradient", "tpe", "tpe 2".

    Args:
        config: The configuration.
        index: Position among its methods.
    """
    labels = [m.sampler if m.kind == "blackbox" else m.kind for m in config.methods]
    repeat = labels[: index + 1].count(labels[index])
    return labels[index] if repeat == 1 else f"{labels[index]} {repeat}"
