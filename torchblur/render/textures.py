"""Procedural textures: colors of points in a body's own space.

Each kind is one class: its fields, its numbers in the scene's table (`row`), and one pure
function of points. Cells are centered on the origin (plus `offset`), so that a plane never lies
on the border of a cell. All patterns are solid (three-dimensional): a surface cuts through them.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchblur.params import Config
from torchblur.render.motion import Number, Triple
from torchblur.render.vectors import Vec, add, dot, scale, select, subtract

__all__ = ["TABLE_WIDTH", "TEXTURES", "Carried", "Texture"]

Radiance = Annotated[Number, Field(ge=0)]
Color = tuple[Radiance, Radiance, Radiance]
Length = Annotated[Number, Field(gt=0)]
Share = Annotated[Number, Field(ge=0, le=1)]

TABLE_WIDTH = 18
_OCTAVES = 3
_OWN = 10  # first column that a kind may use as it likes


class SolidTexture(Config):
    """One color everywhere."""

    kind: Literal["solid"]
    color: Color = Field(description="scene-linear radiance at full light; may exceed 1")

    def row(self) -> list[float]:
        """Return the numbers of this texture for the table, at most `TABLE_WIDTH`."""
        return [*self.color]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """Return the colors of points in the body's space; `row` holds a table column each."""
        return row[0] + 0 * point[0], row[1] + 0 * point[0], row[2] + 0 * point[0]


class Pattern(Config):
    """What the two-colored textures share."""

    color: Color = Field(description="scene-linear radiance at full light; may exceed 1")
    background: Color = Field(description="the second color, as `color`")
    offset: Triple = Field((0.0, 0.0, 0.0), description="shift of the pattern, scene units")
    variation: Share = Field(
        0.0, description="share by which the cells' brightness varies at random, 0 to 1"
    )

    def own(self) -> list[float]:
        """Return the numbers of this kind alone."""
        raise NotImplementedError

    def row(self) -> list[float]:
        """Return the numbers of this texture for the table, at most `TABLE_WIDTH`."""
        return [*self.color, *self.background, *self.offset, self.variation, *self.own()]


class Checker(Pattern):
    """Cubes of alternating color."""

    kind: Literal["checker"]
    size: Length = Field(description="edge of a cube, scene units")

    def own(self) -> list[float]:
        """Return the edge."""
        return [self.size]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        cell, _ = _cells(point, row, row[_OWN])
        return _two_colors(_is_odd(cell[0] + cell[1] + cell[2]), row, _hash(*cell))


class Stripes(Pattern):
    """Layers of alternating color."""

    kind: Literal["stripes"]
    size: Length = Field(description="thickness of a layer, scene units")
    direction: Triple = Field((1.0, 0.0, 0.0), description="across the layers; any length but 0")

    @model_validator(mode="after")
    def _direction_has_length(self) -> Stripes:
        if math.hypot(*self.direction) < 1e-9:
            raise ValueError(f"`direction` must not be a zero vector, got {list(self.direction)}")
        return self

    def own(self) -> list[float]:
        """Return the direction over the thickness."""
        length = math.hypot(*self.direction) * self.size
        return [component / length for component in self.direction]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        across = (row[_OWN], row[_OWN + 1], row[_OWN + 2])
        layer = torch.floor(dot(_shifted(point, row), across) + 0.5)
        zero = torch.zeros_like(layer)
        return _two_colors(_is_odd(layer), row, _hash(layer, zero, zero))


class Dots(Pattern):
    """Balls in a cubic lattice, one at the origin."""

    kind: Literal["dots"]
    spacing: Length = Field(description="between neighboring centers, scene units")
    radius: Annotated[Number, Field(gt=0, le=0.5)] = Field(
        0.35, description="radius of a ball over the spacing, at most 0.5"
    )

    def own(self) -> list[float]:
        """Return spacing and squared radius."""
        return [self.spacing, self.radius**2]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        cell, inside = _cells(point, row, row[_OWN])
        return _two_colors(dot(inside, inside) > row[_OWN + 1], row, _hash(*cell))


class Crosses(Pattern):
    """Three crossing bars in each cell of a cubic lattice, one cross at the origin."""

    kind: Literal["crosses"]
    spacing: Length = Field(description="between neighboring crosses, scene units")
    length: Annotated[Number, Field(gt=0, le=1)] = Field(
        0.6, description="length of a bar over the spacing, at most 1"
    )
    width: Annotated[Number, Field(gt=0, le=1)] = Field(
        0.15, description="width of a bar over the spacing, at most 1"
    )

    def own(self) -> list[float]:
        """Return spacing, half length and half width."""
        return [self.spacing, self.length / 2, self.width / 2]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        cell, inside = _cells(point, row, row[_OWN])
        x, y, z = (c.abs() for c in inside)
        reach = torch.maximum(torch.maximum(x, y), z)
        # The middle one of the three: two coordinates lie within the bar's width.
        middle = torch.maximum(torch.minimum(x, y), torch.minimum(torch.maximum(x, y), z))
        outside = (reach > row[_OWN + 1]) | (middle > row[_OWN + 2])
        return _two_colors(outside, row, _hash(*cell))


