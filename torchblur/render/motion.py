"""Rigid motion: where a body is at a time, and how rays get into its own space.

A placed thing carries ``x(t) = velocity t + pivot + R(axis, spin t) (position + R0 x - pivot)``
from its own space to that of its parent, t in frames. Nested things are folded to as few such
*levels* as possible: one, but for a thing that moves inside a group that turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchblur.params import Config
from torchblur.render.vectors import Vec, add, cross, dot, scale, subtract

__all__ = ["Level", "Number", "Placed", "Triple", "fold", "into", "level_table", "place", "turn"]

Number = Annotated[float, Field(strict=True)]
Triple = tuple[Number, Number, Number]

COLUMNS = 22  # velocity 3, center 3, axis 3, rate 1, arm 3, rest 9


class Placed(Config):
    """Where a thing is at frame 0, and how it moves: fields that bodies and groups share."""

    position: Triple = Field((0.0, 0.0, 0.0), description="origin at frame 0, scene units")
    rotation: Triple = Field(
        (0.0, 0.0, 0.0),
        description="orientation at frame 0: turns about the x, then y, then z axis, degrees",
    )
    velocity: Triple = Field((0.0, 0.0, 0.0), description="translation, scene units per frame")
    spin: Number = Field(0.0, description="turn about `axis`, degrees per frame, right-handed")
    axis: Triple = Field(
        (0.0, 0.0, 1.0), description="axis of the spin, in the parent's space; any length but 0"
    )
    pivot: Triple | None = Field(
        None,
        description="point on the axis at frame 0, in the parent's space, scene units; it moves "
        "with `velocity`; left out: `position`",
    )

    @model_validator(mode="after")
    def _axis_has_length(self) -> Placed:
        if math.hypot(*self.axis) < 1e-9:
            raise ValueError(f"`axis` must not be a zero vector, got {list(self.axis)}")
        return self

    def level(self) -> Level:
        """Return the motion as one level."""
        position = _vector(self.position)
        center = position if self.pivot is None else _vector(self.pivot)
        axis = _vector(self.axis)
        return Level(
            velocity=_vector(self.velocity),
            center=center,
            axis=axis / axis.norm(),
            rate=math.radians(self.spin),
            arm=position - center,
            rest=euler(self.rotation),
        )


class Level(NamedTuple):
    """One rigid motion: ``x(t) = velocity t + center + R(axis, rate t) (arm + rest x)``.

    Args:
        velocity: Scene units per frame, float64, (3,).
        center: A point of the axis at time 0, (3,).
        axis: Unit vector, (3,).
        rate: Radians per frame.
        arm: From the center to the thing's origin at time 0, (3,).
        rest: Orientation at time 0, (3, 3).
    """

    velocity: Tensor
    center: Tensor
    axis: Tensor
    rate: float
    arm: Tensor
    rest: Tensor

    def at(self, frame: float) -> Level:
        """Return the same motion with the clock set to 0 at a frame (it keeps float32 exact)."""
        turned = axis_rotation(self.axis, self.rate * frame)
        return self._replace(
            center=self.center + self.velocity * frame,
            arm=turned @ self.arm,
            rest=turned @ self.rest,
        )

    def row(self) -> Tensor:
        """Return the level as one row of a table, float64, (22,)."""
        rate = torch.tensor([self.rate], dtype=torch.float64)
        parts = (self.velocity, self.center, self.axis, rate, self.arm, self.rest.flatten())
        return torch.cat(parts)


def fold(levels: Iterable[Level]) -> list[Level]:
    """Join levels, outermost first, wherever two of them are one rigid motion of our form.

    Args:
        levels: At least one.

    Returns:
        One level, or more where something moves within a group that turns.
    """
    chain: list[Level] = []
    for level in levels:
        chain = chain[:-1] + _joined(chain[-1], level) if chain else [level]
    return chain


def level_table(chain: list[Level], frame: float) -> Tensor:
    """Return a chain of levels with time 0 at `frame`, float64, (levels, 22)."""
    return torch.stack([level.at(frame).row() for level in chain])


def into(levels: Tensor, time: Tensor, point: Vec, direction: Vec) -> tuple[Vec, Vec]:
    """Carry points and directions from the world into a body's own space, each at its own time.

    Args:
        levels: Table of the chain, (levels, 22), or (levels, 22, N) for a motion per point.
        time: Frames after the table's frame, (N,).
        point: World points, scene units, N.
        direction: World directions, N.

    Returns:
        Points and directions in the body's space; directions keep their length.
    """
    for level in levels.unbind(0):
        velocity, center, axis, rate, arm, rest = _unpack(level)
        cos, sin = torch.cos(rate * time), -torch.sin(rate * time)
        point = subtract(subtract(point, scale(velocity, time)), center)
        point = _transposed(rest, subtract(_turned(axis, cos, sin, point), arm))
        direction = _transposed(rest, _turned(axis, cos, sin, direction))
    return point, direction


def place(levels: Tensor, time: Tensor, point: Vec) -> Vec:
    """Carry points from a body's own space to the world, each at its own time.

    Args:
        levels: Table of the chain, (levels, 22), or (levels, 22, N).
        time: Frames after the table's frame, (N,).
        point: Points in the body's space, scene units, N.

    Returns:
        World points. Differentiable: in all arguments, the time above all.
    """
    for level in reversed(levels.unbind(0)):
        velocity, center, axis, rate, arm, rest = _unpack(level)
        cos, sin = torch.cos(rate * time), torch.sin(rate * time)
        point = _turned(axis, cos, sin, add(arm, _applied(rest, point)))
        point = add(add(point, center), scale(velocity, time))
    return point


def turn(levels: Tensor, time: Tensor, direction: Vec) -> Vec:
    """Carry directions from a body's own space to the world; arguments as in `place`."""
    for level in reversed(levels.unbind(0)):
        _, _, axis, rate, _, rest = _unpack(level)
        cos, sin = torch.cos(rate * time), torch.sin(rate * time)
        direction = _turned(axis, cos, sin, _applied(rest, direction))
    return direction


