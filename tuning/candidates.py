"""The objective of many candidates: those with the same discrete values are filtered together."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tuning.objective_config import ObjectiveSpec
from tuning.problem import Problem
from tuning.reduction import tail_weights
from tuning.space import Space

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


def evaluate_candidates(
    problem: Problem,
    space: Space,
    fixed: Mapping[str, Any],
    candidates: Sequence[Mapping[str, Any]],
    *,
    by_window: bool = False,
) -> list[Evaluated]:
    """Return the objective of candidates, in their order.

    How many of a batch go into one call is a matter of memory and changes no figure.

    Args:
        problem: The objective.
        space: The parameters that the candidates have.
        fixed: Values of all others.
        candidates: A value for each parameter. Those that differ in floats alone are one batch.
        by_window: Return the objective of each window.
    """
    found: dict[int, Evaluated] = {}
    for key, positions in _alike(space, candidates).items():
        began = time.process_time()
        if len(positions) == 1:
            values = dict(fixed) | dict(candidates[positions[0]])
            losses = problem.each(values)[:, 0] if by_window else problem.mean(values)
            columns = [losses]
        else:
            values = dict(fixed) | dict(key) | _columns(space, candidates, positions)
            each = _each(problem, values, len(positions))
            columns = list((each if by_window else reduced(each, problem.objective)[None]).T)
        share = (time.process_time() - began) / len(positions)
        found |= {i: Evaluated(c, share) for i, c in zip(positions, columns, strict=True)}
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


def _each(problem: Problem, values: Mapping[str, Any], count: int) -> Tensor:
    """Return the objective of each window for a batch, (n, K), window after window."""
    most, everything = problem.sets_per_call, range(len(problem.samples))
    parts = []
    for first in range(0, count, most):
        some = {
            n: v[first : first + most] if isinstance(v, Tensor) and v.ndim == 1 else v
            for n, v in values.items()
        }
        parts.append(problem.each(some, min(most, count - first), everything))
    return torch.cat(parts, dim=1)


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
