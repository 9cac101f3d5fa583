"""What other programs call color, depth and velocity, and in which units, signs and axes.

One table, `CONVENTIONS`, holds it all as data. An entry is a `Convention`; any of its fields can
be replaced by a `ConventionOverrides`, also from a YAML file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from torchblur.errors import ConfigError, FileFormatError, nearest_name
from torchblur.io.channels import Catalog
from torchblur.params import Config, build

__all__ = [
    "CONVENTIONS",
    "Convention",
    "ConventionOverrides",
    "detect_convention",
    "get_convention",
    "resolve_convention",
]

Pair = tuple[str, str]
Triple = tuple[str, str, str]
DepthKind = Literal["planar", "inverse", "reversed", "hyperbolic"]
Unit = Literal["px", "uv", "ndc"]

_RGB: tuple[Triple, ...] = (("R", "G", "B"), ("rgba.R", "rgba.G", "rgba.B"))
CHANNEL_FIELDS = (
    "color",
    "alpha",
    "depth",
    "velocity",
    "velocity_previous",
    "normal",
    "object_id",
    "time",
    "albedo",
    "variance",
    "acceleration",
)


class Convention(Config):
    """How the files of one program are to be read.

    Channel names are suffixes (`Vector.X` fits `ViewLayer.Vector.X`), in order of preference. The
    velocity in px/frame, forward in time, x right, y down is
    ``velocity_sign * (stored - velocity_bias) * velocity_scale * unit``, with y negated if it
    points up. With a next and a previous pair, velocity is the mean of both and acceleration
    their difference.
    """

    name: str
    program: str
    evidence: Literal["verified", "documentation", "memory"] = "documentation"
    """verified: checked on real files; documentation: the program's manual says so; memory:
    common knowledge that no source at hand confirms."""
    note: str = ""
    signature: str = ""
    """What a header attribute begins with that only this program writes."""

    color: tuple[Triple, ...] = _RGB
    alpha: tuple[str, ...] = ("A", "rgba.A")
    depth: tuple[str, ...] = ("Z", "depth.Z", "depth.R")
    velocity: tuple[Pair, ...] = ()
    """Displacement from this frame to the next, horizontal and vertical."""
    velocity_previous: tuple[Pair, ...] = ()
    """Displacement between the previous frame and this one."""
    normal: tuple[Triple, ...] = ()
    object_id: tuple[str, ...] = ()
    time: tuple[str, ...] = ()
    albedo: tuple[Triple, ...] = ()
    variance: tuple[Triple, ...] = (("variance.R", "variance.G", "variance.B"),)
    acceleration: tuple[Pair, ...] = ()

    velocity_unit: Unit = "px"
    """px; uv: the image is 1 wide and high; ndc: it is 2 wide and high."""
    velocity_sign: Literal[-1, 1] = 1
    """+1: `velocity` is stored as next minus current; -1: as current minus next."""
    velocity_previous_sign: Literal[-1, 1] = 1
    """+1: stored as current minus previous; -1: as previous minus current."""
    velocity_y: Literal["up", "down"] = "up"
    velocity_bias: float = 0.0
    """The stored value that means no motion."""
    velocity_scale: float = 1.0
    """Factor on top; 1/shutter for vectors that span the shutter instead of a frame."""
    velocity_premultiplied: bool = False
    """Vectors were multiplied by alpha."""
    depth_kind: DepthKind = "planar"
    """planar: distance along the view axis; inverse: one over it; reversed: depth buffer
    near/distance (1 near, 0 far); hyperbolic: depth buffer from 0 (near) to 1 (far)."""
    depth_scale: float = 1.0
    """Factor on the distance: -1 for depth along a negative axis, or a change of units."""
    depth_near: float = Field(default=0.1, gt=0)
    depth_far: float = Field(default=1000.0, gt=0)
    depth_zero: Literal["background", "invalid"] = "background"
    """What a planar depth of 0 means: nothing was hit there (read as +inf), or an error."""
    time_start: float = 0.0
    """The stored time at which the shutter opens; -0.5 where the frame itself is 0 …"""
    time_end: float = 1.0
    """… and at which it closes."""

    def override(self, overrides: ConventionOverrides) -> Convention:
        """Return the convention with some fields replaced."""
        update: dict[str, Any] = {}
        for name in overrides.model_fields_set:
            value = getattr(overrides, name)
            if name in CHANNEL_FIELDS:
                update[name] = () if value is None else (value,)
            elif value is not None:
                update[name] = value
        if overrides.velocity is not None and "velocity_previous" not in update:
            update["velocity_previous"] = ()
        if isinstance(overrides.color, str):
            update["color"] = (tuple(f"{overrides.color}.{c}" for c in "RGB"),)
        return self.model_copy(update=update)


class ConventionOverrides(Config):
    """Fields of a `Convention` to be replaced; what is left out stays.

    A channel field takes one name, pair or triple; null means that the layer is not to be read.
    `color` may also be the name of a layer with R, G and B. Naming `velocity` alone drops the
    convention's previous pair.
    """

    color: Triple | str | None = None
    alpha: str | None = None
    depth: str | None = None
    velocity: Pair | None = None
    velocity_previous: Pair | None = None
    normal: Triple | None = None
    object_id: str | None = None
    time: str | None = None
    albedo: Triple | None = None
    variance: Triple | None = None
    acceleration: Pair | None = None
    velocity_unit: Unit | None = None
    velocity_sign: Literal[-1, 1] | None = None
    velocity_previous_sign: Literal[-1, 1] | None = None
    velocity_y: Literal["up", "down"] | None = None
    velocity_bias: float | None = None
    velocity_scale: float | None = None
    velocity_premultiplied: bool | None = None
    depth_kind: DepthKind | None = None
    depth_scale: float | None = None
    depth_near: float | None = Field(default=None, gt=0)
    depth_far: float | None = Field(default=None, gt=0)
    depth_zero: Literal["background", "invalid"] | None = None
    time_start: float | None = None
    time_end: float | None = None


CONVENTIONS: Mapping[str, Convention] = {
    entry.name: entry
    for entry in (
        Convention(
            name="torchblur",
            program="torchblur",
            evidence="verified",
            note="velocity in px/frame, forward in time, x right, y down: no conversion",
            depth=("Z",),
            depth_zero="invalid",
            velocity=(("velocity.X", "velocity.Y"),),
            velocity_y="down",
            acceleration=(("acceleration.X", "acceleration.Y"),),
            normal=(("normal.X", "normal.Y", "normal.Z"),),
            object_id=("id",),
            time=("time",),
            albedo=(("albedo.R", "albedo.G", "albedo.B"),),
        ),
        Convention(
            name="blender",
            program="Blender (Cycles)",
            evidence="verified",
            note="both pairs are stored against time; the Vector pass is empty when the render "
            "itself has motion blur; empty sky has depth 1e10 and no motion",
            signature="BlenderMultiChannel",
            color=(("Combined.R", "Combined.G", "Combined.B"), *_RGB),
            alpha=("Combined.A", "A"),
            depth=("Depth.Z",),
            depth_zero="invalid",
            velocity=(("Vector.Z", "Vector.W"),),
            velocity_sign=-1,
            velocity_previous=(("Vector.X", "Vector.Y"),),
            velocity_previous_sign=-1,
            normal=(("Normal.X", "Normal.Y", "Normal.Z"),),
            object_id=("IndexOB.X",),
        ),
        Convention(
            name="nuke",
            program="Nuke layers forward and backward",
            evidence="verified",
            note="names and y up of `forward` checked on the OpenEXR beachball frames, "
            "whose vectors span the shutter (velocity_scale = 1/shutter gives px/frame); "
            "`backward` from memory. ScanlineRender writes 1/z: depth_kind='inverse'",
            velocity=(("forward.u", "forward.v"),),
            velocity_previous=(("backward.u", "backward.v"),),
            velocity_previous_sign=-1,
        ),
        Convention(
            name="arnold",
            program="Arnold AOV motionvector, raw",
            note="needs an instantaneous shutter; the vectors span a shutter of one frame; "
            "sign and y axis from memory",
            signature="arnold/",
            velocity=(("motionvector.R", "motionvector.G"), ("motionvector.X", "motionvector.Y")),
            normal=(("N.X", "N.Y", "N.Z"), ("N.R", "N.G", "N.B")),
            object_id=("ID",),
        ),
        Convention(
            name="vray",
            program="V-Ray render element velocity",
            note="with `clamp velocity` off; a clamped one has velocity_bias=0.5 and "
            "velocity_scale = 2 * max velocity; y axis from memory",
            signature="vray",
            depth=("VRayZDepth", "ZDepth", "VRayZDepth.R", "ZDepth.R", "Z"),
            velocity=(("velocity.R", "velocity.G"), ("VRayVelocity.R", "VRayVelocity.G")),
            normal=(
                ("normals.R", "normals.G", "normals.B"),
                ("normals.X", "normals.Y", "normals.Z"),
            ),
        ),
        Convention(
            name="renderman",
            program="RenderMan AOV motionFore",
            evidence="memory",
            note="dPdtime is a 3-D vector and cannot be used; `motionBack` is not read, as its "
            "sign is not known",
            velocity=(("motionFore.R", "motionFore.G"), ("motionFore.X", "motionFore.Y")),
            normal=(("Nn.X", "Nn.Y", "Nn.Z"), ("Nn.R", "Nn.G", "Nn.B")),
            object_id=("id",),
        ),
        Convention(
            name="unreal",
            program="Unreal Engine Movie Render Queue",
            evidence="memory",
            note="0.5 means no motion; the y axis differs between versions: check it against a "
            "reference; the pass lacks what is behind transparent surfaces",
            signature="unreal/",
            color=(*_RGB, ("FinalImage.R", "FinalImage.G", "FinalImage.B")),
            depth=("FinalImageWorldDepth.R", "WorldDepth.R"),
            velocity=(
                ("FinalImageMotionVectors.R", "FinalImageMotionVectors.G"),
                ("MotionVectors.R", "MotionVectors.G"),
            ),
            velocity_unit="uv",
            velocity_bias=0.5,
            velocity_scale=2.0,
        ),
        Convention(
            name="karma",
            program="Houdini Karma and Mantra, motionvector in NDC",
            note="fractions of the image size, y up; vectors in camera space cannot be used",
            signature="karma",
            depth=("Z", "depth.Z", "depth.R", "Pz.R", "Pz"),
            velocity=(("motionvector.X", "motionvector.Y"), ("motionvector.R", "motionvector.G")),
            velocity_unit="uv",
            normal=(("N.X", "N.Y", "N.Z"), ("N.R", "N.G", "N.B")),
        ),
        Convention(
            name="unity",
            program="Unity Recorder (HDRP), motion vectors",
            note="fractions of the image size over a whole frame, current minus previous",
            depth=("Depth.R", "Z"),
            velocity_previous=(
                ("MotionVectors.R", "MotionVectors.G"),
                ("Motion Vectors.R", "Motion Vectors.G"),
            ),
            velocity_unit="uv",
            normal=(("Normal.R", "Normal.G", "Normal.B"),),
        ),
        Convention(
            name="moonray",
            program="MoonRay material AOV motionvec",
            note="-1 to 1 over the image, per frame, multiplied by alpha; sign and y axis from "
            "memory",
            velocity=(("motionvec.R", "motionvec.G"), ("motionvec.X", "motionvec.Y")),
            velocity_unit="ndc",
            velocity_premultiplied=True,
        ),
    )
}


def get_convention(name: str, **overrides: Any) -> Convention:
    """Return an entry of the table, with fields replaced.

    Args:
        name: A key of `CONVENTIONS`.
        **overrides: Fields of `ConventionOverrides`.

    Raises:
        ConfigError: unknown name, unknown field, or a value of the wrong kind.
    """
    if name not in CONVENTIONS:
        raise ConfigError(
            f"unknown convention `{name}`{nearest_name(name, CONVENTIONS)}; "
            f"there are: auto, {', '.join(CONVENTIONS)}"
        )
    return CONVENTIONS[name].override(build(ConventionOverrides, overrides, "convention"))


def detect_convention(catalog: Catalog) -> Convention:
    """Return the convention whose velocity channels a file has.

    Args:
        catalog: The channels.

    Raises:
        FileFormatError: if no convention fits, with the channels present and those looked for, or
            if several fit and the header does not tell which.
    """
    fitting = [entry for entry in CONVENTIONS.values() if _velocity_present(catalog, entry)]
    if len(fitting) > 1:
        signed = [entry for entry in fitting if _signed(catalog, entry)]
        fitting = signed or fitting
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(f'"{entry.name}" ({entry.program})' for entry in fitting)
        raise FileFormatError(
            f"{catalog.path}: the velocity channels fit several conventions, which differ in "
            f"unit or sign: {names}; name one with convention=..."
        )
    tried = "; ".join(f"{entry.name}: {_wanted(entry)}" for entry in CONVENTIONS.values())
    raise FileFormatError(
        f"{catalog.path} has no velocity channels that are known. Present: "
        f'{", ".join(catalog.labels)}. Tried {tried}. Name them with velocity=("...", "...")'
    )


def resolve_convention(
    catalog: Catalog, convention: str | Convention, overrides: ConventionOverrides
) -> Convention:
    """Return the convention to read a file by.

    Args:
        catalog: The file's channels.
        convention: A name in `CONVENTIONS`, "auto", or an entry.
        overrides: Fields to be replaced. If they name the velocity channels and "auto" finds
            nothing, they start from torchblur's own convention.

    Raises:
        ConfigError: unknown name.
        FileFormatError: as `detect_convention`.
    """
    if isinstance(convention, Convention):
        return convention.override(overrides)
    if convention != "auto":
        return get_convention(convention).override(overrides)
    try:
        return detect_convention(catalog).override(overrides)
    except FileFormatError:
        if overrides.velocity is None and overrides.velocity_previous is None:
            raise
    return CONVENTIONS["torchblur"].override(overrides)


def _velocity_present(catalog: Catalog, entry: Convention) -> bool:
    pairs = (*entry.velocity, *entry.velocity_previous)
    if entry.name == "torchblur" and any(p.ends_with("velocity.Z") for p in catalog.planes):
        return False  # three components: a velocity in space, as simulations write it
    return catalog.find_group(pairs) is not None


def _signed(catalog: Catalog, entry: Convention) -> bool:
    return bool(entry.signature) and any(
        str(key).lower().startswith(entry.signature.lower())
        for plane in catalog.planes
        for key in plane.part.attributes
    )


def _wanted(entry: Convention) -> str:
    return " or ".join("/".join(pair) for pair in (*entry.velocity, *entry.velocity_previous))
