"""Bodies of a drawn scene: shape, place and motion, as the fields of the scene have them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torchblur.render.family_config import BodyGroup, TextureRanges
from torchblur.render.family_dice import Dice
from torchblur.render.family_textures import draw_spokes, draw_texture
from torchblur.render.family_view import Point, View, combined, plain

__all__ = ["draw_body"]

_FASTEST_TURN = 40.0  # degrees per frame, of orbits
_CLOSEST = 0.1  # share of its depth that an approaching body comes nearer per frame, at most
_UPRIGHT = ("panel", "post", "fence", "lathe")
_FACING = ("wheel", "gear")


@dataclass(frozen=True, kw_only=True)
class _Draft:
    """What the parts of one body share.

    Args:
        group: Its group.
        dice: Its random numbers.
        view: The camera.
        depth: From the camera, scene units.
        length: Longest extent, scene units.
        looks: Of its surface.
        exposure: Factor on its colors.
    """

    group: BodyGroup
    dice: Dice
    view: View
    depth: float
    length: float
    looks: TextureRanges
    exposure: float

    @property
    def wide(self) -> float:
        """Width of the image at the body's depth, scene units."""
        return self.view.width(self.depth)

    def texture(self, name: str = "texture") -> Any:
        return draw_texture(self.looks, self.wide, self.exposure, self.dice.of(name))

    def spokes(self) -> Any:
        return draw_spokes(self.looks, self.exposure, self.dice.of("texture"))

    def thin(self) -> float:
        """Return the radius of a bar that is as long as the body."""
        return 0.5 * self.length * self.dice.log_between("thickness", self.group.thickness)


def draw_body(
    group: BodyGroup,
    view: View,
    looks: TextureRanges,
    exposure: float,
    dice: Dice,
    *,
    has_floor: bool,
) -> dict[str, Any]:
    """Draw one body of a group.

    Args:
        group: The ranges.
        view: The camera.
        looks: The textures of the group.
        exposure: Factor on all colors.
        dice: Its own random numbers.
        has_floor: Whether the body must stay above height 0.

    Returns:
        The fields of a body, or of a group of bodies.
    """
    depth = dice.log_between("depth", group.depth)
    draft = _Draft(
        group=group,
        dice=dice,
        view=view,
        depth=depth,
        length=dice.log_between("size", group.size) * view.width(depth),
        looks=looks,
        exposure=exposure,
    )
    kind = dice.pick("kind", group.kinds)
    body = _SHAPES[kind](draft)
    if dice.chance("glow") < group.glow:
        for part in body.get("bodies", [body]):
            part["emissive"] = True
    x, y, z = view.at(dice.between("across", group.across), dice.between("up", group.up), depth)
    if has_floor:
        y = max(y, _half_height(kind, draft))
    position = (x, y, z)
    turned = {"rotation": plain(_rotation(kind, dice))}
    return body | turned | {"position": plain(position)} | _motion(kind, draft, position)


# -- shapes ----------------------------------------------------------------------------------------


def _sphere(draft: _Draft) -> dict[str, Any]:
    return {"kind": "sphere", "radius": plain(draft.length / 2), "texture": draft.texture()}


def _box(draft: _Draft) -> dict[str, Any]:
    edges = [draft.length * draft.dice.between(f"edge {axis}", (0.35, 1.0)) for axis in "yz"]
    return {"kind": "box", "size": plain((draft.length, *edges)), "texture": draft.texture()}


def _cylinder(draft: _Draft) -> dict[str, Any]:
    radius = draft.length * draft.dice.between("slimness", (0.15, 0.4))
    return {
        "kind": "cylinder",
        "radius": plain(radius),
        "length": plain(draft.length),
        "texture": draft.texture(),
    }


def _capsule(draft: _Draft) -> dict[str, Any]:
    radius = draft.length * draft.dice.between("slimness", (0.12, 0.3))
    return _rod(radius, draft.length - 2 * radius, draft.texture())


def _panel(draft: _Draft) -> dict[str, Any]:
    size = (draft.length, draft.length * draft.dice.between("edge y", (0.4, 1.0)))
    return {"kind": "box", "size": plain((*size, 0.04 * draft.length)), "texture": draft.texture()}


