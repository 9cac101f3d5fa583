"""The objective of many candidates: those with the same discrete values are filtered together."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from tuning.config.objective import ObjectiveSpec
from tuning.objective.problem import Problem
from tuning.objective.space import Space
from tuning.objective.terms import tail_weights

__all__ = ["Evaluated", "evaluate_candidates", "reduced"]


@dataclass(frozen=True, eq=False)
class Evaluated:
    """What is known of one candidate.

    Args:
        losses: The objective of each window, (n,), or of all of them, (1,); float64.
        cpu_seconds: Of this process; a batch's are shared out evenly.
    """

    losses: Tensor
    cpu_seconds: float


@dataclass(frozen=True, eq=False)
class _Batch:
    """Candidates of one call: `count` sets, each value one for all or (count,)."""

    values: Mapping[str, Any]
    count: int


def evaluate_candidates(
    problem: Problem,
    space: Space,
    fixed: Mapping[str, Any],
    candidates: Sequence[Mapping[str, Any]],
    *,
    by_window: bool = False,
    together: int | None = None,
) -> list[Evaluated]:
    """Return the objective of candidates, in their order.

    What is filtered together depends on the candidates and on `together` alone, never on who does
    it: so the figures of a cluster are those of one process.

    Args:
        problem: The objective; calls go to the workers of its cluster, if it has one.
        space: The parameters that the candidates have.
        fixed: Values of all others.
        candidates: A value for each parameter. Those that differ in floats alone may be one batch.
        by_window: Return the objective of each window.
        together: So many candidates go into one call. Left out: one on the CPU, where more of them
            are no faster; on a GPU as many as fit.
    """
    on_cpu = problem.samples[0].device.type == "cpu"
    most = together or (1 if on_cpu else problem.sets_per_call)
    places, batches = [], []
    for key, positions in _alike(space, candidates).items():
        for first in range(0, len(positions), most):
            some = positions[first : first + most]
            values = dict(fixed) | {name: value for name, value in key if name}
            if len(some) == 1:
                values |= candidates[some[0]]
            else:
                values |= _columns(space, candidates, some)
            places.append(some)
            batches.append(_Batch(values, len(some)))
    found: dict[int, Evaluated] = {}
    losses = problem.map(partial(_evaluated, by_window), batches)
    for some, evaluated in zip(places, losses, strict=True):
        found |= zip(some, evaluated, strict=True)
    return [found[index] for index in range(len(candidates))]


def reduced(losses: Tensor, objective: ObjectiveSpec) -> Tensor:
    """Return the objective of windows as one figure for each parameter set, (K,).

    Args:
        losses: Of n windows, (n, K).
        objective: How they are reduced.
    """
    return (tail_weights(losses, objective) * losses).sum(dim=0)


def _columns(
    space: Space, candidates: Sequence[Mapping[str, Any]], positions: Sequence[int]
) -> dict[str, Tensor]:
    return {
        name: torch.tensor([float(candidates[i][name]) for i in positions], dtype=torch.float64)
        for name in space.continuous().names
    }


def _evaluated(by_window: bool, problem: Problem, batch: _Batch) -> list[Evaluated]:
    """Return the objective of one batch."""
    began = time.process_time()
    if batch.count == 1:
        columns = [problem.each(batch.values)[:, 0] if by_window else problem.mean(batch.values)]
    else:
        everything = range(len(problem.samples))
        each = problem.each(batch.values, batch.count, everything)
        columns = list((each if by_window else reduced(each, problem.objective)[None]).T)
    share = (time.process_time() - began) / batch.count
    return [Evaluated(losses.clone(), share) for losses in columns]


def _alike(
    space: Space, candidates: Sequence[Mapping[str, Any]]
) -> dict[tuple[tuple[str, Any], ...], list[int]]:
    """Return positions of candidates by what they have in common."""
    names = [p.name for p in space.parameters if not p.is_continuous]
    several = bool(space.continuous().names)
    groups: dict[tuple[tuple[str, Any], ...], list[int]] = {}
    for index, candidate in enumerate(candidates):
        key = tuple((name, candidate[name]) for name in names)
        groups.setdefault(key if several else (*key, ("", index)), []).append(index)
    return groups
