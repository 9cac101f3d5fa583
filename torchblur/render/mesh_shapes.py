"""Surfaces of triangles that are computed, not read: knots, gears, blobs and turned profiles.

Each kind is one class: its fields, and `surface`, the triangles. All are closed unless said
otherwise, and wind counterclockwise seen from outside.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from torchblur.params import Config
from torchblur.render.motion import Number

__all__ = ["Blob", "Gear", "Generator", "Lathe", "Surface", "TorusKnot"]

Array: TypeAlias = NDArray[np.float64]
Size = Annotated[Number, Field(gt=0)]
Radius = Annotated[Number, Field(ge=0)]

_GOLDEN = (1 + math.sqrt(5)) / 2


class Surface(NamedTuple):
    """Triangles with shared vertices.

    Args:
        vertices: Positions, scene units, float64, (V, 3).
        faces: Vertices of each triangle, (F, 3).
        is_smooth: Whether the surface is round, so that normals should be interpolated.
    """

    vertices: Array
    faces: NDArray[np.int64]
    is_smooth: bool


class TorusKnot(Config):
    """A tube along a knot on a torus around the z axis."""

    kind: Literal["torus_knot"]
    radius: Size = Field(1.0, description="of the torus, scene units")
    tube: Size = Field(0.3, description="radius of the tube, scene units")
    windings: tuple[int, int] = Field(
        (2, 3), description="turns about the torus' axis and about its ring; without common divisor"
    )
    segments: int = Field(512, ge=8, le=4096, description="along the tube")
    sides: int = Field(32, ge=3, le=512, description="around the tube")

    @model_validator(mode="after")
    def _is_one_knot(self) -> TorusKnot:
        if min(self.windings) < 1 or math.gcd(*self.windings) != 1:
            raise ValueError(
                f"`windings` must be two numbers of at least 1 without a common divisor, got "
                f"{list(self.windings)}"
            )
        return self

    def surface(self) -> Surface:
        """Return ``2 * segments * sides`` triangles."""
        angle = np.linspace(0, 2 * math.pi, self.segments, endpoint=False)
        step = 1e-4
        here, after = self._curve(angle), self._curve(angle + step)
        along = after - here
        across = np.cross(along, after + here)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        up = np.cross(across, along)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        turn = np.linspace(0, 2 * math.pi, self.sides, endpoint=False)[:, None]
        rings = here[:, None] + self.tube * (
            np.cos(turn) * up[:, None] + np.sin(turn) * across[:, None]
        )
        faces = _grid(self.segments, self.sides, is_ring=True)
        return Surface(rings.reshape(-1, 3), faces, is_smooth=True)

    def _curve(self, angle: Array) -> Array:
        about_axis, about_ring = (n * angle for n in self.windings)
        reach = self.radius * (2 + np.cos(about_ring)) / 3
        height = self.radius * np.sin(about_ring) / 3
        return np.stack((reach * np.cos(about_axis), reach * np.sin(about_axis), height), 1)


class Gear(Config):
    """A spur gear with a bore, its axis along the y axis (as that of a cylinder)."""

    kind: Literal["gear"]
    radius: Size = Field(1.0, description="to the tips of the teeth, scene units")
    depth: Size = Field(0.2, description="of the teeth, scene units, below `radius` - `bore`")
    bore: Size = Field(0.3, description="radius of the hole, scene units")
    width: Size = Field(0.3, description="along the axis, scene units")
    teeth: int = Field(16, ge=3, le=1000, description="number of teeth")

    @model_validator(mode="after")
    def _has_a_body(self) -> Gear:
        if self.bore + self.depth >= self.radius:
            raise ValueError(
                f"`bore` + `depth` must be less than `radius` {self.radius:g}, got "
                f"{self.bore:g} + {self.depth:g}"
            )
        return self

    def surface(self) -> Surface:
        """Return ``32 * teeth`` triangles."""
        share = np.tile([0.0, 0.25, 0.375, 0.875], self.teeth) * [1.0]
        angle = (np.repeat(np.arange(self.teeth), 4) + share) * 2 * math.pi / self.teeth
        reach = np.tile([1.0, 1.0, 0.0, 0.0], self.teeth) * self.depth + self.radius - self.depth
        half = self.width / 2
        inner = np.full_like(reach, self.bore)
        # Around the section of the gear: up the bore, out along the top, down, and in.
        section = [(inner, -half), (inner, half), (reach, half), (reach, -half)]
        rings = [
            np.stack((r * np.sin(angle), np.full_like(r, y), r * np.cos(angle)), 1)
            for r, y in section
        ]
        vertices = np.stack(rings, 1).reshape(-1, 3)
        return Surface(vertices, _grid(len(angle), 4, is_ring=True), is_smooth=False)


class Blob(Config):
    """A sphere with waves on it."""

    kind: Literal["blob"]
    radius: Size = Field(1.0, description="mean radius, scene units")
    waves: Annotated[Number, Field(ge=0, lt=1)] = Field(
        0.15, description="height of the waves over the radius, in [0, 1); 0 is a sphere"
    )
    frequency: Size = Field(4.0, description="waves, in radians over the unit sphere")
    subdivisions: int = Field(
        5, ge=0, le=8, description="times that an icosahedron's triangles are cut into four"
    )

    def surface(self) -> Surface:
        """Return ``20 * 4 ** subdivisions`` triangles."""
        points, faces = _icosahedron()
        for _ in range(self.subdivisions):
            points, faces = _quartered(points, faces)
        x, y, z = self.frequency * points.T
        height = np.sin(x + 0.4 * y) * np.sin(y + 1.3 * z + 1) * np.sin(z - 0.6 * x + 2)
        radii = self.radius * (1 + self.waves * height)
        return Surface(points * radii[:, None], faces, is_smooth=True)


class Lathe(Config):
    """A profile turned about the y axis: vases, bowls, columns."""

    kind: Literal["lathe"]
    profile: tuple[tuple[Radius, Number], ...] = Field(
        min_length=2,
        description="radius and height of points from the lower end of the outside on, scene "
        "units; the surface is closed where it begins and ends at radius 0",
    )
    is_curved: bool = Field(
        True, description="a smooth curve through the points (Catmull-Rom), else straight pieces"
    )
    steps: int = Field(12, ge=1, le=256, description="pieces between two points, if curved")
    segments: int = Field(128, ge=3, le=4096, description="around the axis")

    def surface(self) -> Surface:
        """Return up to ``2 * segments`` triangles per piece of the profile."""
        line = np.array(self.profile)
        if self.is_curved:
            line = _catmull_rom(line, self.steps)
        line[:, 0] = np.maximum(line[:, 0], 0)
        angle = np.linspace(0, 2 * math.pi, self.segments, endpoint=False)
        radius, height = line.T[..., None]
        rings = np.stack(
            np.broadcast_arrays(radius * np.sin(angle), height, radius * np.cos(angle)), -1
        )
        faces = _grid(len(line), self.segments, is_ring=False)
        return Surface(rings.reshape(-1, 3), _with_area(rings.reshape(-1, 3), faces), True)


Generator = Annotated[TorusKnot | Gear | Blob | Lathe, Field(discriminator="kind")]
"""All kinds of computed surfaces, told apart by `kind`."""


def _grid(rows: int, columns: int, *, is_ring: bool) -> NDArray[np.int64]:
    """Return two triangles per cell of a grid whose columns close to a ring, and rows perhaps."""
    row, column = np.meshgrid(
        np.arange(rows if is_ring else rows - 1), np.arange(columns), indexing="ij"
    )
    below, beside = (row + 1) % rows, (column + 1) % columns
    a, b = row * columns + column, row * columns + beside
    c, d = below * columns + beside, below * columns + column
    first, second = np.stack((a, b, c), -1), np.stack((a, c, d), -1)
    return np.concatenate((first.reshape(-1, 3), second.reshape(-1, 3)))


def _with_area(vertices: Array, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Leave out the triangles that a pole makes of its cells."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    kept: NDArray[np.int64] = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0]
    return kept


def _icosahedron() -> tuple[Array, NDArray[np.int64]]:
    g = _GOLDEN
    points = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g),
              (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
             (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
             (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]  # fmt: skip
    return np.array(points) / math.hypot(1, g), np.array(faces)


def _quartered(points: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Cut each triangle into four; new points lie on the unit sphere."""
    a, b, c = faces.T
    edges = np.sort(np.concatenate((faces[:, :2], faces[:, 1:], faces[:, ::2])), axis=1)
    unique, where = np.unique(edges, axis=0, return_inverse=True)
    middle = points[unique].mean(1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ac = (where.reshape(3, -1) + len(points))[[0, 1, 2]]
    parts = ((a, ab, ac), (ab, b, bc), (ac, bc, c), (ab, bc, ac))
    return np.concatenate((points, middle)), np.concatenate([np.stack(p, 1) for p in parts])


def _catmull_rom(points: Array, steps: int) -> Array:
    """Return a smooth curve through points, with `steps` pieces between two."""
    ends = np.concatenate((2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]))
    before, start, stop, after = ends[:-3], ends[1:-2], ends[2:-1], ends[3:]
    t = (np.arange(steps) / steps)[:, None, None]
    curve = 0.5 * (
        2 * start
        + (stop - before) * t
        + (2 * before - 5 * start + 4 * stop - after) * t**2
        + (3 * start - before - 3 * stop + after) * t**3
    )
    return np.concatenate((curve.swapaxes(0, 1).reshape(-1, 2), points[-1:]))