def _wheel(draft: _Draft) -> dict[str, Any]:
    """Return a disk with sectors, seen from its flat side, and a hub of another color."""
    radius = draft.length / 2
    disk = {
        "kind": "cylinder",
        "rotation": [90.0, 0.0, 0.0],
        "radius": plain(radius),
        "length": plain(0.25 * radius),
        "texture": draft.spokes(),
    }
    hub = {"kind": "sphere", "radius": plain(0.3 * radius), "texture": draft.texture("hub")}
    return {"kind": "group", "bodies": [disk, hub]}


def _stick(draft: _Draft) -> dict[str, Any]:
    radius = draft.thin()
    return _rod(radius, draft.length - 2 * radius, draft.texture())


def _fence(draft: _Draft) -> dict[str, Any]:
    """Return upright posts and two rails, as wide as the body is long."""
    count = draft.dice.whole("posts", (4, 9))
    radius, half = 0.5 * draft.thin(), draft.length / 2
    tall = draft.length * draft.dice.between("edge y", (0.4, 0.8))
    texture = draft.texture()
    posts = [
        _rod(radius, tall, texture)
        | {"position": plain((half * (2 * i / (count - 1) - 1), 0.0, 0.0))}
        for i in range(count)
    ]
    rails = [
        _rod(radius, draft.length, texture)
        | {"rotation": [0.0, 0.0, 90.0], "position": plain((0.0, side * 0.35 * tall, 0.0))}
        for side in (-1, 1)
    ]
    return {"kind": "group", "bodies": posts + rails}


def _torus_knot(draft: _Draft) -> dict[str, Any]:
    windings = [[2, 3], [2, 5], [3, 2], [3, 4]][draft.dice.whole("windings", (0, 3))]
    radius = 0.42 * draft.length
    tube = radius * draft.dice.between("thickness of the tube", (0.15, 0.3))
    sizes = {"radius": plain(radius), "tube": plain(tube)}
    detail = {"windings": windings, "segments": 256, "sides": 16}
    return _mesh(draft, {"kind": "torus_knot", **sizes, **detail})


def _gear(draft: _Draft) -> dict[str, Any]:
    radius, dice = draft.length / 2, draft.dice
    sizes = {
        "radius": plain(radius),
        "depth": plain(radius * dice.between("teeth's depth", (0.12, 0.3))),
        "bore": plain(radius * dice.between("bore", (0.15, 0.45))),
        "width": plain(radius * dice.between("width", (0.2, 0.5))),
        "teeth": dice.whole("teeth", (7, 24)),
    }
    return _mesh(draft, {"kind": "gear", **sizes})


def _blob(draft: _Draft) -> dict[str, Any]:
    waves = draft.dice.between("waves", (0.1, 0.4))
    shape = {
        "radius": plain(draft.length / 2 / (1 + waves)),
        "waves": plain(waves),
        "frequency": plain(draft.dice.between("frequency", (2.0, 6.0))),
        "subdivisions": 4,
    }
    return _mesh(draft, {"kind": "blob", **shape})


def _lathe(draft: _Draft) -> dict[str, Any]:
    """Return a vase, as high as the body is long."""
    points = [
        (draft.length * draft.dice.between(f"radius {i}", (0.1, 0.4)), draft.length * (i / 5 - 0.5))
        for i in range(6)
    ]
    profile = [(0.0, points[0][1]), *points, (0.0, points[-1][1])]
    shape = {"profile": [plain(point) for point in profile], "steps": 6, "segments": 64}
    return _mesh(draft, {"kind": "lathe", **shape})


def _mesh(draft: _Draft, generator: dict[str, Any]) -> dict[str, Any]:
    return {"kind": "mesh", "generator": generator, "texture": draft.texture()}


def _rod(radius: float, length: float, texture: Any) -> dict[str, Any]:
    sizes = {"radius": plain(radius), "length": plain(length)}
    return {"kind": "capsule", **sizes, "texture": texture}


_SHAPES: dict[str, Callable[[_Draft], dict[str, Any]]] = {
    "sphere": _sphere,
    "box": _box,
    "cylinder": _cylinder,
    "capsule": _capsule,
    "panel": _panel,
    "wheel": _wheel,
    "stick": _stick,
    "post": _stick,
    "fence": _fence,
    "torus_knot": _torus_knot,
    "gear": _gear,
    "blob": _blob,
    "lathe": _lathe,
}


