"""Frames with their references: scenes, given or drawn, rendered once and cached; EXR files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchblur.errors import ConfigError, FileFormatError
from torchblur.frame import Frame
from torchblur.io import read_frame, read_image
from torchblur.metrics import border_band
from torchblur.render import Scene, load_scene, render_frame, render_reference
from tuning.config.data import (
    DataItem,
    DataSpec,
    ExrData,
    ExrStreamData,
    FamilyData,
    FamilyStreamData,
    SceneData,
    SceneStreamData,
)
from tuning.data.cache import cache_key, cached, frame_of, planes_of
from tuning.data.cases import AnyCase, Case, refuse_repeats, with_unique_names
from tuning.data.families import drawn_scenes
from tuning.data.framing import cached_box, seen_through, view_of
from tuning.data.streams import ExrStreamJob, SceneStreamJob
from tuning.files.frame_numbers import frame_numbers, numbered_file

__all__ = ["draw_cases", "load_cases"]


def load_cases(
    spec: DataSpec,
    *,
    device: torch.device | str = "cpu",
    report: Callable[[int, int, str], None] | None = None,
) -> list[AnyCase]:
    """Render or read all frames and sequences.

    Args:
        spec: A resolved data specification (`root` is absolute).
        device: Where the tensors go.
        report: Called with (done, total, name of the next case).

    Returns:
        The cases, training first. Rendered scenes are kept in `cache_folder()`.

    Raises:
        ConfigError: a frame that stands twice, or in both splits.
        TorchblurError: a file that is missing or cannot be read.
    """
    jobs = [
        (split, key, item, job)
        for split, items in (("train", spec.train), ("holdout", spec.holdout))
        for key, item in ((f"data.{split}.{i}", item) for i, item in enumerate(items))
        for job in _jobs(Path(spec.root), item, key)
    ]
    cases: list[AnyCase] = []
    for index, (split, key, item, job) in enumerate(jobs):
        if report is not None:
            report(index, len(jobs), job.name)
        cases.append(_of_item(job.load(split).to(device), key, item))
    refuse_repeats(cases)
    return with_unique_names(cases)


def draw_cases(root: str, key: str, item: FamilyData | FamilyStreamData) -> list[AnyCase]:
    """Render scenes of a family for the fit, beside those that `load_cases` returned.

    Args:
        root: What the item's path is relative to.
        key: Of the item in the configuration.
        item: Which scenes, and how they are rendered.
    """
    jobs = _jobs(Path(root), item, key)
    return [_of_item(job.load("train"), key, item) for job in jobs]


def _of_item(case: AnyCase, key: str, item: DataItem) -> AnyCase:
    """Return a case that knows which item it comes from, and of how large an image it is."""
    if item.lines is not None and item.lines < case.size[0]:
        raise ConfigError(
            f"`lines` is the height of the whole image and must be at least the frame's, "
            f"{case.size[0]} px, got {item.lines} ({key}.lines: {case.name})"
        )
    return dataclasses.replace(case, item=key, weight=item.weight, of_lines=item.lines)


# -- one case --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _SceneJob:
    stem: str
    scene: Scene
    item: SceneData
    time: float

    @property
    def name(self) -> str:
        return f"{self.stem} {self.time:g}{self.item.suffix}"

    def load(self, split: str) -> Case:
        box = cached_box(self.scene, self.item, self.time, self.item.exposure)
        scene = seen_through(self.scene, self.item, box)
        settings = self.item.model_dump(exclude={"path", "frames", "weight", "of", "at"})
        key = cache_key(scene.fingerprint(), settings, self.time)
        tensors = cached(key, lambda: self._render(scene))
        scene_key = self.scene.fingerprint()
        frame = frame_of(tensors, "frame", self.name)
        return Case(
            name=self.name,
            split=split,
            frame=frame,
            reference=tensors["reference"],
            variance=tensors["variance"],
            band=border_band(frame, self.item.exposure),
            shutter=self.item.exposure,
            identity=f"{scene_key} {self.time}",
            origin=scene_key,
            view=view_of(self.item, box),
        )

    def _render(self, scene: Scene) -> dict[str, Tensor]:
        item = self.item
        size = item.height_width
        frame = render_frame(scene, size, frame=self.time, color_spp=item.color_spp, seed=item.seed)
        # The sharp color and the reference must not share their noise.
        reference = render_reference(
            scene, size, spp=item.spp, shutter=item.exposure, frame=self.time, seed=item.seed + 1
        )
        layers = planes_of(frame, "frame")
        return layers | {"reference": reference.mean, "variance": reference.variance}


@dataclass(frozen=True, kw_only=True)
class _ExrJob:
    folder: Path
    item: ExrData
    number: int | None

    @property
    def name(self) -> str:
        stem = numbered_file(self.item.reference, self.number).removesuffix(".exr")
        short = stem.removeprefix("reference").strip("._")
        return f"{self.folder.name} {short}".strip()

    def load(self, split: str) -> Case:
        sharp = self._file(self.item.sharp)
        frame = self._frame(sharp)
        reference = read_image(self._file(self.item.reference))
        if reference.shape != frame.color.shape:
            raise FileFormatError(
                f"the reference must have the size of the sharp frame, {_size(frame.color)}, got "
                f"{_size(reference)} ({self._file(self.item.reference)})"
            )
        return Case(
            name=self.name,
            split=split,
            frame=frame,
            reference=reference,
            variance=None,
            band=border_band(frame, self.item.exposure),
            shutter=self.item.exposure,
            identity=hashlib.sha256(sharp.read_bytes()).hexdigest(),
            origin=f"{self.folder.resolve()}/{self.item.sharp}",
        )

    def _frame(self, sharp: Path) -> Frame:
        gbuffer = None if self.item.gbuffer is None else self._file(self.item.gbuffer)
        return read_frame(sharp, self.item.convention, gbuffer=gbuffer)

    def _file(self, pattern: str) -> Path:
        return self.folder / numbered_file(pattern, self.number)


_AnyJob = _SceneJob | _ExrJob | SceneStreamJob | ExrStreamJob


def _jobs(root: Path, item: DataItem, key: str) -> Iterator[_AnyJob]:
    path = root / item.path
    if isinstance(item, (ExrData, ExrStreamData)):
        if not path.is_dir():
            raise ConfigError(f"the folder {path} does not exist{_neighbors(path)} ({key}.path)")
        yield from _file_jobs(path, item, key)
        return
    if not path.is_file():
        kind = item.kind.removesuffix("_stream")
        raise ConfigError(f"the {kind} {path} does not exist{_neighbors(path)} ({key}.path)")
    if isinstance(item, (FamilyData, FamilyStreamData)):
        for stem, scene, one in drawn_scenes(path, item):
            yield from _scene_jobs(stem, scene, one)
    else:
        yield from _scene_jobs(path.stem, load_scene(path), item)


def _scene_jobs(stem: str, scene: Scene, item: SceneData | SceneStreamData) -> Iterator[_AnyJob]:
    if isinstance(item, SceneStreamData):
        yield SceneStreamJob(stem=stem, scene=scene, item=item)
        return
    for time in item.frames:
        yield _SceneJob(stem=stem, scene=scene, item=item, time=time)


def _file_jobs(folder: Path, item: ExrData | ExrStreamData, key: str) -> Iterator[_AnyJob]:
    if isinstance(item, ExrStreamData):
        numbers = item.frames or frame_numbers(folder, item.stream[0], f"{key}.stream")
        yield ExrStreamJob(folder=folder, item=item, numbers=tuple(numbers))
        return
    for number in _exr_numbers(folder, item, key):
        yield _ExrJob(folder=folder, item=item, number=number)


def _exr_numbers(folder: Path, item: ExrData, key: str) -> Sequence[int | None]:
    if "#" not in item.sharp:
        if item.frames is not None:
            raise ConfigError(f"`frames` needs #### in `sharp`, got {item.sharp!r} ({key}.frames)")
        return [None]
    return item.frames or frame_numbers(folder, item.sharp, f"{key}.sharp")


def _neighbors(path: Path) -> str:
    parent = path.parent
    while not parent.is_dir():
        parent = parent.parent
    names = sorted(entry.name for entry in parent.iterdir())[:12]
    return f"; in {parent}: {', '.join(names) or 'nothing'}"


def _size(image: Tensor) -> str:
    return f"{image.shape[-1]}x{image.shape[-2]}"
