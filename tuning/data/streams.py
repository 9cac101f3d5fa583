"""Sequences of stochastic frames with their references: rendered scenes, and EXR files."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Iterable
from collections.abc import Sequence as Several
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from torchblur.errors import ConfigError, FileFormatError
from torchblur.frame import Frame, FrameSequence
from torchblur.io import read_frame, read_image
from torchblur.metrics import border_band
from torchblur.render import Scene, render_frame, render_reference, render_stream
from tuning.config.data import ExrStreamData, SceneStreamData
from tuning.data.cache import cache_key, cached, frame_of, planes_of
from tuning.data.cases import SequenceCase
from tuning.data.framing import cached_box, seen_through, view_of
from tuning.files.frame_numbers import numbered_file

__all__ = ["ExrStreamJob", "SceneStreamJob", "shot_starts"]


@dataclass(frozen=True, kw_only=True)
class SceneStreamJob:
    """A sequence of a scene that is to be rendered.

    Args:
        stem: Name of the scene.
        scene: The scene.
        item: How.
    """

    stem: str
    scene: Scene
    item: SceneStreamData

    @property
    def name(self) -> str:
        """Name of the case: scene and frame numbers."""
        return f"{self.stem} {_span(self.item.frames)}{self.item.suffix}"

    def load(self, split: str) -> SequenceCase:
        """Render the frames that the cache does not have.

        Raises:
            ConfigError: a cut that is no frame.
        """
        item, scene_key = self.item, self.scene.fingerprint()
        middle = float(item.frames[len(item.frames) // 2])
        box = cached_box(self.scene, item, middle, item.exposure)
        scene = seen_through(self.scene, item, box)
        kept = self._kept(scene)
        sources = [f"{self.stem} {number}" for number in item.frames]
        cuts = shot_starts(item.frames, item.cuts, self.name)
        sharp = [frame_of(t, "sharp", s) for t, s in zip(kept, sources, strict=True)]
        streams = (
            [frame_of(t, f"stream{k}", s) for t, s in zip(kept, sources, strict=True)]
            for k in range(item.stream_spp)
        )
        return SequenceCase(
            name=self.name,
            split=split,
            samples=tuple(FrameSequence(tuple(frames), cuts) for frames in streams),
            sharp=FrameSequence(tuple(sharp), cuts),
            references=tuple(tensors["reference"] for tensors in kept),
            variances=tuple(tensors["variance"] for tensors in kept),
            bands=tuple(border_band(frame, item.exposure) for frame in sharp),
            shutter=item.exposure,
            labels=tuple(str(number) for number in item.frames),
            warm_up=_warm_up(item.warm_up, len(kept), self.name),
            identities=tuple(f"{scene_key} {float(number)}" for number in item.frames),
            origin=scene_key,
            view=view_of(item, box),
            seed=item.seed,
        )

    def _kept(self, scene: Scene) -> list[dict[str, Tensor]]:
        """Return what the cache has of all frames, or is given now."""
        apart = {"path", "frames", "cuts", "warm_up", "weight", "of", "at"}
        settings, scene_key = self.item.model_dump(exclude=apart), scene.fingerprint()
        return [
            cached(
                cache_key(scene_key, settings, float(number)),
                functools.partial(self._render, scene, float(number)),
            )
            for number in self.item.frames
        ]

    def _render(self, scene: Scene, time: float) -> dict[str, Tensor]:
        item = self.item
        size, shutter = item.height_width, item.exposure
        stream = render_stream(
            scene, size, frame=time, shutter=shutter, spp=item.stream_spp, seed=item.seed
        )
        # Stream, sharp color and reference must not share their noise.
        sharp = render_frame(scene, size, frame=time, color_spp=item.color_spp, seed=item.seed + 1)
        reference = render_reference(
            scene,
            size,
            spp=item.spp,
            shutter=shutter,
            frame=time,
            seed=item.seed + 2,
            pixel=item.pixel,
        )
        tensors = {"reference": reference.mean, "variance": reference.variance}
        tensors |= planes_of(sharp, "sharp")
        for index, frame in enumerate(stream):
            tensors |= planes_of(frame, f"stream{index}")
        return tensors


@dataclass(frozen=True, kw_only=True)
class ExrStreamJob:
    """A sequence that is to be read.

    Args:
        folder: Where the files lie.
        item: How they are called.
        numbers: Frame numbers, rising.
    """

    folder: Path
    item: ExrStreamData
    numbers: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the case: folder and frame numbers."""
        return f"{self.folder.name} {_span(self.numbers)}"

    def load(self, split: str) -> SequenceCase:
        """Read the files.

        Raises:
            ConfigError: a cut that is no frame.
            FileFormatError: a file that is missing or damaged, or of another size.
        """
        item = self.item
        cuts = shot_starts(self.numbers, item.cuts, self.name)
        samples = tuple(FrameSequence(self._frames(pattern), cuts) for pattern in item.stream)
        sharp = None if item.center is None else FrameSequence(self._frames(item.center), cuts)
        size = samples[0][0].size
        for frame in itertools.chain(*samples, sharp or ()):
            _check_size(frame.color, size, frame.source)
        references = []
        for path in self._paths(item.reference):
            references.append(read_image(path))
            _check_size(references[-1], size, str(path))
        # Stray samples of a stream at a moving border make the band a little wider.
        at_borders = samples[0] if sharp is None else sharp
        return SequenceCase(
            name=self.name,
            split=split,
            samples=samples,
            sharp=sharp,
            references=tuple(references),
            variances=None,
            bands=tuple(border_band(frame, item.exposure) for frame in at_borders),
            shutter=item.exposure,
            labels=tuple(str(number) for number in self.numbers),
            warm_up=_warm_up(item.warm_up, len(references), self.name),
            identities=tuple(_hash(path) for path in self._paths(item.stream[0])),
            origin=f"{self.folder.resolve()}/{item.stream[0]}",
        )

    def _paths(self, pattern: str) -> list[Path]:
        return [self.folder / numbered_file(pattern, number) for number in self.numbers]

    def _frames(self, pattern: str) -> tuple[Frame, ...]:
        return tuple(read_frame(path, self.item.convention) for path in self._paths(pattern))


