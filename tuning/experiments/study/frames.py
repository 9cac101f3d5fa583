"""The frames of a study, one after the other: inputs, references, masks."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.frame import Frame, Shutter
from torchblur.io import read_frame, read_image
from torchblur.params import build
from torchblur.render import Renderer, Scene, load_scene, render_revealed
from torchblur.render.camera import Camera
from torchblur.render.compiling import Engine
from tuning.data.cache import cache_key, cached, frame_of, hash_scene, planes_of
from tuning.experiments.study.config import KEPT_SAMPLES, StudyExr, StudyScene
from tuning.files.frame_numbers import numbered_file

__all__ = ["Moment", "identity_of", "moments", "scene_of"]

_WORTH_COMPILING = 8  # frames
_HIDDEN_SPP = 32  # times at which the true set of revealed pixels is sampled


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One frame of some data.

    Args:
        index: Position, from 0.
        sharp: The frame at the middle of the shutter.
        samples: Frames of the stream, one for each of the first samples per pixel.
        raw: Mean color of the first n samples by n, (1, 3, H, W).
        estimated: Those n in `raw` that no renderer made: see `stand_in`.
        references: Scene-linear radiance by name, (1, 3, H, W).
        variances: Variance of the references, where it is known.
        revealed: What lies behind the nearest objects, if asked for.
        seen: Object ids and depths at many times of the shutter, (T, 1, H, W) each, for scenes
            whose revealed layer is asked for.
        shutter: Of the references and of the stream's times.
        first_of_shot: Whether nothing is known of what was before.
    """

    index: int
    sharp: Frame
    samples: tuple[Frame, ...]
    raw: Mapping[int, Tensor]
    estimated: frozenset[int]
    references: Mapping[str, Tensor]
    variances: Mapping[str, Tensor]
    revealed: Frame | None
    seen: tuple[Tensor, Tensor] | None
    shutter: Shutter
    first_of_shot: bool


def moments(item: StudyScene | StudyExr, raw: tuple[int, ...] = (1,)) -> Iterator[Moment]:
    """Render or read the frames of some data, one at a time.

    Args:
        item: The data, with an absolute path.
        raw: Numbers of samples per pixel whose mean color is wanted; of rendered streams there
            are all powers of two anyway.

    Raises:
        TorchblurError: a file that is missing or cannot be read.
    """
    for index in range(item.count):
        if isinstance(item, StudyScene):
            yield _rendered(item, index)
        else:
            yield _read(item, index, raw)


def identity_of(item: StudyScene | StudyExr) -> str:
    """Return what an item's frames depend on, as text: settings and contents of the scene."""
    return _scene_key(item.path) if isinstance(item, StudyScene) else _stamps(item)


# -- scenes ----------------------------------------------------------------------------------------


def _rendered(item: StudyScene, index: int) -> Moment:
    time = item.first + index
    settings = item.model_dump(
        mode="json", exclude={"name", "path", "first", "count", "cuts", "picture", "kind"}
    )
    key = cache_key(_scene_key(item.path), {"study": settings}, time)
    tensors = cached(key, lambda: _render(item, time))
    kept = min(item.stream_spp, KEPT_SAMPLES)
    seen = (tensors["seen.object_id"], tensors["seen.depth"]) if item.revealed else None
    return Moment(
        index=index,
        sharp=frame_of(tensors, "sharp", f"{item.name} {time:g}"),
        samples=tuple(
            frame_of(tensors, f"stream{k}", f"{item.name} {time:g}") for k in range(kept)
        ),
        raw={int(name[4:]): plane for name, plane in tensors.items() if name.startswith("mean")},
        estimated=frozenset(),
        references={name: tensors[f"reference.{name}"] for name in item.references},
        variances={name: tensors[f"variance.{name}"] for name in item.references},
        revealed=frame_of(tensors, "revealed", f"{item.name} revealed") if item.revealed else None,
        seen=seen,
        shutter=item.exposure,
        first_of_shot=index == 0 or index in item.cuts,
    )


def _scene_key(path: str) -> str:
    return _hash_scene(path, Path(path).stat().st_mtime_ns)


@functools.lru_cache(maxsize=8)
def _hash_scene(path: str, _: int) -> str:
    return hash_scene(Path(path))


def scene_of(item: StudyScene) -> Scene:
    """Return an item's scene, with its own camera."""
    scene = load_scene(item.path)
    if not item.camera:
        return scene
    values = scene.camera.model_dump(exclude_unset=True) | item.camera
    camera = build(Camera, values, f"data {item.name!r}: camera")
    return scene.model_copy(update={"camera": camera})


