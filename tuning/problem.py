"""What a fit minimizes: the objective of a filter's parameters over a set of windows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from tuning.config import ObjectiveSpec
from tuning.groups import AnyGroup, join, kind_of
from tuning.windows import AnySample

__all__ = ["Problem"]

_PIXELS_PER_BATCH = {"cpu": 1 << 18, "cuda": 1 << 23}


class Problem:
    """The objective over windows, for one set of parameters or for many at once.

    Each sequence counts as much as each single frame. With many sets each window is filtered with
    all of them in one call; with one set as many windows as fit are filtered in one call.

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
        self._single: dict[int, AnyGroup] = {}
        self._joined: list[AnyGroup] | None = None

    def losses(
        self,
        values: Mapping[str, Any],
        count: int,
        chosen: Sequence[int] | None = None,
        *,
        unroll: int | None = None,
    ) -> Iterator[Tensor]:
        """Yield parts of the mean objective of K parameter sets, (K,) each; their sum is the mean.

        The parts come one by one, so that a caller can go backward through each and forget it.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
            chosen: Positions of the windows that count; all if left out.
            unroll: Of sequences: gradients go back through at most so many frames, and each part
                is the objective of so many. It changes no value.

        Differentiable: yes. A set whose image is not finite gets NaN, the others are unharmed.
        """
        positions = range(len(self.samples)) if chosen is None else chosen
        groups = (
            self._groups_of_one(positions) if count > 1 or chosen is not None else self._groups()
        )
        total = len(positions)
        for group in groups:
            for losses in group.parts(self.blur, values, self.free, unroll):
                yield (losses if count > 1 else losses.sum(dim=0, keepdim=True)) / total

    @torch.no_grad()
    def mean(self, values: Mapping[str, Any], count: int = 1) -> Tensor:
        """Return the mean objective of K parameter sets over all windows, (K,), float64, CPU.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
        """
        largest = max(s.size[0] * s.size[1] for s in self.samples)
        most = max(1, _budget(self.samples[0]) // largest)
        means = []
        for first in range(0, count, most):
            some = {n: _rows(value, first, most) for n, value in values.items()}
            parts = self.losses(some, min(most, count - first))
            means.append(torch.stack([part.double().cpu() for part in parts]).sum(dim=0))
        return torch.cat(means)

    def _groups_of_one(self, positions: Sequence[int]) -> Iterator[AnyGroup]:
        for position in positions:
            if position not in self._single:
                self._single[position] = join([self.samples[position]], self.objective)
            yield self._single[position]

    def _groups(self) -> list[AnyGroup]:
        if self._joined is None:
            self._joined = [join(samples, self.objective) for samples in self._alike()]
        return self._joined

    def _alike(self) -> Iterator[list[AnySample]]:
        """Yield windows of one kind, as many as go into one call."""
        by_kind: dict[tuple[Any, ...], list[AnySample]] = {}
        for sample in self.samples:
            by_kind.setdefault(kind_of(sample), []).append(sample)
        for samples in by_kind.values():
            first = samples[0]
            most = max(1, _budget(first) // (first.size[0] * first.size[1]))
            for start in range(0, len(samples), most):
                yield samples[start : start + most]


def _budget(sample: AnySample) -> int:
    """Return how many pixels one call may have on the window's device."""
    return _PIXELS_PER_BATCH.get(sample.device.type, _PIXELS_PER_BATCH["cpu"])


def _rows(value: Any, first: int, count: int) -> Any:
    """Return some of a batch of values; a value for all sets stays as it is."""
    is_batch = isinstance(value, Tensor) and value.ndim == 1
    return value[first : first + count] if is_batch else value
