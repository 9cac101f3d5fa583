"""The camera of a drawn scene: where it stands, how it moves, and what is where before it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from torchblur.render.family_config import CameraRanges
from torchblur.render.family_dice import Dice

__all__ = ["Point", "View", "combined", "draw_view", "plain"]

Point = tuple[float, float, float]

_EDGE = 0.5  # from the middle of the image to its side, widths
_TURN_OF_A_WALK = 0.3  # share of its speed


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera, as the fields of the scene have it, and its geometry at frame 0.

    Args:
        fov: Horizontal field of view, radians.
        height: Above the floor, scene units; the camera is at x = z = 0.
        tilt: How far it looks down, radians.
        moves: `velocity`, `spin`, `axis` and `pivot` of the camera, for what is held, too.
    """

    fov: float
    height: float
    tilt: float
    moves: dict[str, Any] = field(default_factory=dict)

    @property
    def right(self) -> Point:
        """To the right of the image, unit vector."""
        return 1.0, 0.0, 0.0

    @property
    def up(self) -> Point:
        """Upwards in the image, unit vector."""
        return 0.0, math.cos(self.tilt), -math.sin(self.tilt)

    @property
    def ahead(self) -> Point:
        """Away from the camera, unit vector."""
        return 0.0, -math.sin(self.tilt), -math.cos(self.tilt)

    @property
    def position(self) -> Point:
        """Of the camera."""
        return 0.0, self.height, 0.0

    def width(self, depth: float) -> float:
        """Return the width of the image at a depth, scene units."""
        return 2 * depth * math.tan(self.fov / 2)

    def at(self, across: float, up: float, depth: float) -> Point:
        """Return the world point at a place of the image (widths from its middle) and depth."""
        wide = self.width(depth)
        step = combined((across * wide, self.right), (up * wide, self.up), (depth, self.ahead))
        return step[0], step[1] + self.height, step[2]

    def fields(self) -> dict[str, Any]:
        """Return the `camera` of the scene."""
        return {
            "position": plain(self.position),
            "rotation": plain((-math.degrees(self.tilt), 0.0, 0.0)),
            "fov": plain(math.degrees(self.fov)),
            **self.moves,
        }


def draw_view(ranges: CameraRanges, dice: Dice) -> View:
    """Draw a camera."""
    still = View(
        fov=math.radians(dice.between("fov", ranges.fov)),
        height=dice.log_between("height", ranges.height),
        tilt=math.radians(dice.between("tilt", ranges.tilt)),
    )
    motion = dice.pick("motion", ranges.motions)
    speed = dice.log_between("speed", ranges.speed) * dice.sign("direction")
    return View(
        fov=still.fov,
        height=still.height,
        tilt=still.tilt,
        moves=_moves(still, motion, speed, ranges.subject),
    )


def combined(*parts: tuple[float, Point]) -> Point:
    """Return a sum of vectors, each times its factor."""
    x, y, z = (sum(factor * vector[i] for factor, vector in parts) for i in range(3))
    return x, y, z


def plain(value: float | tuple[float, ...]) -> Any:
    """Return a number or vector as a file has it, rounded: the same on all machines."""
    if isinstance(value, tuple):
        return [plain(number) for number in value]
    return round(value, 5) + 0.0


def _moves(view: View, motion: str, speed: float, subject: float) -> dict[str, Any]:
    turn = math.degrees(speed * view.width(1.0))  # of a turn only the middle has this speed
    wide = view.width(subject)
    ahead = plain(combined((abs(speed) * subject / _EDGE, view.ahead)))
    here = plain(view.position)
    kinds: dict[str, dict[str, Any]] = {
        "still": {},
        "pan": {"spin": plain(turn), "axis": [0.0, 1.0, 0.0]},
        "tilt": {"spin": plain(turn), "axis": plain(view.right)},
        "truck": {"velocity": plain(combined((speed * wide, view.right)))},
        "dolly": {"velocity": plain(combined((speed * subject / _EDGE, view.ahead)))},
        "roll": {"spin": plain(math.degrees(speed / _EDGE)), "axis": plain(view.ahead)},
        "arc": {"spin": plain(turn), "axis": [0.0, 1.0, 0.0]},
        "walk": {"velocity": ahead, "spin": plain(_TURN_OF_A_WALK * turn), "axis": [0.0, 1.0, 0.0]},
    }
    pivot = plain(view.at(0.0, 0.0, subject)) if motion == "arc" else here
    return kinds[motion] | ({"pivot": pivot} if "spin" in kinds[motion] else {})