# -- place and motion ------------------------------------------------------------------------------


def _half_height(kind: str, draft: _Draft) -> float:
    return 0.3 * draft.length if kind == "fence" else 0.5 * draft.length


def _rotation(kind: str, dice: Dice) -> Point:
    """Return any orientation, or one that suits a kind which stands or faces the camera."""
    if kind in _UPRIGHT:
        return 0.0, dice.between("yaw", (-50.0, 50.0)), dice.between("lean", (-6.0, 6.0))
    if kind in _FACING:
        lying = 90.0 if kind == "gear" else 0.0
        return lying + dice.between("pitch", (-25, 25)), dice.between("yaw", (-45, 45)), 0.0
    x, y, z = (dice.between(f"turn {axis}", (-180.0, 180.0)) for axis in "xyz")
    return x, y, z


def _motion(kind: str, draft: _Draft, position: Point) -> dict[str, Any]:
    motion = draft.dice.pick("motion", draft.group.motions)
    if motion == "still":
        return {}
    if motion == "held":
        return dict(draft.view.moves)
    speed = draft.dice.log_between("speed", draft.group.speed) * draft.wide
    if motion == "linear":
        return _linear(draft, speed)
    if motion == "approach":
        fastest = _CLOSEST * draft.depth
        ahead = draft.dice.sign("direction") * min(2 * speed, fastest)
        return {"velocity": plain(combined((ahead, draft.view.ahead)))}
    if motion == "orbit":
        return _orbit(draft, position, speed)
    moved = _linear(draft, speed) if motion == "tumble" else {}
    return moved | _spin(kind, draft)


def _linear(draft: _Draft, speed: float) -> dict[str, Any]:
    """Return a motion in any direction of the image, and a little in depth."""
    dice, view = draft.dice, draft.view
    angle = dice.between("heading", (0.0, 2 * math.pi))
    return {
        "velocity": plain(
            combined(
                (speed * math.cos(angle), view.right),
                (speed * math.sin(angle), view.up),
                (speed * dice.between("heading in depth", (-0.3, 0.3)), view.ahead),
            )
        )
    }


def _spin(kind: str, draft: _Draft) -> dict[str, Any]:
    """Return a turn about the body's own axis, if it has one, else about any."""
    dice = draft.dice
    spin = dice.log_between("spin", draft.group.spin) * dice.sign("sense")
    if kind in _UPRIGHT:
        axis: Point = (0.0, 1.0, 0.0)
    elif kind in _FACING:
        axis = _own_axis(_rotation(kind, dice), kind)
    else:
        axis = _any_axis(dice)
    return {"spin": plain(spin), "axis": plain(axis)}


def _own_axis(rotation: Point, kind: str) -> Point:
    """Return where the axis of a wheel (its z) or of a gear (its y) points, turned by x, then y."""
    x, y = math.radians(rotation[0]), math.radians(rotation[1])
    up, out = (math.cos(x), math.sin(x)) if kind == "gear" else (-math.sin(x), math.cos(x))
    return out * math.sin(y), up, out * math.cos(y)


def _any_axis(dice: Dice) -> Point:
    """Return a direction, evenly over the sphere."""
    height, angle = dice.between("axis up", (-1.0, 1.0)), dice.between("axis", (0, 2 * math.pi))
    flat = math.sqrt(1 - height**2)
    return flat * math.cos(angle), height, flat * math.sin(angle)


def _orbit(draft: _Draft, position: Point, speed: float) -> dict[str, Any]:
    """Return a turn about a point beside the body: in the image's plane, or over the ground."""
    dice, view = draft.dice, draft.view
    reach = dice.between("reach", (0.08, 0.3)) * draft.wide
    angle = dice.between("heading", (0.0, 2 * math.pi))
    is_upright = dice.chance("plane") < 0.5
    across, axis = (view.up, view.ahead) if is_upright else (view.ahead, view.up)
    aside = combined((math.cos(angle), view.right), (math.sin(angle), across))
    pivot = combined((1.0, position), (reach, aside))
    spin = min(math.degrees(speed / reach), _FASTEST_TURN) * dice.sign("sense")
    return {"spin": plain(spin), "axis": plain(axis), "pivot": plain(pivot)}
