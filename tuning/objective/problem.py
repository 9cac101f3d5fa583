"""What a fit minimizes: the objective of a filter's parameters over a set of windows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from tuning.config.cost import cost_at
from tuning.config.objective import ObjectiveSpec
from tuning.objective.batches import AnyGroup, join, kind_of
from tuning.objective.cpu_time import Meter
from tuning.objective.cropping import smaller
from tuning.objective.terms import tail_weights
from tuning.objective.windows import AnySample

__all__ = ["Problem"]

T = TypeVar("T")
R = TypeVar("R")

_PIXELS_PER_BATCH = {"cpu": 1 << 18, "cuda": 1 << 23}


class Problem:
    """The objective over windows, for one set of parameters or for many at once.

    Each sequence counts as much as each single frame, times the window's weight. With many sets
    each window is filtered with all of them in one call; with one set as many windows as fit are.

    Args:
        blur: The filter; its config has the fixed values.
        samples: The windows.
        objective: What is measured.
        free: Names of all free parameters; a shutter among them is not taken from the data.
    """

    def __init__(
        self,
        blur: BlurFilter,
        samples: Sequence[AnySample],
        objective: ObjectiveSpec,
        free: Sequence[str] = (),
    ) -> None:
        self.blur = blur
        self.samples = tuple(samples)
        self.objective = objective
        self.free = tuple(free)
        self.meter = Meter()
        self._single: dict[int, AnyGroup] = {}
        self._joined: list[tuple[list[int], AnyGroup]] | None = None

    @property
    def sets_per_call(self) -> int:
        """How many parameter sets go into one call."""
        largest = max(s.size[0] * s.size[1] for s in self.samples)
        return max(1, _budget(self.samples[0]) // largest)

    def subset(self, chosen: Sequence[int], crop: float | None = None) -> Problem:
        """Return the objective of some of the windows.

        Args:
            chosen: Their positions.
            crop: Edge of the part of each window that counts, as `smaller` takes it; all of each
                window if left out.
        """
        samples = [self.samples[i] for i in chosen]
        return Problem(self.blur, self._cropped(samples, crop), self.objective, self.free)

    def with_samples(self, samples: Sequence[AnySample]) -> Problem:
        """Return the same objective over other windows; what is known of those that stay is kept.

        Args:
            samples: All of its windows.
        """
        other = Problem(self.blur, samples, self.objective, self.free)
        other.meter = self.meter
        known = {id(self.samples[place]): group for place, group in self._single.items()}
        for place, sample in enumerate(other.samples):
            if id(sample) in known:
                other._single[place] = known[id(sample)]
        return other

    def _cropped(self, samples: Sequence[AnySample], crop: float | None) -> Sequence[AnySample]:
        if crop is None:
            return samples
        tile_size = int(getattr(self.blur.config, "tile_size", 16))
        return [smaller(sample, crop, tile_size) for sample in samples]

    def map(self, function: Callable[[Problem, T], R], items: Sequence[T]) -> list[R]:
        """Return `function(problem, item)` for items that do not depend on each other, in order.

        Here one is done after the other; the workers of a cluster do as many as they are at a time.

        Args:
            function: A function of a module, or a `functools.partial` of one.
            items: Plain values and tensors.
        """
        return [function(self, item) for item in items]

    def losses(
        self,
        values: Mapping[str, Any],
        count: int,
        chosen: Sequence[int] | None = None,
        *,
        unroll: int | None = None,
    ) -> Iterator[Tensor]:
        """Yield parts of the objective of K parameter sets, (K,) each; their sum is the objective.

        The parts come one by one, so that a caller can go backward through each and forget it.
        With another reduction than the mean all windows are filtered once without a graph, to
        find those that count for each set, and those again with one, if gradients are wanted.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
            chosen: Positions of the windows that count; all if left out.
            unroll: Of sequences: gradients go back through at most so many frames, and each part
                is the objective of so many. It changes no value.

        Differentiable: yes. A set whose image is not finite gets NaN, the others are unharmed.
        """
        weights: Tensor | None = None
        if self.objective.reduction != "mean":
            each = self.each(values, count, chosen)
            weights = tail_weights(each, self.objective)
            if not torch.is_grad_enabled():
                yield (weights * each).sum(dim=0)
                return
        yield from self.weighted(values, count, weights, chosen, unroll=unroll)

    def weighted(
        self,
        values: Mapping[str, Any],
        count: int,
        weights: Tensor | None,
        chosen: Sequence[int] | None = None,
        *,
        unroll: int | None = None,
    ) -> Iterator[Tensor]:
        """Yield parts of the sum of weight times objective over windows, (K,) each.

        Args:
            values: As `losses` takes them.
            count: K.
            weights: Of each window for each parameter set, (n, K); left out: the mean's.
            chosen: Positions of the windows that count; all if left out.
            unroll: As `losses` takes it.

        Differentiable: yes.
        """
        number = len(self.samples) if chosen is None else len(chosen)
        for places, group in self._groups_for(count, chosen):
            if weights is not None and not bool((weights[places] > 0).any()):
                continue
            for losses in group.parts(self.blur, values, self.free, unroll, self.meter):
                if weights is None:
                    yield (losses if count > 1 else losses.sum(dim=0, keepdim=True)) / number
                else:
                    rows = losses[None] if count > 1 else losses[:, None]
                    yield (rows * weights[places].to(rows)).sum(dim=0)
        if self.objective.cost > 0:
            ones = torch.ones(count, dtype=torch.float64)
            yield self._cost(values) * (ones if weights is None else weights.sum(dim=0))

    @torch.no_grad()
    def each(
        self, values: Mapping[str, Any], count: int = 1, chosen: Sequence[int] | None = None
    ) -> Tensor:
        """Return the objective of each window for K parameter sets, (n, K), float64, on the CPU.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
            chosen: Positions of the windows; all if left out.
        """
        found: dict[int, Tensor] = {}
        for places, group in self._groups_for(count, chosen):
            parts = [p.double().cpu() for p in group.parts(self.blur, values, self.free)]
            losses = torch.stack(parts).sum(dim=0)
            columns = losses[:, None] if count == 1 else losses[None]
            found |= zip(places, columns, strict=True)
        return torch.stack([found[place] for place in range(len(found))]) + self._cost(values)

    @torch.no_grad()
    def mean(self, values: Mapping[str, Any], count: int = 1) -> Tensor:
        """Return the objective of K parameter sets over all windows, (K,), float64, CPU.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
        """
        most = self.sets_per_call
        means = []
        for first in range(0, count, most):
            some = {n: _rows(value, first, most) for n, value in values.items()}
            parts = self.losses(some, min(most, count - first))
            means.append(torch.stack([part.double().cpu() for part in parts]).sum(dim=0))
        return torch.cat(means)

    def _cost(self, values: Mapping[str, Any]) -> float:
        """Return what the cost adds to the objective, of each window and of all."""
        weight = self.objective.cost
        return weight * cost_at(self.blur, values).relative if weight > 0 else 0.0

    def _groups_for(
        self, count: int, chosen: Sequence[int] | None
    ) -> Iterator[tuple[list[int], AnyGroup]]:
        """Yield windows that are filtered in one call, and where they stand among the chosen."""
        if count == 1 and chosen is None:
            yield from self._groups()
            return
        for place, position in enumerate(range(len(self.samples)) if chosen is None else chosen):
            if position not in self._single:
                self._single[position] = join([self.samples[position]], self.objective)
            yield [place], self._single[position]

    def _groups(self) -> list[tuple[list[int], AnyGroup]]:
        if self._joined is None:
            self._joined = [
                (places, join([self.samples[place] for place in places], self.objective))
                for places in self._alike()
            ]
        return self._joined

    def _alike(self) -> Iterator[list[int]]:
        """Yield positions of windows of one kind, as many as go into one call."""
        by_kind: dict[tuple[Any, ...], list[int]] = {}
        for place, sample in enumerate(self.samples):
            by_kind.setdefault(kind_of(sample), []).append(place)
        for places in by_kind.values():
            first = self.samples[places[0]]
            most = max(1, _budget(first) // (first.size[0] * first.size[1]))
            for start in range(0, len(places), most):
                yield places[start : start + most]


def _budget(sample: AnySample) -> int:
    """Return how many pixels one call may have on the window's device."""
    return _PIXELS_PER_BATCH.get(sample.device.type, _PIXELS_PER_BATCH["cpu"])


def _rows(value: Any, first: int, count: int) -> Any:
    """Return some of a batch of values; a value for all sets stays as it is."""
    is_batch = isinstance(value, Tensor) and value.ndim == 1
    return value[first : first + count] if is_batch else value