def euler(degrees: Triple) -> Tensor:
    """Return the rotation that turns about x, then y, then z, float64, (3, 3)."""
    result = torch.eye(3, dtype=torch.float64)
    for axis, angle in zip(torch.eye(3, dtype=torch.float64), degrees, strict=True):
        result = axis_rotation(axis, math.radians(angle)) @ result
    return result


def axis_rotation(axis: Tensor, angle: float) -> Tensor:
    """Return the right-handed rotation about a unit axis, angle in radians, (3, 3)."""
    x, y, z = (float(c) for c in axis)
    skew = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    identity = torch.eye(3, dtype=torch.float64)
    return identity + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)


def _joined(outer: Level, inner: Level) -> list[Level]:
    if outer.rate == 0.0:
        return [
            Level(
                velocity=outer.velocity + outer.rest @ inner.velocity,
                center=outer.center + outer.arm + outer.rest @ inner.center,
                axis=outer.rest @ inner.axis,
                rate=inner.rate,
                arm=outer.rest @ inner.arm,
                rest=outer.rest @ inner.rest,
            )
        ]
    if inner.rate == 0.0 and not bool(inner.velocity.any()):
        arm = outer.arm + outer.rest @ (inner.center + inner.arm)
        return [outer._replace(arm=arm, rest=outer.rest @ inner.rest)]
    return [outer, inner]


def _vector(values: Triple) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _unpack(level: Tensor) -> tuple[Vec, Vec, Vec, Tensor, Vec, tuple[Vec, Vec, Vec]]:
    c = level.unbind(0)
    rest = ((c[13], c[14], c[15]), (c[16], c[17], c[18]), (c[19], c[20], c[21]))
    return (
        (c[0], c[1], c[2]),
        (c[3], c[4], c[5]),
        (c[6], c[7], c[8]),
        c[9],
        (c[10], c[11], c[12]),
        rest,
    )


def _turned(axis: Vec, cos: Tensor, sin: Tensor, v: Vec) -> Vec:
    """Rotate by Rodrigues' formula."""
    along = scale(axis, dot(axis, v) * (1 - cos))
    return add(add(scale(v, cos), scale(cross(axis, v), sin)), along)


def _applied(rows: tuple[Vec, Vec, Vec], v: Vec) -> Vec:
    return dot(rows[0], v), dot(rows[1], v), dot(rows[2], v)


def _transposed(rows: tuple[Vec, Vec, Vec], v: Vec) -> Vec:
    return add(add(scale(rows[0], v[0]), scale(rows[1], v[1])), scale(rows[2], v[2]))
