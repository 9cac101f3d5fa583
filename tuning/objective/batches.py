"""Windows of one size that are filtered in one call, and the objective of what comes out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from tuning.config.objective import ObjectiveSpec
from tuning.data.blurring import arguments, blurred, blurred_sequence
from tuning.objective.cpu_time import Meter
from tuning.objective.terms import PreparedObjective
from tuning.objective.windows import AnySample, Sample, SequenceSample

__all__ = ["AnyGroup", "FrameGroup", "SequenceGroup", "join", "kind_of"]

Inner = tuple[tuple[int, int, int, int], ...]


@dataclass(frozen=True, eq=False)
class FrameGroup:
    """Windows of single frames; the objective of each is that times its weight."""

    frame: Frame
    weight: Tensor
    shutter: Tensor
    position: str
    inner: Inner
    objective: PreparedObjective

    def parts(
        self,
        blur: BlurFilter,
        values: Mapping[str, Any],
        free: Sequence[str],
        unroll: int | None = None,
        meter: Meter | None = None,
    ) -> Iterator[Tensor]:
        """Yield the objective of each window, or of each parameter set, (M,) or (K,)."""
        meter = meter or Meter()
        meter.enter("filter")
        image = blurred(blur, self.frame, self.shutter, self.position, values, free)
        safe, finite = _scored(image, self.inner)
        meter.on_the_way_back(safe, "filter")
        meter.enter("metric")
        yield _checked(self.objective(safe), finite) * self.weight.to(safe)


@dataclass(frozen=True, eq=False)
class SequenceGroup:
    """Windows of sequences; the parts of their objective are those of up to k frames each."""

    weight: Tensor
    steps: tuple[tuple[Frame, ...], ...]
    cuts: tuple[int, ...]
    warm_up: int
    shutter: Tensor
    position: str
    inner: Inner
    objectives: tuple[PreparedObjective, ...]

    @property
    def pairs(self) -> tuple[int, ...]:
        """Positions of frames whose change counts: they and the one before are scored."""
        later = range(self.warm_up + 1, len(self.steps))
        return tuple(index for index in later if index not in self.cuts)

    def parts(
        self,
        blur: BlurFilter,
        values: Mapping[str, Any],
        free: Sequence[str],
        unroll: int | None = None,
        meter: Meter | None = None,
    ) -> Iterator[Tensor]:
        """Yield parts whose sum is the objective of each window or parameter set, (M,) or (K,).

        The memory is cut off from the graph where a part ends, so going backward through one part
        after the other is enough, and each can be forgotten.
        """
        meter = meter or Meter()
        meter.enter("filter")
        given = arguments(self.shutter, self.position, values, free, self.steps[0][0].device)
        images = blurred_sequence(blur, self.steps, self.cuts, given, unroll=unroll)
        total: Tensor | None = None
        before: Tensor | None = None
        for index, image in enumerate(images):
            safe, finite = _scored(image, self.inner)
            meter.on_the_way_back(safe, "filter")
            meter.enter("metric")
            loss = _checked(self._loss(index, safe, before), finite) * self.weight.to(safe)
            meter.on_the_way_back(loss, "metric")
            total = loss if total is None else total + loss
            before = safe
            if unroll is not None and (index + 1) % unroll == 0:
                yield total
                total, before = None, safe.detach()
            meter.enter("filter")
        if total is not None:
            yield total

    def _loss(self, index: int, image: Tensor, before: Tensor | None) -> Tensor:
        """Return what one frame adds to the objective."""
        loss = image.new_zeros(image.shape[0])
        if index < self.warm_up:
            return loss
        here = self.objectives[index]
        loss = loss + here(image) / (len(self.steps) - self.warm_up)
        if here.spec.temporal > 0 and index in self.pairs and before is not None:
            change = here.change(image, before, self.objectives[index - 1])
            loss = loss + here.spec.temporal * change / len(self.pairs)
        return loss


AnyGroup = FrameGroup | SequenceGroup


def kind_of(sample: AnySample) -> tuple[Any, ...]:
    """Return what windows must have in common to be filtered in one call."""
    common = (sample.size, sample.inner[2:], sample.shutter.position)
    if isinstance(sample, Sample):
        return (*common, _layers(sample.frame))
    steps = tuple(len(step) for step in sample.steps)
    layers = tuple(sorted({_layers(frame) for step in sample.steps for frame in step}))
    return (*common, layers, steps, sample.cuts, sample.warm_up)


def join(samples: Sequence[AnySample], spec: ObjectiveSpec) -> AnyGroup:
    """Return windows of one kind as one group.

    Args:
        samples: At least one; `kind_of` is the same for all.
        spec: What is measured.
    """
    first = samples[0]
    opens = [s.shutter.open for s in samples]
    shutter = torch.tensor(opens, dtype=torch.float64, device=first.device).view(-1, 1, 1, 1)
    weight = torch.tensor([s.weight for s in samples], dtype=torch.float64)
    inner = tuple(s.inner for s in samples)
    if isinstance(first, Sample):
        singles = [s for s in samples if isinstance(s, Sample)]
        return FrameGroup(
            frame=_stacked([s.frame for s in singles]),
            weight=weight,
            shutter=shutter,
            position=first.shutter.position,
            inner=inner,
            objective=_prepared(spec, [(s.reference, s.band) for s in singles]),
        )
    windows = [s for s in samples if isinstance(s, SequenceSample)]
    return SequenceGroup(
        weight=weight,
        steps=tuple(
            tuple(_stacked([w.steps[t][k] for w in windows]) for k in range(len(step)))
            for t, step in enumerate(first.steps)
        ),
        cuts=first.cuts,
        warm_up=first.warm_up,
        shutter=shutter,
        position=first.shutter.position,
        inner=inner,
        objectives=tuple(
            _prepared(spec, [(w.references[t], w.bands[t]) for w in windows])
            for t in range(len(first.steps))
        ),
    )


def _layers(frame: Frame) -> tuple[str, ...]:
    return tuple(sorted(frame.layers()))


def _stacked(frames: Sequence[Frame]) -> Frame:
    return frames[0] if len(frames) == 1 else Frame.stack(frames)


def _prepared(spec: ObjectiveSpec, pairs: Sequence[tuple[Tensor, Tensor]]) -> PreparedObjective:
    references, bands = zip(*pairs, strict=True)
    return PreparedObjective(spec, torch.cat(references), torch.cat(bands))


def _scored(image: Tensor, inner: Inner) -> tuple[Tensor, Tensor]:
    """Return the scored parts, zero where an image is not finite, and which images are finite."""
    rows = range(image.shape[0])
    places = inner if len(inner) > 1 else inner * len(rows)
    scored = torch.stack(
        [image[k, :, t : t + h, x : x + w] for k, (t, x, h, w) in zip(rows, places, strict=True)]
    )
    finite = torch.isfinite(scored).flatten(1).all(dim=1)
    return torch.where(finite.view(-1, 1, 1, 1), scored, torch.zeros_like(scored)), finite


def _checked(losses: Tensor, finite: Tensor) -> Tensor:
    return torch.where(finite, losses, torch.full_like(losses, torch.nan))
