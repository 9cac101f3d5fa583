"""Procedural bodies: what the YAML says of them, and how a ray meets them in their own space.

Each kind is one class: its fields, its `shape` (up to four numbers), and two pure functions over
rays: `interval`, the ray parameters where the ray enters and leaves (all kinds are convex), and
`normal`, the outward normal at a point of the surface. A new kind is a new class in `Solid`.
Triangle meshes are bodies, too; see `torchblur.render.mesh_body`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeAlias

import torch
from pydantic import Field
from torch import Tensor

from torchblur.render.motion import Number, Placed
from torchblur.render.textures import Texture
from torchblur.render.vectors import Vec, add, dot, scale

__all__ = ["Body", "Box", "Capsule", "Convex", "Cylinder", "Plane", "Solid", "Sphere"]

Size = Annotated[Number, Field(gt=0)]
Shape: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor]

_TINY = 1e-20


class Body(Placed):
    """What all bodies share."""

    object_id: int | None = Field(
        None,
        ge=1,
        description="number in the `object_id` layer; left out: that of the group, else the "
        "position in the list of the scene, counted from 1. The sky is 0",
    )
    emissive: bool = Field(
        False, description="show the texture's radiance as it is, without the light's cosine"
    )


class Convex(Body):
    """A body that a ray enters once, in closed form."""

    texture: Texture = Field(description="color over the surface, fixed to the body")

    @property
    def shape(self) -> tuple[float, ...]:
        """The numbers that `interval` and `normal` take."""
        raise NotImplementedError

    @staticmethod
    def interval(origin: Vec, direction: Vec, shape: Shape) -> tuple[Tensor, Tensor]:
        """Return the ray parameters of entry and exit, (N,) each; entry > exit is a miss."""
        raise NotImplementedError

    @staticmethod
    def normal(point: Vec, shape: Shape) -> Vec:
        """Return the outward unit normal at a point of the surface."""
        raise NotImplementedError


class Sphere(Convex):
    """A sphere around the origin."""

    kind: Literal["sphere"]
    radius: Size = Field(description="scene units, above 0")

    @property
    def shape(self) -> tuple[float, ...]:
        """Radius."""
        return (self.radius,)

    @staticmethod
    def interval(origin: Vec, direction: Vec, shape: Shape) -> tuple[Tensor, Tensor]:
        """See `Convex.interval`; by the closest approach, which keeps float32 accurate."""
        return _ball(origin, direction, shape[0])

    @staticmethod
    def normal(point: Vec, shape: Shape) -> Vec:
        """See `Convex.normal`."""
        return scale(point, 1 / shape[0])


class Box(Convex):
    """A box around the origin, its edges along the axes."""

    kind: Literal["box"]
    size: tuple[Size, Size, Size] = Field(description="full edge lengths in x, y, z, scene units")

    @property
    def shape(self) -> tuple[float, ...]:
        """Half edges."""
        return tuple(edge / 2 for edge in self.size)

    @staticmethod
    def interval(origin: Vec, direction: Vec, shape: Shape) -> tuple[Tensor, Tensor]:
        """See `Convex.interval`: three slabs."""
        x, y, z = (_slab(origin[i], direction[i], shape[i]) for i in range(3))
        near = torch.maximum(torch.maximum(x[0], y[0]), z[0])
        return near, torch.minimum(torch.minimum(x[1], y[1]), z[1])

    @staticmethod
    def normal(point: Vec, shape: Shape) -> Vec:
        """See `Convex.normal`."""
        x, y, z = (point[i] / shape[i] for i in range(3))
        is_x = (x.abs() >= y.abs()) & (x.abs() >= z.abs())
        is_y = ~is_x & (y.abs() >= z.abs())
        zero = torch.zeros_like(x)
        side = ~is_x & ~is_y
        return (
            torch.where(is_x, torch.sign(x), zero),
            torch.where(is_y, torch.sign(y), zero),
            torch.where(side, torch.sign(z), zero),
        )


class Plane(Convex):
    """A rectangle in the local x-y plane, seen from both sides; without a size it is endless."""

    kind: Literal["plane"]
    size: tuple[Size, Size] | None = Field(
        None, description="width and height, scene units; left out: endless"
    )

    @property
    def shape(self) -> tuple[float, ...]:
        """Half width and half height."""
        return tuple(edge / 2 for edge in self.size or (math.inf, math.inf))

    @staticmethod
    def interval(origin: Vec, direction: Vec, shape: Shape) -> tuple[Tensor, Tensor]:
        """See `Convex.interval`: entry and exit are one."""
        distance = -origin[2] / _away_from_zero(direction[2])
        x, y, _ = add(origin, scale(direction, distance))
        inside = (x.abs() <= shape[0]) & (y.abs() <= shape[1])
        return torch.where(inside, distance, math.inf), distance

    @staticmethod
    def normal(point: Vec, shape: Shape) -> Vec:
        """See `Convex.normal`."""
        zero = torch.zeros_like(point[2])
        return zero, zero, torch.ones_like(point[2])


class Cylinder(Convex):
    """A solid cylinder with flat ends, its axis along the local y axis (a flat one is a disk)."""

    kind: Literal["cylinder"]
    radius: Size = Field(description="scene units, above 0")
    length: Size = Field(description="from end to end, scene units, above 0")

    @property
    def shape(self) -> tuple[float, ...]:
        """Radius and half length."""
        return self.radius, self.length / 2

    @staticmethod
    def interval(origin: Vec, direction: Vec, shape: Shape) -> tuple[Tensor, Tensor]:
        """See `Convex.interval`: an endless tube within a slab."""
        return _stub(origin, direction, shape[0], shape[1])

    @staticmethod
    def normal(point: Vec, shape: Shape) -> Vec:
        """See `Convex.normal`."""
        x, y, z = point
        radial = torch.sqrt(x * x + z * z + _TINY)
        is_end = y.abs() / shape[1] >= radial / shape[0]
        zero = torch.zeros_like(y)
        return (
            torch.where(is_end, zero, x / radial),
            torch.where(is_end, torch.sign(y), zero),
            torch.where(is_end, zero, z / radial),
        )


class Capsule(Convex):
    """A cylinder with half spheres at its ends, its axis along the local y axis."""

    kind: Literal["capsule"]
    radius: Size = Field(description="scene units, above 0")
    length: Size = Field(description="between the centers of the end spheres, scene units")

    @property
    def shape(self) -> tuple[float, ...]:
        """Radius and half length."""
        return self.radius, self.length / 2

    @staticmethod
    def interval(origin: Vec, direction: Vec, shape: Shape) -> tuple[Tensor, Tensor]:
        """See `Convex.interval`: the union of a stub and two balls, which is convex."""
        x, y, z = origin
        parts = (
            _stub(origin, direction, shape[0], shape[1]),
            _ball((x, y - shape[1], z), direction, shape[0]),
            _ball((x, y + shape[1], z), direction, shape[0]),
        )
        near = torch.full_like(parts[0][0], math.inf)
        far = -near
        for start, end in parts:
            is_hit = start <= end
            near = torch.where(is_hit, torch.minimum(near, start), near)
            far = torch.where(is_hit, torch.maximum(far, end), far)
        return near, far

    @staticmethod
    def normal(point: Vec, shape: Shape) -> Vec:
        """See `Convex.normal`."""
        x, y, z = point
        along = torch.maximum(torch.minimum(y, shape[1]), -shape[1])
        return scale((x, y - along, z), 1 / shape[0])


Solid = Sphere | Box | Plane | Cylinder | Capsule
"""All kinds of procedural bodies."""


def _ball(origin: Vec, direction: Vec, radius: Tensor) -> tuple[Tensor, Tensor]:
    square = dot(direction, direction)
    middle = -dot(origin, direction) / square
    nearest = add(origin, scale(direction, middle))
    return _around(middle, radius * radius - dot(nearest, nearest), square)


def _stub(
    origin: Vec, direction: Vec, radius: Tensor, half_length: Tensor
) -> tuple[Tensor, Tensor]:
    square = direction[0] * direction[0] + direction[2] * direction[2] + _TINY
    middle = -(origin[0] * direction[0] + origin[2] * direction[2]) / square
    x, z = origin[0] + middle * direction[0], origin[2] + middle * direction[2]
    near, far = _around(middle, radius * radius - (x * x + z * z), square)
    start, end = _slab(origin[1], direction[1], half_length)
    return torch.maximum(near, start), torch.minimum(far, end)


def _around(middle: Tensor, room: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    half = torch.sqrt(torch.clamp(room, min=0) / square)
    return torch.where(room < 0, math.inf, middle - half), middle + half


def _slab(origin: Tensor, direction: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    inverse = 1 / _away_from_zero(direction)
    a, b = (-half - origin) * inverse, (half - origin) * inverse
    return torch.minimum(a, b), torch.maximum(a, b)


def _away_from_zero(value: Tensor) -> Tensor:
    return torch.where(value.abs() < _TINY, _TINY, value)
