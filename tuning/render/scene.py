"""Rendering sequences of a scene to files: sharp frames, and streams and references beside them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from torchblur.errors import ConfigError, OutputError, nearest_name
from torchblur.frame import LONGEST_SHUTTER, Shutter, ShutterPosition
from torchblur.io import write_frame, write_image
from torchblur.params import build
from torchblur.render import Renderer, Scene, load_scene
from tuning.config.framing import Framed
from tuning.data.framing import find_box, seen_through, view_of
from tuning.files.outputs import made_by, make_folders, remove_leftovers, state_of
from tuning.progress import Progress, Stage

__all__ = ["RenderSettings", "find_scene", "render_sequence", "settings_of"]

_ROOTS = (Path(), Path(__file__).resolve().parents[2])


class RenderSettings(Framed):
    """How a scene is rendered."""

    width: int = Field(640, ge=1, le=16384, description="px")
    height: int = Field(360, ge=1, le=16384, description="px")
    frames: int = Field(1, ge=1, description="number of frames, one apart")
    start: float = Field(0.0, description="time of frame 0000, in frames")
    spp: int = Field(256, ge=2, description="samples per pixel of the reference")
    color_spp: int = Field(16, ge=1, description="samples per pixel of the sharp color")
    shutter: float = Field(0.5, ge=0, le=LONGEST_SHUTTER, description="open time in frames")
    shutter_position: ShutterPosition = "centered"
    seed: int = Field(
        0, ge=0, description="of frame 0000; each frame has the next, a stream one for all"
    )
    stream_spp: int = Field(0, ge=0, description="samples per pixel of the stream; 0: no stream")
    point_sampled: bool = Field(
        False, description="also render references of pixel centers, as streams are"
    )

    @property
    def height_width(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.height, self.width

    @property
    def exposure(self) -> Shutter:
        """The shutter of the reference."""
        return Shutter(self.shutter, self.shutter_position)


@dataclass(frozen=True)
class _Task:
    """One file of a frame."""

    kind: str
    sample: int
    number: int
    path: Path
    recipe: Mapping[str, Any]


def settings_of(size: str, **values: Any) -> RenderSettings:
    """Return render settings from "WIDTHxHEIGHT" and other fields.

    Raises:
        ConfigError: a size that is none, or a value out of range.
    """
    match = re.fullmatch(r"(\d+)x(\d+)", size)
    if match is None:
        raise ConfigError(f"`size` must be WIDTHxHEIGHT in px, such as 640x360, got {size!r}")
    width, height = int(match[1]), int(match[2])
    return build(RenderSettings, {"width": width, "height": height, **values})


def find_scene(scene: str, folder: Path | None = None, place: str = "") -> Path:
    """Return the file of a scene, or of a family of scenes.

    Args:
        scene: A path, or a name in `configs/scenes` or `configs/families`.
        folder: What the path is relative to; the working folder if left out, or as well.
        place: Key path with the file, for the message.

    Raises:
        ConfigError: there is none; names the nearest.
    """
    for path in (Path(scene) if folder is None else folder / scene, Path(scene)):
        if path.is_file():
            return path
    places = [root / "configs" / kind for root in _ROOTS for kind in ("families", "scenes")]
    known = {path.stem: path for place in places for path in sorted(place.glob("*.yaml"))}
    if scene not in known:
        hint = nearest_name(scene, known)
        names = f"; scenes: {', '.join(sorted(known))}" if known else ""
        where = f" ({place})" if place else ""
        raise ConfigError(
            f"no scene `{scene}`{hint}{names}; or give the path of a YAML file{where}"
        )
    return known[scene]


def render_sequence(
    path: Path,
    folder: Path,
    settings: RenderSettings,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Render a scene to `NAME.####.exr` and `reference.####.exr`; files that are done are kept.

    The number in the names counts frames from the start. A sharp frame has all layers; a
    reference has the layer `variance`, the variance of its mean. If asked for, there are
    `reference_pointsampled.####.exr`, and a stream: `stream.####.exr` for one sample per pixel,
    `stream01.####.exr`, `stream02.####.exr` … for several, with `time` and `albedo`.

    A window of a larger image (`settings.of`) is the same in all frames; where motion decides its
    place, that is the motion in the first one.

    Args:
        path: File of the scene; its stem is NAME.
        folder: Where to.
        settings: Size, samples, shutter, seed.
        overwrite: Replace files made with other settings.
        progress: Told after each file.

    Returns:
        All files of the sequence, in order.

    Raises:
        ConfigError: the file is no scene.
        OutputError: files with other content are in the way, or the folder cannot be written to.
    """
    scene = load_scene(path)
    box = find_box(scene, settings, settings.start, settings.exposure)
    tasks = _tasks(path, scene, folder, settings, view_of(settings, box))
    states = {task.path: state_of(task.path, (), task.recipe) for task in tasks}
    other = [file for file, state in states.items() if state == "other"]
    if other and not overwrite:
        raise OutputError(
            f"{other[0]} exists and was made with other settings; overwrite=True (--overwrite) "
            "replaces it"
        )
    todo = [task for task in tasks if overwrite or states[task.path] != "done"]
    make_folders([task.path for task in tasks])
    remove_leftovers([task.path for task in todo])
    stage = Stage("render", len(todo), progress)
    stage.step(0)
    renderer = Renderer(seen_through(scene, settings, box), images=settings.frames)
    for done, task in enumerate(todo, start=1):
        _render(task, renderer, settings, made_by(task.recipe, path))
        stage.step(done, message=task.path.name)
    return [task.path for task in tasks]