class Brick(Pattern):
    """Bricks in running bond: courses along y, bricks along x + z, `background` is the mortar."""

    kind: Literal["brick"]
    size: tuple[Length, Length] = Field(description="width and height of a brick, scene units")
    mortar: Annotated[Number, Field(ge=0, lt=1)] = Field(
        0.12, description="width of the joints over the brick's height, below 1"
    )

    def own(self) -> list[float]:
        """Return width, height and the width of a joint."""
        return [*self.size, self.mortar * self.size[1]]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        x, y, z = _shifted(point, row)
        width, height, joint = row[_OWN], row[_OWN + 1], row[_OWN + 2]
        course = torch.floor(y / height)
        along = (x + z) / width + 0.5 * _is_odd(course).to(x.dtype)
        brick = torch.floor(along)
        in_joint = ((along - brick) * width < joint) | ((y / height - course) * height < joint)
        return _two_colors(in_joint, row, _hash(brick, course, torch.zeros_like(brick)))


class Noise(Pattern):
    """Smooth noise of three octaves between the two colors."""

    kind: Literal["noise"]
    size: Length = Field(description="size of the largest features, scene units")
    contrast: Annotated[Number, Field(gt=0, le=20)] = Field(
        2.5, description="steepness of the change from one color to the other"
    )

    def own(self) -> list[float]:
        """Return size and contrast."""
        return [self.size, self.contrast]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        total = _smooth_noise(scale(_shifted(point, row), 1 / row[_OWN]))
        mix = torch.clamp((total - 0.5) * row[_OWN + 1] + 0.5, 0, 1)
        front, back = (row[0], row[1], row[2]), (row[3], row[4], row[5])
        return add(scale(front, mix), scale(back, 1 - mix))


class Spokes(Pattern):
    """Sectors of alternating color about an axis through the origin."""

    kind: Literal["spokes"]
    count: int = Field(description="number of sectors of each color", ge=1, le=100)
    axis: Literal["x", "y", "z"] = Field("y", description="the axis between the sectors")

    def own(self) -> list[float]:
        """Return the sectors per radian and the two axes of the angle."""
        first = "xyz".index(self.axis) + 1
        across = [float(i == first % 3) for i in range(3)]
        up = [float(i == (first + 1) % 3) for i in range(3)]
        return [self.count / math.pi, *across, *up]

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        at = _shifted(point, row)
        across = dot(at, (row[_OWN + 1], row[_OWN + 2], row[_OWN + 3]))
        up = dot(at, (row[_OWN + 4], row[_OWN + 5], row[_OWN + 6]))
        sector = torch.floor((torch.atan2(up, across) + math.pi) * row[_OWN])
        zero = torch.zeros_like(sector)
        return _two_colors(_is_odd(sector), row, _hash(sector, zero, zero))


Texture = Annotated[
    SolidTexture | Checker | Stripes | Dots | Crosses | Brick | Noise | Spokes,
    Field(discriminator="kind"),
]
"""All kinds of textures, told apart by `kind`."""


class Carried:
    """The texture of a mesh with colors of its own: its points are the colors."""

    def row(self) -> list[float]:
        """Return no numbers; see `SolidTexture.row`."""
        return []

    @staticmethod
    def paint(point: Vec, row: list[Tensor]) -> Vec:
        """See `SolidTexture.paint`."""
        return point


TEXTURES = (SolidTexture, Checker, Stripes, Dots, Crosses, Brick, Noise, Spokes, Carried)


def _shifted(point: Vec, row: list[Tensor]) -> Vec:
    return subtract(point, (row[6], row[7], row[8]))


def _cells(point: Vec, row: list[Tensor], size: Tensor) -> tuple[Vec, Vec]:
    """Return the cell's integer coordinates and the position in it, [-1/2, 1/2)."""
    at = scale(_shifted(point, row), 1 / size)
    cell = (torch.floor(at[0] + 0.5), torch.floor(at[1] + 0.5), torch.floor(at[2] + 0.5))
    return cell, subtract(at, cell)


def _two_colors(is_background: Tensor, row: list[Tensor], chance: Tensor) -> Vec:
    front, back = (row[0], row[1], row[2]), (row[3], row[4], row[5])
    return scale(select(is_background, back, front), 1 - row[9] * chance)


def _is_odd(integer: Tensor) -> Tensor:
    return integer - 2 * torch.floor(integer / 2) > 0.5


def _hash(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Return a number in [0, 1) per integer cell: exact in float32, alike on all machines."""
    return _permuted(_permuted(_permuted(_modulo(z)) + _modulo(y)) + _modulo(x)) / 289


def _permuted(x: Tensor) -> Tensor:
    """Permute the integers modulo 289 by a polynomial (all steps are exact in float32)."""
    x = _modulo(x)
    return _modulo((34 * x + 10) * x)


def _modulo(x: Tensor) -> Tensor:
    return x - 289 * torch.floor(x / 289)


def _smooth_noise(at: Vec) -> Tensor:
    """Return value noise in [0, 1]: random numbers at the integers, smooth in between.

    All octaves and corners are one sum, which compiles to a short loop (as 24 written-out terms
    it took a minute to compile).
    """
    term = torch.arange(8 * _OCTAVES, dtype=at[0].dtype, device=at[0].device)[:, None]
    octave = torch.floor(term / 8)
    frequency = torch.exp2(octave)
    weight = 1 / (frequency * (2 - 0.5 ** (_OCTAVES - 1)))
    cell = []
    for axis in range(3):
        moved = at[axis] * frequency + 17.31 * octave
        corner = torch.floor(moved)
        offset = torch.floor(term / 2**axis) - 2 * torch.floor(term / 2 ** (axis + 1))
        share = _eased(moved - corner)
        weight = weight * torch.where(offset > 0.5, share, 1 - share)
        cell.append(corner + offset)
    return (weight * _hash(cell[0], cell[1], cell[2])).sum(0)


def _eased(t: Tensor) -> Tensor:
    return t * t * (3 - 2 * t)
