"""What a fit is told of its data: scenes to render or draw, files to read; frames, sequences."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from torchblur.frame import LONGEST_SHUTTER, Shutter, ShutterPosition
from torchblur.params import Config
from tuning.config.framing import Framed, read_size, refusal, without_none

__all__ = [
    "Crops",
    "DataItem",
    "DataSpec",
    "ExrData",
    "ExrStreamData",
    "FamilyData",
    "FamilyStreamData",
    "SceneData",
    "SceneStreamData",
]


class _Weighted(Config):
    weight: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="share of this item in the fit, however many frames it has; where no item "
        "has one all frames or windows count alike, else it is 1 if left out",
    )


class _Exposed(Config):
    shutter: Annotated[float, Field(ge=0, le=LONGEST_SHUTTER)] = Field(
        0.5, description="open time in frames"
    )
    shutter_position: ShutterPosition = Field(
        "centered", description="open around the frame's time, after it, or before it"
    )

    @property
    def exposure(self) -> Shutter:
        """The shutter of the reference."""
        return Shutter(self.shutter, self.shutter_position)


class _Sized(Framed):
    size: str = Field("320x180", description="WIDTHxHEIGHT in px; with `of`: of the window")

    @field_validator("size")
    @classmethod
    def _is_size(cls, value: str) -> str:
        read_size(value, "size")
        return value

    @property
    def height_width(self) -> tuple[int, int]:
        """Height and width in px."""
        return read_size(self.size, "size")


class _Rendered(_Sized, _Exposed, _Weighted):
    """Frames that torchblur renders and keeps."""

    frames: tuple[float, ...] = Field((0.0,), min_length=1, description="times, in frames")
    spp: int = Field(256, ge=2, description="samples per pixel of the reference")
    color_spp: int = Field(16, ge=1, description="samples per pixel of the sharp color")


class SceneData(_Rendered):
    """Frames of a procedural scene, rendered by torchblur and cached."""

    kind: Literal["scene"]
    path: str = Field(description="scene file")
    seed: int = Field(0, ge=0, description="seed of the renderer")


class _Drawn(Config):
    """Scenes of a family."""

    path: str = Field(description="file of the family")
    scenes: int = Field(16, ge=1, le=10_000, description="number of scenes")
    seed: int = Field(
        0, ge=0, description="of the first scene, each has the next; also that of its renderer"
    )

    @property
    def seeds(self) -> range:
        """The seeds of the scenes."""
        return range(self.seed, self.seed + self.scenes)


class FamilyData(_Drawn, _Rendered):
    """Frames of scenes drawn at random from a family, rendered by torchblur and cached."""

    kind: Literal["family"]


class _Filed(_Exposed, _Weighted):
    """Frames that are read."""

    lines: Annotated[int, Field(ge=1)] | None = Field(
        None,
        description="height in px of the camera's whole image, if the files are windows of it; "
        "figures are told apart by it",
    )

    @model_serializer(mode="wrap")
    def _without_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return without_none(handler(self), ("lines",))


class ExrData(_Filed):
    """Frames of another renderer, as EXR files in one folder."""

    kind: Literal["exr"]
    path: str = Field(".", description="folder")
    sharp: str = Field("sharp.exr", description="sharp render; #### stands for the frame number")
    gbuffer: str | None = Field(
        None, description="file with depth, velocity … if they are not in the sharp render's"
    )
    reference: str = Field("reference.exr", description="render with motion blur")
    convention: str = Field("auto", description="whose channel names and signs")
    frames: tuple[int, ...] | None = Field(
        None, min_length=1, description="frame numbers for ####; all that are there if left out"
    )


def _numbers(value: Any) -> Any:
    """Turn {start, stop} into the frame numbers from `start` up to `stop`, which is left out."""
    if not isinstance(value, dict):
        return value
    if set(value) != {"start", "stop"} or not all(type(v) is int for v in value.values()):
        raise refusal(f"`frames` must be a list or {{start: 0, stop: 8}}, got {value}")
    if value["stop"] <= value["start"]:
        raise refusal(f"`start < stop` must hold, got {value['start']} and {value['stop']}")
    return tuple(range(value["start"], value["stop"]))


def _rising(value: tuple[int, ...]) -> tuple[int, ...]:
    for before, after in itertools.pairwise(value):
        if after <= before:
            raise refusal(f"the frames of a sequence must rise, got {before} before {after}")
    return value


_Numbers = Annotated[
    tuple[int, ...], Field(min_length=1), BeforeValidator(_numbers), AfterValidator(_rising)
]


class _Stream(_Exposed, _Weighted):
    """A sequence in its order; a new shot begins at cuts and where numbers are left out."""

    shutter: Annotated[float, Field(ge=0, le=LONGEST_SHUTTER)] = Field(
        1.0, description="open time in frames, over which the samples' times lie"
    )
    cuts: tuple[int, ...] = Field((), description="numbers of frames that begin a new shot")
    warm_up: int = Field(
        0, ge=0, description="frames at the start that are filtered and not scored"
    )


class _RenderedStream(_Sized, _Stream):
    """Sequences that torchblur renders and keeps."""

    frames: _Numbers = Field(
        tuple(range(8)), description="frame numbers: a list, or {start: 0, stop: 8} for 0 to 7"
    )
    spp: int = Field(256, ge=2, description="samples per pixel of the references")
    stream_spp: int = Field(1, ge=1, description="samples per pixel of the stream")
    color_spp: int = Field(16, ge=1, description="samples per pixel of the sharp color")
    pixel: Literal["center", "box"] = Field(
        "center",
        description="what references average over: the time at the pixel's center, to which the "
        "stream converges, or the pixel's area too",
    )


class SceneStreamData(_RenderedStream):
    """A sequence of a procedural scene: each sample at its own random time, and references."""

    kind: Literal["scene_stream"]
    path: str = Field(description="scene file")
    seed: int = Field(0, ge=0, description="seed of the renderer")


class FamilyStreamData(_Drawn, _RenderedStream):
    """A sequence of each of several scenes drawn at random from a family."""

    kind: Literal["family_stream"]


class ExrStreamData(_Stream, _Filed):
    """A sequence of another renderer: samples with their times and references, as EXR files."""

    kind: Literal["exr_stream"]
    path: str = Field(".", description="folder")
    stream: tuple[str, ...] = Field(
        ("stream.####.exr",),
        min_length=1,
        description="samples with their layers, time too; several patterns are several samples "
        "per pixel",
    )
    reference: str = Field("reference.####.exr", description="render with motion blur")
    center: str | None = Field(
        None, description="sharp frames with their layers, for filters that want no times"
    )
    convention: str = Field("auto", description="whose channel names and signs")
    frames: _Numbers | None = Field(
        None, description="numbers for ####: a list, or {start: 1, stop: 9}; all if left out"
    )

    @field_validator("stream", mode="before")
    @classmethod
    def _one_or_several(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value

    @field_validator("stream", "reference", "center")
    @classmethod
    def _is_numbered(cls, value: object) -> object:
        names = value if isinstance(value, tuple) else (value,)
        for name in names:
            if isinstance(name, str) and "#" not in name:
                raise refusal(f"a sequence needs #### for the frame number, got {name!r}")
        return value


DataItem = Annotated[
    SceneData | FamilyData | ExrData | SceneStreamData | FamilyStreamData | ExrStreamData,
    Field(discriminator="kind"),
]


class Crops(Config):
    """Windows to fit on, instead of full frames, where something moves or where the error is."""

    size: int = Field(128, ge=16, description="edge of the scored window, px")
    per_frame: int = Field(4, ge=1, description="windows of each frame, or of each sequence")
    context: int | None = Field(
        None,
        ge=0,
        description="px around it that are filtered and not scored; if left out twice the tile, or "
        "with `reach: frame` the longest blur to each side and a tile",
    )
    choose: Literal["motion", "error"] = Field(
        "motion",
        description="by chance in proportion to the window's moving pixels, or to the error "
        "(FLIP) of the filter at the start of the fit",
    )
    unbiased: bool = Field(
        False,
        description="weigh each window by the inverse of its chance, so that the windows stand "
        "for the whole frame, not for its hard places",
    )


class DataSpec(Config):
    """What is fitted, and what the fit never sees. Split by scene, never by crop."""

    root: str = Field(".", description="folder that the paths below are relative to")
    train: tuple[DataItem, ...] = Field(min_length=1, description="frames to fit")
    holdout: tuple[DataItem, ...] = Field((), description="frames for the evaluation alone")
    crops: Crops | None = Field(None, description="fit on windows; on full frames if left out")

    @property
    def is_weighted(self) -> bool:
        """Whether windows may count differently in the fit."""
        by_item = any(item.weight is not None for item in self.train)
        return by_item or (self.crops is not None and self.crops.unbiased)

    @model_validator(mode="after")
    def _is_split_by_scene(self) -> DataSpec:
        held = _families(self.holdout)
        for index, item in _families(self.train):
            for other, twin in held:
                if item.seed < twin.seeds.stop and twin.seed < item.seeds.stop:
                    raise refusal(
                        "scenes of one seed are alike, so the seeds of families in `train` and "
                        f"`holdout` must differ: train.{index} has {_seeds(item)}, "
                        f"holdout.{other} has {_seeds(twin)}"
                    )
        return self

    @model_validator(mode="after")
    def _holdout_is_not_weighted(self) -> DataSpec:
        for index, item in enumerate(self.holdout):
            if item.weight is not None:
                raise refusal(
                    "`weight` counts in the fit, and hold-out figures are plain means over "
                    f"frames; got {item.weight:g} in holdout.{index}"
                )
        return self


def _families(items: tuple[DataItem, ...]) -> list[tuple[int, _Drawn]]:
    return [(index, item) for index, item in enumerate(items) if isinstance(item, _Drawn)]


def _seeds(item: _Drawn) -> str:
    first, last = item.seeds[0], item.seeds[-1]
    return f"{first}" if first == last else f"{first} to {last}"
