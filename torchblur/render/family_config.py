"""What a family of scenes is: ranges and weights to draw from, as a YAML file gives them.

Lengths on the screen are shares of the image's width, so that a family means the same at any
size: a speed of 0.05 is 12 px/frame in an image 240 px wide and 32 px/frame in one of 640 px.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Field

from torchblur.params import Config
from torchblur.render.motion import Number

__all__ = [
    "BackdropRanges",
    "BodyGroup",
    "BodyKind",
    "CameraRanges",
    "FloorRanges",
    "LightRanges",
    "SceneFamily",
    "SkyRanges",
    "TextureRanges",
]

BodyKind = Literal[
    "sphere", "box", "cylinder", "capsule", "panel", "wheel", "stick", "post", "fence",
    "torus_knot", "gear", "blob", "lathe",
]  # fmt: skip
"""Kinds of bodies; the last four are meshes and need the extra `render`."""

Motion = Literal["still", "linear", "approach", "spin", "tumble", "orbit", "held"]
CameraMotion = Literal["still", "pan", "tilt", "truck", "dolly", "roll", "arc", "walk"]
TextureKind = Literal["solid", "checker", "stripes", "dots", "crosses", "brick", "noise"]

_Key = TypeVar("_Key", bound=str)
_Bound = TypeVar("_Bound", int, float)


def _ordered(value: tuple[_Bound, _Bound]) -> tuple[_Bound, _Bound]:
    if value[0] > value[1]:
        raise ValueError("a range is [low, high] with low <= high")
    return value


def _some(value: dict[_Key, float]) -> dict[_Key, float]:
    if not any(value.values()):
        raise ValueError("one weight at least must be above 0")
    return value


_Above = Annotated[Number, Field(gt=0)]
_Unit = Annotated[Number, Field(ge=0, le=1)]
_Angle = Annotated[Number, Field(ge=1, le=150)]
_Tilt = Annotated[Number, Field(ge=-80, le=80)]
_Many = Annotated[int, Field(strict=True, ge=0, le=100)]
Range = Annotated[tuple[Number, Number], AfterValidator(_ordered)]
Positive = Annotated[tuple[_Above, _Above], AfterValidator(_ordered)]
Shares = Annotated[tuple[_Unit, _Unit], AfterValidator(_ordered)]
Counts = Annotated[tuple[_Many, _Many], AfterValidator(_ordered)]
_Weight = Annotated[Number, Field(ge=0)]
BodyKinds = Annotated[dict[BodyKind, _Weight], Field(min_length=1), AfterValidator(_some)]
Motions = Annotated[dict[Motion, _Weight], Field(min_length=1), AfterValidator(_some)]
CameraMotions = Annotated[dict[CameraMotion, _Weight], Field(min_length=1), AfterValidator(_some)]
TextureKinds = Annotated[dict[TextureKind, _Weight], Field(min_length=1), AfterValidator(_some)]


def _all_textures() -> dict[TextureKind, float]:
    return {"solid": 1, "checker": 2, "stripes": 2, "dots": 1, "crosses": 1, "brick": 2, "noise": 4}


def _still_camera() -> dict[CameraMotion, float]:
    return {"still": 1.0}


def _still_body() -> dict[Motion, float]:
    return {"still": 1.0}


class TextureRanges(Config):
    """What surfaces look like: two colors in a pattern."""

    kinds: TextureKinds = Field(
        default_factory=_all_textures, description="weights of the patterns"
    )
    scale: Positive = Field(
        (0.012, 0.08), description="size of a cell, shares of the width at the body's depth"
    )
    brightness: Positive = Field(
        (0.15, 0.65), description="mean of the two colors, scene-linear; evenly on a log scale"
    )
    contrast: Shares = Field(
        (0.1, 0.75), description="half the difference of the two colors over their mean"
    )
    saturation: Shares = Field((0.0, 0.7), description="of each color, 0 is gray")
    variation: Shares = Field((0.0, 0.5), description="by which cells differ in brightness")


class CameraRanges(Config):
    """Where the camera stands and how it moves."""

    fov: Annotated[tuple[_Angle, _Angle], AfterValidator(_ordered)] = Field(
        (40.0, 70.0), description="horizontal field of view, degrees, 1 to 150"
    )
    height: Positive = Field((0.8, 2.2), description="above the floor, scene units")
    tilt: Annotated[tuple[_Tilt, _Tilt], AfterValidator(_ordered)] = Field(
        (0.0, 14.0), description="how far it looks down, degrees, -80 to 80"
    )
    motions: CameraMotions = Field(
        default_factory=_still_camera,
        description="weights: still, pan (turn aside), tilt (turn up or down), truck (aside), "
        "dolly (ahead or back), roll, arc (around the subject), walk (ahead, and a slow turn)",
    )
    speed: Positive = Field(
        (0.005, 0.06),
        description="of what is at the subject's depth (roll, dolly, walk: at the side of the "
        "image; arc: far away), widths per frame; evenly on a log scale",
    )
    subject: _Above = Field(5.0, description="depth of what the camera films, scene units")


class BackdropRanges(Config):
    """A wall behind everything."""

    chance: _Unit = Field(0.8, description="that there is one")
    depth: Positive = Field((8.0, 14.0), description="from the camera, scene units")
    textures: TextureRanges | None = Field(None, description="the family's if left out")


class FloorRanges(Config):
    """The ground at height 0."""

    chance: _Unit = Field(0.6, description="that there is one")
    textures: TextureRanges | None = Field(None, description="the family's if left out")


class SkyRanges(Config):
    """What is seen where nothing is."""

    brightness: Positive = Field((0.25, 0.9), description="mean radiance")
    contrast: Shares = Field((0.0, 0.4), description="of the clouds; 0 is one color")
    scale: Positive = Field((0.1, 0.4), description="of the clouds, radians")


class LightRanges(Config):
    """The light on all bodies."""

    ambient: Shares = Field((0.3, 0.65), description="share that falls on all sides")
    elevation: Range = Field((20.0, 75.0), description="of the light, degrees")
    azimuth: Range = Field(
        (-110.0, 110.0), description="of the light, degrees; 0 is behind the camera"
    )


class BodyGroup(Config):
    """Some bodies that are drawn alike."""

    name: str = Field(min_length=1, description="unique; another name draws other bodies")
    count: Counts = Field((1, 3), description="least and greatest number of bodies")
    kinds: BodyKinds = Field(description="weights of the kinds")
    size: Positive = Field(
        (0.08, 0.3),
        description="longest extent, shares of the width at the body's depth; log scale",
    )
    thickness: Positive = Field(
        (0.03, 0.09), description="of sticks, posts and bars, shares of their length; log scale"
    )
    depth: Positive = Field((3.0, 8.0), description="from the camera, scene units; log scale")
    across: Range = Field((-0.4, 0.4), description="from the image's middle to the right, widths")
    up: Range = Field((-0.2, 0.2), description="from the image's middle upwards, widths")
    motions: Motions = Field(
        default_factory=_still_body,
        description="weights: still, linear, approach (to the camera or away), spin (about its "
        "middle), tumble (linear and spin), orbit (about a point beside it), held (moves with "
        "the camera)",
    )
    speed: Positive = Field(
        (0.01, 0.12), description="before a still camera, widths per frame; log scale"
    )
    spin: Positive = Field((2.0, 25.0), description="degrees per frame; log scale")
    glow: _Unit = Field(0.0, description="chance that a body shows its texture without the light")
    textures: TextureRanges | None = Field(None, description="the family's if left out")


def _unique(groups: tuple[BodyGroup, ...]) -> tuple[BodyGroup, ...]:
    names = [group.name for group in groups]
    if len(set(names)) < len(names):
        raise ValueError("groups must have different names")
    if not any(group.count[0] for group in groups):
        raise ValueError("one group at least must have a body in every scene")
    return groups


class SceneFamily(Config):
    """Scenes of one kind, from which `draw_scene` draws.

    All ranges are [low, high], both included, and drawn evenly, or evenly on a log scale where
    the field says so.
    """

    groups: Annotated[tuple[BodyGroup, ...], AfterValidator(_unique)] = Field(
        min_length=1, description="bodies, group by group"
    )
    camera: CameraRanges = Field(default_factory=CameraRanges, description="the camera")
    backdrop: BackdropRanges = Field(
        default_factory=BackdropRanges, description="a wall behind everything"
    )
    floor: FloorRanges = Field(default_factory=FloorRanges, description="the ground")
    sky: SkyRanges = Field(default_factory=SkyRanges, description="where nothing is")
    light: LightRanges = Field(default_factory=LightRanges, description="the light")
    textures: TextureRanges = Field(default_factory=TextureRanges, description="all surfaces")
    exposure: Positive = Field(
        (1.0, 1.0), description="factor on all radiance of a scene; log scale"
    )

    def fingerprint(self) -> str:
        """Return a hash of all that the family says."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:32]
