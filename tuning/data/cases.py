"""Frames and sequences beside their references, and which of them may stand together."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Hashable
from collections.abc import Sequence as Several
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter
from torchblur.frame import Frame, FrameSequence, Shutter

__all__ = ["AnyCase", "Case", "SequenceCase", "check_needs", "refuse_repeats", "with_unique_names"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One frame with its reference.

    Args:
        name: Unique name, for tables: file and frame number.
        split: "train" or "holdout".
        frame: The sharp frame, a batch of 1.
        reference: Scene-linear radiance, (1, 3, H, W).
        variance: Variance of the reference, (1, 3, H, W), if it is known.
        band: Band at moving borders, bool, (1, 1, H, W).
        shutter: The shutter that the reference was made with.
        identity: Hash of the sharp frame's source; equal for copies of one frame.
        origin: Hash of the scene, or the folder and file pattern: equal for frames of a sequence.
        view: What part of the frame it shows, if it is a window: others of it are no repetition.
        item: Key of the data's item that it comes from; equal for frames that share its weight.
        weight: Of that item, if it has one.
        of_lines: Height of the camera's whole image, px, if it is a window of one.
    """

    name: str
    split: str
    frame: Frame
    reference: Tensor
    variance: Tensor | None
    band: Tensor
    shutter: Shutter
    identity: str
    origin: str
    view: str = ""
    item: str = ""
    weight: float | None = None
    of_lines: int | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.frame.size

    @property
    def lines(self) -> int:
        """Height of the camera's whole image, px."""
        return self.of_lines or self.size[0]

    @property
    def identities(self) -> tuple[str, ...]:
        """Its identity alone."""
        return (self.identity,)

    @property
    def repeats(self) -> tuple[Hashable, ...]:
        """What no other case of the same split may have."""
        return ((self.identity, self.shutter, self.view),)

    def steps(self, blur: BlurFilter | None = None) -> tuple[tuple[Frame, ...], ...]:
        """Return what any filter is given: the frame."""
        return ((self.frame,),)

    def to(self, device: torch.device | str) -> Case:
        """Return the case with its tensors on another device."""
        return dataclasses.replace(
            self,
            frame=self.frame.to(device),
            reference=self.reference.to(device),
            variance=None if self.variance is None else self.variance.to(device),
            band=self.band.to(device),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceCase:
    """Consecutive frames with their references.

    Args:
        name: Unique name, for tables.
        split: "train" or "holdout".
        samples: The stream, each pixel with its own time: one sequence for each sample per pixel,
            all of the same pixels.
        sharp: The frames at the middle of the shutter, if there are any.
        references: Scene-linear radiance of each frame, (1, 3, H, W).
        variances: Variance of each reference, (1, 3, H, W), if it is known.
        bands: Band at moving borders of each frame, bool, (1, 1, H, W).
        shutter: The shutter of the samples' times and of the references.
        labels: Name of each frame: its number.
        warm_up: So many frames at the start are filtered and not scored.
        identities: Hash of each frame's source; equal for copies of one frame.
        origin: Hash of the scene, or the folder and file pattern.
        view: As in `Case`.
        seed: Seed of the stream: the same frames with another one are no repetition.
        item: As in `Case`.
        weight: As in `Case`.
        of_lines: As in `Case`.
    """

    name: str
    split: str
    samples: tuple[FrameSequence, ...]
    sharp: FrameSequence | None
    references: tuple[Tensor, ...]
    variances: tuple[Tensor, ...] | None
    bands: tuple[Tensor, ...]
    shutter: Shutter
    labels: tuple[str, ...]
    warm_up: int
    identities: tuple[str, ...]
    origin: str
    view: str = ""
    seed: int = 0
    item: str = ""
    weight: float | None = None
    of_lines: int | None = None

    def __len__(self) -> int:
        return len(self.references)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.samples[0][0].size

    @property
    def lines(self) -> int:
        """Height of the camera's whole image, px."""
        return self.of_lines or self.size[0]

    @property
    def middle(self) -> int:
        """Position of the frame that is shown of it: the middle one of those that are scored."""
        return (self.warm_up + len(self)) // 2

    @property
    def cuts(self) -> tuple[int, ...]:
        """Positions of frames that begin a new shot."""
        return self.samples[0].cuts

    @property
    def repeats(self) -> tuple[Hashable, ...]:
        """What no other case of the same split may have."""
        shared = (self.shutter, self.seed, self.view)
        return tuple((identity, *shared) for identity in self.identities)

    def steps(self, blur: BlurFilter | None = None) -> tuple[tuple[Frame, ...], ...]:
        """Return what a filter is given at each time step: one frame, or several of one place.

        A filter that needs `time` gets the samples. Any other gets the sharp frame, as one that
        knows of no times takes a frame to be of one instant; if there are none, the samples.

        Args:
            blur: The filter; the samples if left out.
        """
        if blur is not None and "time" not in blur.needs and self.sharp is not None:
            return tuple((frame,) for frame in self.sharp)
        return tuple(zip(*self.samples, strict=True))

    def to(self, device: torch.device | str) -> SequenceCase:
        """Return the case with its tensors on another device."""
        return dataclasses.replace(
            self,
            samples=tuple(s.map(lambda frame: frame.to(device)) for s in self.samples),
            sharp=None if self.sharp is None else self.sharp.map(lambda frame: frame.to(device)),
            references=tuple(r.to(device) for r in self.references),
            variances=None
            if self.variances is None
            else tuple(v.to(device) for v in self.variances),
            bands=tuple(band.to(device) for band in self.bands),
        )


AnyCase = Case | SequenceCase
_C = TypeVar("_C", Case, SequenceCase, AnyCase)


def check_needs(blur: BlurFilter, cases: Several[AnyCase]) -> None:
    """Refuse data without the layers that a filter needs.

    Args:
        blur: The filter.
        cases: All frames and sequences.

    Raises:
        ConfigError: naming the filter, the layers, the first case and what it has.
    """
    for case in cases:
        frames = case.steps(blur)[0]
        missing = [n for n in blur.needs if any(n not in frame.layers() for frame in frames)]
        if not missing:
            continue
        hint = "; items of kind scene_stream and exr_stream have it" if "time" in missing else ""
        raise ConfigError(
            f"{blur.name} needs the layer{'s' if len(missing) > 1 else ''} "
            f"{' and '.join(f'`{name}`' for name in missing)}, and data.{case.split} "
            f"{case.name!r} has {', '.join(frames[0].layers())}{hint}"
        )


def refuse_repeats(cases: Several[AnyCase]) -> None:
    """Refuse a frame that stands twice in a split, or in both; warn of a shared scene.

    Raises:
        ConfigError: naming both cases.
    """
    owners: dict[str, AnyCase] = {}
    seen: dict[tuple[str, Hashable], AnyCase] = {}
    for case in cases:
        for identity in case.identities:
            other = owners.setdefault(identity, case)
            if other.split != case.split:
                raise ConfigError(
                    f"the same frame is in data.train and data.holdout: {other.name!r} and "
                    f"{case.name!r}; a hold-out must be new to the fit"
                )
        for mark in case.repeats:
            twin = seen.setdefault((case.split, mark), case)
            if twin is not case:
                raise ConfigError(
                    f"the same frame stands twice in data.{case.split}: {twin.name!r} and "
                    f"{case.name!r}"
                )
    shared = {c.origin for c in cases if c.split == "train"} & {
        c.origin for c in cases if c.split == "holdout"
    }
    if shared:
        names = ", ".join(c.name for c in cases if c.split == "holdout" and c.origin in shared)
        warnings.warn(
            f"the hold-out has frames of scenes that are fitted at other times: {names}; "
            "its figures say little about new scenes",
            stacklevel=3,
        )


def with_unique_names(cases: Several[_C]) -> list[_C]:
    """Return the cases with a number after a name that was there before."""
    names = [case.name for case in cases]
    result: list[_C] = []
    for index, case in enumerate(cases):
        repeat = names[:index].count(case.name)
        name = f"{case.name} ({repeat + 1})" if repeat else case.name
        result.append(dataclasses.replace(case, name=name))
    return result