def _tasks(
    path: Path, scene: Scene, folder: Path, settings: RenderSettings, view: str
) -> list[_Task]:
    digest = hashlib.sha256(scene.model_dump_json().encode()).hexdigest()[:16]
    # What does not change a file is not in its recipe, nor are settings that came later.
    others = {"frames", "start", "stream_spp", "point_sampled", "of", "at"}
    common = {"scene": digest} | settings.model_dump(mode="json", exclude=others)
    if view:
        common["window"] = view
    return [
        _Task(
            kind=kind,
            sample=sample,
            number=number,
            path=folder / f"{path.stem if kind == 'frame' else name}.{number:04d}.exr",
            recipe=common | {"kind": name, "frame": settings.start + number},
        )
        for number in range(settings.frames)
        for kind, sample, name in _kinds(settings)
    ]


def _kinds(settings: RenderSettings) -> Iterator[tuple[str, int, str]]:
    """List the files of a frame: kind, sample of the stream, and name."""
    yield "frame", 0, "frame"
    for sample in range(settings.stream_spp):
        yield "stream", sample, "stream" if settings.stream_spp == 1 else f"stream{sample + 1:02d}"
    yield "reference", 0, "reference"
    if settings.point_sampled:
        yield "reference", 0, "reference_pointsampled"


def _render(
    task: _Task, renderer: Renderer, settings: RenderSettings, metadata: Mapping[str, Any]
) -> None:
    size, shutter = settings.height_width, settings.exposure
    time, seed = settings.start + task.number, settings.seed + task.number
    if task.kind == "frame":
        frame = renderer.frame(size, frame=time, color_spp=settings.color_spp, seed=seed)
        write_frame(task.path, frame, metadata=metadata, overwrite=True)
        return
    if task.kind == "stream":
        stream = renderer.stream_sample(
            size, task.sample, frame=time, shutter=shutter, seed=settings.seed
        )
        write_frame(task.path, stream, metadata=metadata, overwrite=True)
        return
    result = renderer.reference(
        size,
        spp=settings.spp,
        shutter=shutter,
        frame=time,
        seed=seed,
        pixel="center" if task.recipe["kind"] == "reference_pointsampled" else "box",
    )
    layers = {"variance": result.variance}
    write_image(
        task.path, result.mean, layers=layers, half=False, metadata=metadata, overwrite=True
    )
