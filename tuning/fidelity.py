"""Pruning by rungs: a trial sees a few windows first, and more of them while it is promising.

The windows are in one order drawn from the run's seed, and each rung has those of the one before
it: what a trial has seen is not filtered again, and the last rung is the whole objective.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from optuna.trial import Trial
from torch import Tensor

from torchblur.errors import ConfigError
from tuning.candidates import Evaluated, evaluate_candidates, reduced
from tuning.method_config import PruningSpec
from tuning.objective_config import ObjectiveSpec
from tuning.problem import Problem
from tuning.space import Space

__all__ = ["Climb", "Ladder", "rung_sizes"]


@dataclass
class Climb:
    """How far one trial came.

    Args:
        loss: The objective over the windows that it saw.
        windows: Their number; 0 if nobody counts.
        cpu_seconds: What it took.
        pruned: Whether it was stopped.
    """

    loss: float = math.nan
    windows: int = 0
    cpu_seconds: float = 0.0
    pruned: bool = False
    seen: list[Tensor] = field(default_factory=list)

    def add(self, one: Evaluated, objective: ObjectiveSpec) -> None:
        """Take in the objective of more windows."""
        self.seen.append(one.losses)
        losses = torch.cat(self.seen)
        self.loss = float(reduced(losses[:, None], objective)[0])
        self.windows = len(losses)
        self.cpu_seconds += one.cpu_seconds


def rung_sizes(total: int, spec: PruningSpec) -> tuple[int, ...]:
    """Return how many windows each rung has, rising; the last has all.

    Args:
        total: Number of all windows.
        spec: Share of the first rung, and how the rungs grow.
    """
    sizes = []
    share = spec.first
    while share < 1:
        sizes.append(math.ceil(total * share - 1e-9))
        share *= spec.factor
    return tuple(dict.fromkeys([*sizes, total]))


class Ladder:
    """The windows of a problem, in rungs.

    Args:
        problem: The whole objective.
        spec: Share of the first rung, and how the rungs grow.
        seed: Of the order of the windows.

    Raises:
        ConfigError: too few windows for two rungs.
    """

    def __init__(self, problem: Problem, spec: PruningSpec, seed: int) -> None:
        total = len(problem.samples)
        self.spec = spec
        self.sizes = rung_sizes(total, spec)
        if len(self.sizes) < 2:
            raise ConfigError(
                f"`pruning` needs two rungs, and `first: {spec.first:g}` of {total} "
                f"window{'' if total == 1 else 's'} makes one: train on more frames, or on windows "
                "of them (data.crops)"
            )
        generator = torch.Generator().manual_seed(seed)
        self.order = tuple(torch.randperm(total, generator=generator).tolist())
        firsts = (0, *self.sizes[:-1])
        self._parts = [
            problem.subset(self.order[first:end])
            for first, end in zip(firsts, self.sizes, strict=True)
        ]

    def climb(
        self,
        trials: Sequence[Trial],
        space: Space,
        fixed: Mapping[str, Any],
        candidates: Sequence[Mapping[str, Any]],
        together: int | None = None,
    ) -> list[Climb]:
        """Evaluate trials that were drawn together, rung by rung.

        At the end of a rung all of them report, and then each is judged, in their order.

        Args:
            trials: The trials; their pruner decides.
            space: What they were drawn from.
            fixed: Values of the other parameters.
            candidates: Values of each trial.
            together: As `evaluate_candidates` takes it.
        """
        climbs = [Climb() for _ in trials]
        left = list(range(len(trials)))
        for rung, part in enumerate(self._parts):
            asked = [candidates[i] for i in left]
            found = evaluate_candidates(
                part, space, fixed, asked, by_window=True, together=together
            )
            for index, one in zip(left, found, strict=True):
                climbs[index].add(one, part.objective)
            left = [i for i in left if math.isfinite(climbs[i].loss)]
            if rung < len(self._parts) - 1:
                left = self._kept(trials, climbs, left, self.spec.factor**rung)
        return climbs

    def _kept(
        self, trials: Sequence[Trial], climbs: Sequence[Climb], left: list[int], resource: int
    ) -> list[int]:
        for index in left:
            trials[index].report(climbs[index].loss, resource)
        for index in left:
            is_worse = trials[index].should_prune()  # asked of all: it also enters the rung
            climbs[index].pruned = is_worse and trials[index].number >= self.spec.startup
        return [index for index in left if not climbs[index].pruned]