def _render(item: StudyScene, time: float) -> dict[str, Tensor]:
    engine: Engine = "compiled" if item.count >= _WORTH_COMPILING else "auto"
    renderer = Renderer(scene_of(item), engine=engine)
    size, shutter = item.height_width, item.exposure
    # Sharp color, stream and references must not share their noise.
    sharp = renderer.frame(size, frame=time, color_spp=item.color_spp, seed=item.seed)
    tensors = planes_of(sharp, "sharp")
    for offset, name in enumerate(item.references, start=1):
        seed = item.seed + offset
        reference = renderer.reference(
            size, spp=item.spp, shutter=shutter, frame=time, seed=seed, pixel=name
        )
        tensors[f"reference.{name}"] = reference.mean
        tensors[f"variance.{name}"] = reference.variance
    if item.stream_spp:
        tensors |= _stream(renderer, item, time)
    return tensors | (_behind(renderer, item, time) if item.revealed else {})


def _stream(renderer: Renderer, item: StudyScene, time: float) -> dict[str, Tensor]:
    frames = renderer.stream(
        item.height_width, frame=time, shutter=item.exposure, spp=item.stream_spp, seed=item.seed
    )
    tensors: dict[str, Tensor] = {}
    total = torch.zeros_like(frames[0].color)
    for number, frame in enumerate(frames, start=1):
        total = total + frame.color
        if number & (number - 1) == 0:
            tensors[f"mean{number}"] = total / number
        if number <= KEPT_SAMPLES:
            tensors |= planes_of(frame, f"stream{number - 1}")
    return tensors


def _behind(renderer: Renderer, item: StudyScene, time: float) -> dict[str, Tensor]:
    """Return the revealed layer, and what each pixel's center sees over the shutter."""
    size, seed = item.height_width, item.seed
    revealed = render_revealed(
        renderer.scene, size, frame=time, color_spp=item.revealed_spp, seed=seed
    )
    seen = renderer.stream(size, frame=time, shutter=item.exposure, spp=_HIDDEN_SPP, seed=seed + 9)
    tensors = planes_of(revealed.frame, "revealed")
    tensors["seen.object_id"] = torch.cat([_layer(frame, "object_id") for frame in seen])
    tensors["seen.depth"] = torch.cat([_layer(frame, "depth") for frame in seen])
    return tensors


def _layer(frame: Frame, name: str) -> Tensor:
    layer: Tensor = frame.layers()[name]
    return layer


# -- files -----------------------------------------------------------------------------------------


def _read(item: StudyExr, index: int, raw: tuple[int, ...]) -> Moment:
    sharp = _frame(item, item.sharp, item.gbuffer, index)
    samples = tuple(_frame(item, pattern, None, index) for pattern in item.stream)
    references = {
        name: read_image(_file(item, pattern, index)) for name, pattern in item.references.items()
    }
    for name, image in references.items():
        if image.shape != sharp.color.shape:
            raise ConfigError(
                f"the reference {name!r} of {item.name!r} is {_size(image)}, the sharp frame is "
                f"{_size(sharp.color)}"
            )
    means = _means(samples, item, references, raw)
    return Moment(
        index=index,
        sharp=sharp,
        samples=samples,
        raw=means,
        estimated=frozenset(n for n in means if n > len(samples)),
        references=references,
        variances={},
        revealed=_frame(item, item.revealed_color, item.revealed_gbuffer, index)
        if item.revealed and item.revealed_color is not None
        else None,
        seen=None,
        shutter=item.exposure,
        first_of_shot=index == 0 or index in item.cuts,
    )


def _means(
    samples: tuple[Frame, ...],
    item: StudyExr,
    references: Mapping[str, Tensor],
    raw: tuple[int, ...],
) -> dict[int, Tensor]:
    """Return mean colors of n samples; of more than there are, what stands in for them.

    The stand-in is the image that the stream converges to, plus the error of one sample over the
    square root of n: it has the variance of n samples, but not their distribution. On streams of
    our scenes its FLIP is within 1 % of that of 4 and 16 true samples.
    """
    if not samples:
        return {}
    colors = torch.stack([frame.color for frame in samples])
    means = {n: colors[:n].mean(0) for n in raw if n <= len(samples)}
    if item.converged is not None:
        truth = references[item.converged]
        means |= {n: truth + (colors[0] - truth) / n**0.5 for n in raw if n > len(samples)}
    return means


def _frame(item: StudyExr, color: str, gbuffer: str | None, index: int) -> Frame:
    return read_frame(
        _file(item, color, index),
        item.convention,
        gbuffer=None if gbuffer is None else _file(item, gbuffer, index),
    )


def _file(item: StudyExr, pattern: str, index: int) -> Path:
    return Path(item.path) / numbered_file(pattern, item.first + index)


def _stamps(item: StudyExr) -> str:
    """Return name, size and time of change of the files in an item's folder."""
    found: list[Any] = []
    for path in sorted(Path(item.path).glob("*.exr")):
        found.append((path.name, path.stat().st_size, path.stat().st_mtime_ns))
    return repr(found)


def _size(image: Tensor) -> str:
    return f"{image.shape[-1]}x{image.shape[-2]}"