def shot_starts(numbers: Several[int], cuts: Iterable[int], place: str) -> tuple[int, ...]:
    """Return the positions of frames that begin a new shot: at cuts, and where numbers are missing.

    Args:
        numbers: Frame numbers, rising.
        cuts: Numbers of frames that begin a new shot.
        place: Name for the message.

    Raises:
        ConfigError: a cut that is no frame.
    """
    missing = [cut for cut in cuts if cut not in numbers]
    if missing:
        raise ConfigError(
            f"`cuts` must be numbers of frames, {_span(numbers)}, got {missing[0]} ({place})"
        )
    marked = set(cuts)
    return tuple(
        index
        for index, (before, number) in enumerate(itertools.pairwise(numbers), start=1)
        if number in marked or number != before + 1
    )


def _warm_up(warm_up: int, count: int, place: str) -> int:
    if warm_up >= count:
        raise ConfigError(
            f"`warm_up` must leave a frame to be scored: {place} has {count} frames, got {warm_up}"
        )
    return warm_up


def _check_size(image: Tensor, size: tuple[int, int], path: str) -> None:
    if tuple(image.shape[-2:]) != size:
        raise FileFormatError(
            f"all images of a sequence must have one size: the first is {size[1]}x{size[0]}, "
            f"{path} is {image.shape[-1]}x{image.shape[-2]}"
        )


def _span(numbers: Several[int]) -> str:
    return f"{numbers[0]}" if len(numbers) == 1 else f"{numbers[0]}-{numbers[-1]}"


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
