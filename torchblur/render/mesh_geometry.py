"""Triangles ready for rays: checked, cleaned, with the normals and colors of their corners."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchblur.errors import ConfigError

__all__ = ["Coloring", "Geometry", "make_geometry", "smooth_normals"]

_MERGE = 1e-6  # vertices nearer than this, over the size of the mesh, share a smooth normal


@dataclass(frozen=True, kw_only=True, eq=False)
class Coloring:
    """The colors of a mesh: tints of the corners times images.

    Args:
        tint: Linear color of each corner, float32, (F, 3, 3): corner, then channel.
        place: Texture coordinates of each corner, from the lower left, repeating, (F, 3, 2).
        image: Image of each triangle, -1 for none, int64, (F,).
        images: First pixel, height and width of each image, int64, (I, 3).
        pixels: Linear colors of all images, row by row, float32, (P, 3).
    """

    tint: Tensor
    place: Tensor
    image: Tensor
    images: Tensor
    pixels: Tensor

    def at(self, face: Tensor, weights: Tensor) -> Tensor:
        """Return the linear colors of points, (N, 3).

        Args:
            face: Triangles, (N,).
            weights: Shares of their corners, (N, 3).
        """
        color = (self.tint[face] * weights[..., None]).sum(1)
        image = self.image[face]
        if not len(self.images):
            return color
        place = (self.place[face] * weights[..., None]).sum(1)
        texel = self._bilinear(image.clamp(min=0), place)
        return torch.where((image >= 0)[:, None], color * texel, color)

    def _bilinear(self, image: Tensor, place: Tensor) -> Tensor:
        first, height, width = self.images[image].unbind(1)
        x = (place[:, 0] - place[:, 0].floor()) * width - 0.5
        y = (1 - (place[:, 1] - place[:, 1].floor())) * height - 0.5
        left, top = x.floor(), y.floor()
        total = torch.zeros_like(self.pixels[:1])
        for dx in (0, 1):
            for dy in (0, 1):
                share = (1 - (x - left - dx).abs()) * (1 - (y - top - dy).abs())
                column = (left.long() + dx) % width
                row = (top.long() + dy) % height
                total = total + share[:, None] * self.pixels[first + row * width + column]
        return total


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry:
    """Triangles in a body's own space.

    Args:
        corners: Positions, scene units, float64, (F, 3, 3): corner, then coordinate.
        normals: Unit normals of the corners, float64, (F, 3, 3); None: flat faces.
        coloring: The mesh's own colors, if it has some.
    """

    corners: Tensor
    normals: Tensor | None = None
    coloring: Coloring | None = None

    def to(self, device: torch.device, dtype: torch.dtype) -> Geometry:
        """Return it on another device, its floating tensors of another type."""
        coloring = self.coloring
        if coloring is not None:
            parts = {f.name: getattr(coloring, f.name) for f in dataclasses.fields(coloring)}
            coloring = Coloring(**{name: _moved(t, device, dtype) for name, t in parts.items()})
        normals = None if self.normals is None else _moved(self.normals, device, dtype)
        corners = _moved(self.corners, device, dtype)
        return Geometry(corners=corners, normals=normals, coloring=coloring)

    def keep(self, faces: Tensor) -> Geometry:
        """Return only some of the triangles, bool, (F,)."""
        coloring = self.coloring
        if coloring is not None:
            rows = {name: getattr(coloring, name)[faces] for name in ("tint", "place", "image")}
            coloring = dataclasses.replace(coloring, **rows)
        normals = None if self.normals is None else self.normals[faces]
        return Geometry(corners=self.corners[faces], normals=normals, coloring=coloring)


def make_geometry(geometry: Geometry, scale: float, source: str) -> Geometry:
    """Return the triangles at their size, without those that have no area.

    Args:
        geometry: As it was read or computed.
        scale: Factor on all positions.
        source: What it is, for messages.

    Raises:
        ConfigError: no triangle, NaN or inf in a corner, or no triangle with an area.
    """
    if not len(geometry.corners):
        raise ConfigError(f"a mesh must have triangles, got none ({source})")
    bad = ~torch.isfinite(geometry.corners).all(2).all(1)
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        place = [float(x) for x in geometry.corners[first].flatten()]
        raise ConfigError(
            f"the vertices of a mesh must be finite, got {int(bad.sum())} of {len(bad)} triangles "
            f"with NaN or inf, the first is triangle {first} at {place} ({source})"
        )
    is_flat = areas(geometry.corners) <= 1e-12 * float(_extent(geometry.corners)) ** 2
    if bool(is_flat.all()):
        raise ConfigError(f"all {len(is_flat)} triangles of a mesh have no area ({source})")
    if bool(is_flat.any()):
        warnings.warn(
            f"{int(is_flat.sum())} of {len(is_flat)} triangles have no area and are left out "
            f"({source})",
            stacklevel=2,
        )
        geometry = geometry.keep(~is_flat)
    return dataclasses.replace(geometry, corners=geometry.corners * scale)


def areas(corners: Tensor) -> Tensor:
    """Return twice the areas of triangles, (F,)."""
    result: Tensor = _cross(corners).norm(dim=1)
    return result


def smooth_normals(corners: Tensor) -> Tensor:
    """Return normals that are smooth over all edges, weighted by angle, (F, 3, 3).

    Corners at one place share a normal, also where a file has them apart (at texture seams).
    """
    points = corners.reshape(-1, 3)
    step = max(float(_extent(corners)), 1e-30) * _MERGE
    cells: NDArray[np.int64] = (points / step).round().long().numpy()
    _, where = np.unique(cells, axis=0, return_inverse=True)
    index = torch.from_numpy(where.reshape(-1))
    sums = torch.zeros((int(index.max()) + 1, 3), dtype=corners.dtype)
    flat = torch.nn.functional.normalize(_cross(corners), dim=1, eps=1e-30)
    sums.index_add_(0, index, (flat[:, None] * _angles(corners)[..., None]).reshape(-1, 3))
    mean = sums[index].reshape(-1, 3, 3)
    length = mean.norm(dim=2, keepdim=True)
    return torch.where(length > 1e-6, mean / length.clamp(min=1e-6), flat[:, None])


def _angles(corners: Tensor) -> Tensor:
    """Return the angles of triangles at their corners, radians, (F, 3)."""
    after, before = (corners.roll(shift, 1) - corners for shift in (-1, 1))
    cosine = torch.nn.functional.cosine_similarity(after, before, dim=2, eps=1e-30)
    return cosine.clamp(-1, 1).acos()


def _cross(corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(1)
    normals: Tensor = torch.linalg.cross(b - a, c - a)
    return normals


def _extent(corners: Tensor) -> Tensor:
    points = corners.reshape(-1, 3)
    return (points.amax(0) - points.amin(0)).amax()


def _moved(tensor: Tensor, device: torch.device, dtype: torch.dtype) -> Tensor:
    return tensor.to(device, dtype if tensor.is_floating_point() else None)
