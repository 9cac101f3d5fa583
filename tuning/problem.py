"""What a fit minimizes: the objective of a filter's parameters over a set of windows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from tuning.config import ObjectiveSpec
from tuning.objective import PreparedObjective, prepare_objective
from tuning.windows import Sample

__all__ = ["Problem", "blurred"]

_PIXELS_PER_BATCH = {"cpu": 1 << 18, "cuda": 1 << 23}


@dataclass(frozen=True, eq=False)
class _Group:
    """Windows of one size that are filtered in one call."""

    frame: Frame
    shutter: Tensor
    position: str
    inner: tuple[tuple[int, int, int, int], ...]
    objective: PreparedObjective

    @property
    def count(self) -> int:
        return len(self.inner)


class Problem:
    """The objective over windows, for one set of parameters or for many at once.

    With many sets each window is filtered with all of them in one call; with one set as many
    windows as fit are filtered in one call.

    Args:
        blur: The filter; its config has the fixed values.
        samples: The windows.
        objective: What is measured.
        free: Names of all free parameters; a shutter among them is not taken from the data.
    """

    def __init__(
        self,
        blur: BlurFilter,
        samples: Sequence[Sample],
        objective: ObjectiveSpec,
        free: Sequence[str] = (),
    ) -> None:
        self.blur = blur
        self.samples = tuple(samples)
        self.objective = objective
        self.free = tuple(free)
        self._single: dict[int, _Group] = {}
        self._joined: list[_Group] | None = None

    def losses(
        self, values: Mapping[str, Any], count: int, chosen: Sequence[int] | None = None
    ) -> Iterator[Tensor]:
        """Yield parts of the mean objective of K parameter sets, (K,) each; their sum is the mean.

        The parts come one by one, so that a caller can go backward through each and forget it.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
            chosen: Positions of the windows that count; all if left out.

        Differentiable: yes. A set whose image is not finite gets NaN, the others are unharmed.
        """
        positions = range(len(self.samples)) if chosen is None else chosen
        groups = (
            self._groups_of_one(positions) if count > 1 or chosen is not None else self._groups()
        )
        total = len(positions)
        for group in groups:
            losses = self._group_losses(group, values)
            yield (losses if count > 1 else losses.sum(dim=0, keepdim=True)) / total

    @torch.no_grad()
    def mean(self, values: Mapping[str, Any], count: int = 1) -> Tensor:
        """Return the mean objective of K parameter sets over all windows, (K,), float64, CPU.

        Args:
            values: (K,) tensors, or for K = 1 any single values, by name.
            count: K.
        """
        largest = max(s.frame.size[0] * s.frame.size[1] for s in self.samples)
        most = max(1, _budget(self.samples[0].frame) // largest)
        means = []
        for first in range(0, count, most):
            some = {n: _rows(value, first, most) for n, value in values.items()}
            parts = self.losses(some, min(most, count - first))
            means.append(torch.stack([part.double().cpu() for part in parts]).sum(dim=0))
        return torch.cat(means)

    def _group_losses(self, group: _Group, values: Mapping[str, Any]) -> Tensor:
        image = blurred(self.blur, group.frame, group.shutter, group.position, values, self.free)
        rows = range(image.shape[0])
        inner = group.inner if group.count > 1 else group.inner * len(rows)
        scored = torch.stack(
            [image[k, :, t : t + h, x : x + w] for k, (t, x, h, w) in zip(rows, inner, strict=True)]
        )
        finite = torch.isfinite(scored).flatten(1).all(dim=1)
        safe = torch.where(finite.view(-1, 1, 1, 1), scored, torch.zeros_like(scored))
        losses = group.objective(safe)
        return torch.where(finite, losses, torch.full_like(losses, torch.nan))

    def _groups_of_one(self, positions: Sequence[int]) -> Iterator[_Group]:
        for position in positions:
            if position not in self._single:
                self._single[position] = self._join([self.samples[position]])
            yield self._single[position]

    def _groups(self) -> list[_Group]:
        if self._joined is None:
            self._joined = [self._join(samples) for samples in self._alike()]
        return self._joined

    def _alike(self) -> Iterator[list[Sample]]:
        """Yield windows of one size and shutter position, as many as go into one call."""
        by_kind: dict[tuple[Any, ...], list[Sample]] = {}
        for sample in self.samples:
            layers = tuple(sorted(sample.frame.layers()))
            kind = (sample.frame.size, sample.inner[2:], sample.shutter.position, layers)
            by_kind.setdefault(kind, []).append(sample)
        for (size, *_), samples in by_kind.items():
            most = max(1, _budget(samples[0].frame) // (size[0] * size[1]))
            for first in range(0, len(samples), most):
                yield samples[first : first + most]

    def _join(self, samples: Sequence[Sample]) -> _Group:
        frame = samples[0].frame if len(samples) == 1 else Frame.stack([s.frame for s in samples])
        opens = [s.shutter.open for s in samples]
        return _Group(
            frame=frame,
            shutter=torch.tensor(opens, dtype=torch.float64, device=frame.device).view(-1, 1, 1, 1),
            position=samples[0].shutter.position,
            inner=tuple(s.inner for s in samples),
            objective=prepare_objective(
                self.objective,
                torch.cat([s.reference for s in samples]),
                torch.cat([s.band for s in samples]),
            ),
        )


def blurred(
    blur: BlurFilter,
    frame: Frame,
    shutter: Tensor | float,
    position: str,
    values: Mapping[str, Any],
    free: Sequence[str] = (),
) -> Tensor:
    """Return the filtered color with the data's shutter and single values, (B, 3, H, W).

    Args:
        blur: The filter.
        frame: A batch of M frames, or one frame for K sets of values.
        shutter: Open time as a fraction of a frame: a number, or (M, 1, 1, 1).
        position: The shutter's position.
        values: Values by name: (K,) tensors, numbers, or choices.
        free: Names of the free parameters; the shutter is left alone if it is one of them.
    """
    given: dict[str, Any] = {"shutter": shutter, "shutter_position": position}
    given = {key: value for key, value in given.items() if key not in free}
    for name, value in values.items():
        is_batch = isinstance(value, Tensor) and value.ndim == 1
        given[name] = value.to(frame.device).view(-1, 1, 1, 1) if is_batch else value
    result: Tensor = blur(frame, **given)
    return result


def _budget(frame: Frame) -> int:
    """Return how many pixels one call may have on the frame's device."""
    return _PIXELS_PER_BATCH.get(frame.device.type, _PIXELS_PER_BATCH["cpu"])


def _rows(value: Any, first: int, count: int) -> Any:
    """Return some of a batch of values; a value for all sets stays as it is."""
    is_batch = isinstance(value, Tensor) and value.ndim == 1
    return value[first : first + count] if is_batch else value
