"""Pruning by rungs: a trial sees a few windows first, and more of them while it is promising.

The windows are in one order drawn from the run's seed, and each rung has those of the one before
it: what a trial has seen is not filtered again, and the last rung is the whole objective.

With `crop` the rungs before the last see a part of each window alone, and the last one, which is
still the whole objective, filters all windows anew. A part of a window costs its share of pixels.

There is no rung of references with fewer samples. A trial filters sharp frames: what it costs does
not depend on how many samples its references have. And the references of the last rung are needed
as soon as the first trial reaches it, which is the very first one, so references of the same
scenes with fewer samples are never a saving but always rendered in addition. Fewer samples pay
where each scene is seen for a while and then replaced: see `refresh` of the gradient method.
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
from tuning.config.methods import PruningSpec
from tuning.objective.candidates import Evaluated, evaluate_candidates, reduced
from tuning.objective.cropping import pixels_of
from tuning.objective.problem import Problem
from tuning.objective.space import Space

__all__ = ["Climb", "Ladder", "Rung", "rung_sizes"]

_DIGITS = 9  # of passes: 0.1 and 0.2 are 0.3


@dataclass(frozen=True, eq=False)
class Rung:
    """What a trial sees next.

    Args:
        problem: The objective of windows that it has not seen, or that count anew.
        passes: Their cost, in evaluations of all windows.
        is_anew: Whether what it saw before counts no more.
    """

    problem: Problem
    passes: float
    is_anew: bool = False


@dataclass
class Climb:
    """How far one trial came.

    Args:
        loss: The objective over the windows that it saw.
        passes: What it saw, in evaluations of all windows.
        cpu_seconds: What it took.
        pruned: Whether it was stopped.
    """

    loss: float = math.nan
    passes: float = 0.0
    cpu_seconds: float = 0.0
    pruned: bool = False
    seen: list[Tensor] = field(default_factory=list)

    def add(self, one: Evaluated, rung: Rung) -> None:
        """Take in the objective of more windows, or of all of them after parts of some."""
        self.seen = [*([] if rung.is_anew else self.seen), one.losses]
        losses = torch.cat(self.seen)
        self.loss = float(reduced(losses[:, None], rung.problem.objective)[0])
        self.passes = round(self.passes + rung.passes, _DIGITS)
        self.cpu_seconds += one.cpu_seconds


def rung_sizes(total: int, spec: PruningSpec) -> tuple[int, ...]:
    """Return how many windows each rung has, rising; the last has all.

    With parts of windows two rungs may have the same windows: the parts, and the whole.

    Args:
        total: Number of all windows.
        spec: Share of the first rung, and how the rungs grow.
    """
    sizes = []
    share = spec.first
    while share < 1:
        sizes.append(math.ceil(total * share - 1e-9))
        share *= spec.factor
    if spec.crop is not None:
        return (*dict.fromkeys(sizes), total)
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
                f"window{'' if total == 1 else 's'} makes one: train on more frames, on windows "
                "of them (data.crops), or begin with parts of them (`crop`)"
            )
        generator = torch.Generator().manual_seed(seed)
        self.order = tuple(torch.randperm(total, generator=generator).tolist())
        *ends, _ = self.sizes
        firsts = (0, *ends)
        self.rungs = [self._rung(problem, *pair) for pair in zip(firsts, ends, strict=False)]
        if spec.crop is None:
            self.rungs.append(self._rung(problem, firsts[-1], total))
        else:
            self.rungs.append(Rung(problem.subset(self.order), 1.0, is_anew=True))

    def _rung(self, problem: Problem, first: int, end: int) -> Rung:
        chosen = self.order[first:end]
        part = problem.subset(chosen, self.spec.crop)
        shares = [
            pixels_of(sample) / pixels_of(problem.samples[place])
            for place, sample in zip(chosen, part.samples, strict=True)
        ]
        return Rung(part, sum(shares) / len(problem.samples))

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
        for number, rung in enumerate(self.rungs):
            asked = [candidates[i] for i in left]
            found = evaluate_candidates(
                rung.problem, space, fixed, asked, by_window=True, together=together
            )
            for index, one in zip(left, found, strict=True):
                climbs[index].add(one, rung)
            left = [i for i in left if math.isfinite(climbs[i].loss)]
            if number < len(self.rungs) - 1:
                left = self._kept(trials, climbs, left, self.spec.factor**number)
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
