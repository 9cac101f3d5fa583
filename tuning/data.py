"""Frames with their references: scenes, rendered once and cached, and EXR files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchblur.render
from torchblur.errors import ConfigError, FileFormatError
from torchblur.frame import Frame, Shutter
from torchblur.io import read_frame, read_image
from torchblur.metrics import border_band
from torchblur.render import load_scene, render_frame, render_reference
from tuning.config import DataItem, DataSpec, ExrData, SceneData

__all__ = ["Case", "cache_folder", "load_cases"]


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

    def to(self, device: torch.device | str) -> Case:
        """Return the case with its tensors on another device."""
        return dataclasses.replace(
            self,
            frame=self.frame.to(device),
            reference=self.reference.to(device),
            variance=None if self.variance is None else self.variance.to(device),
            band=self.band.to(device),
        )


def load_cases(
    spec: DataSpec,
    *,
    device: torch.device | str = "cpu",
    report: Callable[[int, int, str], None] | None = None,
) -> list[Case]:
    """Render or read all frames.

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
        (split, job)
        for split, items in (("train", spec.train), ("holdout", spec.holdout))
        for index, item in enumerate(items)
        for job in _jobs(Path(spec.root), item, f"data.{split}.{index}")
    ]
    cases: list[Case] = []
    for index, (split, job) in enumerate(jobs):
        if report is not None:
            report(index, len(jobs), job.name)
        cases.append(job.load(split).to(device))
    _refuse_repeats(cases)
    return _with_unique_names(cases)


def cache_folder() -> Path:
    """Return where rendered frames are kept.

    TORCHBLUR_CACHE, or `torchblur` in XDG_CACHE_HOME, or `~/.cache/torchblur`.
    """
    if own := os.environ.get("TORCHBLUR_CACHE"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "torchblur"


# -- one case --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _SceneJob:
    path: Path
    item: SceneData
    time: float

    @property
    def name(self) -> str:
        return f"{self.path.stem} {self.time:g}"

    def load(self, split: str) -> Case:
        scene_key = _hash_scene(self.path)
        tensors = _cached(self._key(scene_key), self._render)
        layers: dict[str, Any] = {
            k.removeprefix("frame."): v for k, v in tensors.items() if k.startswith("frame.")
        }
        frame = Frame(**layers, source=self.name)
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
        )

    def _key(self, scene_key: str) -> str:
        settings = self.item.model_dump(exclude={"path", "frames"})
        parts = [scene_key, json.dumps(settings, sort_keys=True), repr(self.time), _renderer_hash()]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]

    def _render(self) -> dict[str, Tensor]:
        item, scene = self.item, load_scene(self.path)
        size = item.height_width
        frame = render_frame(scene, size, frame=self.time, color_spp=item.color_spp, seed=item.seed)
        # The sharp color and the reference must not share their noise.
        reference = render_reference(
            scene, size, spp=item.spp, shutter=item.exposure, frame=self.time, seed=item.seed + 1
        )
        tensors = {f"frame.{name}": layer for name, layer in frame.layers().items()}
        return tensors | {"reference": reference.mean, "variance": reference.variance}


@dataclass(frozen=True, kw_only=True)
class _ExrJob:
    folder: Path
    item: ExrData
    number: int | None

    @property
    def name(self) -> str:
        stem = _numbered(self.item.reference, self.number).removesuffix(".exr")
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
        return self.folder / _numbered(pattern, self.number)


def _jobs(root: Path, item: DataItem, key: str) -> Iterator[_SceneJob | _ExrJob]:
    path = root / item.path
    if isinstance(item, SceneData):
        if not path.is_file():
            raise ConfigError(f"the scene {path} does not exist{_neighbors(path)} ({key}.path)")
        for time in item.frames:
            yield _SceneJob(path=path, item=item, time=time)
        return
    if not path.is_dir():
        raise ConfigError(f"the folder {path} does not exist{_neighbors(path)} ({key}.path)")
    for number in _frame_numbers(path, item, key):
        yield _ExrJob(folder=path, item=item, number=number)


def _frame_numbers(folder: Path, item: ExrData, key: str) -> Sequence[int | None]:
    if "#" not in item.sharp:
        if item.frames is not None:
            raise ConfigError(f"`frames` needs #### in `sharp`, got {item.sharp!r} ({key}.frames)")
        return [None]
    if item.frames is not None:
        return item.frames
    name = re.sub(r"\\?#(\\?#)*", r"(\\d+)", re.escape(item.sharp))
    found = [m for f in folder.iterdir() if (m := re.fullmatch(name, f.name))]
    if not found:
        raise ConfigError(f"no file in {folder} is called {item.sharp} ({key}.sharp)")
    return sorted(int(match[1]) for match in found)


def _numbered(pattern: str, number: int | None) -> str:
    if number is None:
        return pattern
    return re.sub("#+", lambda match: str(number).zfill(len(match[0])), pattern)


def _neighbors(path: Path) -> str:
    parent = path.parent
    while not parent.is_dir():
        parent = parent.parent
    names = sorted(entry.name for entry in parent.iterdir())[:12]
    return f"; in {parent}: {', '.join(names) or 'nothing'}"


def _size(image: Tensor) -> str:
    return f"{image.shape[-1]}x{image.shape[-2]}"


def _refuse_repeats(cases: Sequence[Case]) -> None:
    seen: dict[tuple[str, Shutter], Case] = {}
    for case in cases:
        for other in seen.values():
            if other.split != case.split and other.identity == case.identity:
                raise ConfigError(
                    f"the same frame is in data.train and data.holdout: {other.name!r} and "
                    f"{case.name!r}; a hold-out must be new to the fit"
                )
        key = (case.identity, case.shutter)
        if key in seen:
            raise ConfigError(
                f"the same frame stands twice in data.{case.split}: {seen[key].name!r} and "
                f"{case.name!r}"
            )
        seen[key] = case
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


def _with_unique_names(cases: Sequence[Case]) -> list[Case]:
    names = [case.name for case in cases]
    result = []
    for index, case in enumerate(cases):
        repeat = names[:index].count(case.name)
        name = f"{case.name} ({repeat + 1})" if repeat else case.name
        result.append(dataclasses.replace(case, name=name))
    return result


# -- cache -----------------------------------------------------------------------------------------


def _cached(key: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    path = cache_folder() / "frames" / f"{key}.pt"
    if path.is_file():
        try:
            stored: dict[str, Tensor] = torch.load(path, weights_only=True)
            return stored
        except Exception as error:
            warnings.warn(f"{path} cannot be read ({error}); rendering again", stacklevel=2)
    tensors = {name: tensor.contiguous() for name, tensor in make().items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
        torch.save(tensors, temporary)
        temporary.replace(path)
    except OSError as error:
        warnings.warn(f"rendered frames are not kept: {error}", stacklevel=2)
    return tensors


def _hash_scene(path: Path) -> str:
    """Return the hash of a scene file and of the files that it names."""
    scene = load_scene(path)
    digest = hashlib.sha256(scene.model_dump_json().encode())
    for text in _strings(scene.model_dump()):
        file = path.parent / text
        if len(text) < os.pathconf("/", "PC_NAME_MAX") and file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()[:32]


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for item in value.values():
            yield from _strings(item)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _strings(item)


def _renderer_hash() -> str:
    """Return the hash of the renderer's source: another renderer, another image."""
    digest = hashlib.sha256()
    for folder in torchblur.render.__path__:
        for file in sorted(Path(folder).glob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()
