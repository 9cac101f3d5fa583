"""Rays against one mesh, in the mesh's own space.

Warp finds the triangle in float32, with rays that start where they enter the mesh's bounding
sphere. Distance, normal and color are then computed from the triangle's corners, in the rays'
own type: in float64 a hit lies on the triangle's plane to 1e-12 or so. Which triangle it is at
an edge, and whether a ray just meets the mesh, stays a matter of float32.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchblur.render.mesh_body import Mesh, Source, load_geometry
from torchblur.render.mesh_files import GRAY, missing_extra
from torchblur.render.vectors import Vec

if TYPE_CHECKING:
    from torchblur.render.mesh_kernel import Bvh

__all__ = ["MeshHits", "MeshRays", "mesh_rays"]

_PAD = 1.01  # bounding spheres are larger than they need be: float32 may err
_SAME = 1e-3  # a refined distance this far from the found one, over the radius, is not believed


class MeshHits(NamedTuple):
    """Where rays meet a mesh before their limit, in its own space.

    Args:
        which: The rays that do, (K,).
        distance: Ray parameter, in lengths of the direction, (K,).
        point: The hit, a little below the surface, (K, 3); the mesh's own color there (linear) if
            it has no texture.
        normal: Unit normal on the side that the ray comes from, (K, 3). Interpolated normals may
            lean away from the ray at the rim.
    """

    which: Tensor
    distance: Tensor
    point: Tensor
    normal: Tensor


def mesh_rays(body: Mesh, device: torch.device, dtype: torch.dtype) -> MeshRays:
    """Return what rays need to know of a mesh; kept for the meshes used last.

    Args:
        body: The mesh.
        device: Where the rays are.
        dtype: Type of the rays.

    Raises:
        ConfigError: bad triangles, or warp or trimesh is not installed.
        FileFormatError: the file cannot be read.
    """
    return _mesh_rays(body.source, device, dtype)


class MeshRays:
    """One mesh on one device; see `mesh_rays`."""

    def __init__(self, source: Source, device: torch.device, dtype: torch.dtype) -> None:
        geometry = load_geometry(source)
        center, self._radius = _ball(geometry.corners)
        self._center = center.to(device, dtype)
        self._bvh = _bvh(source, device)
        geometry = dataclasses.replace(geometry, corners=geometry.corners - center)
        self._geometry = geometry.to(device, dtype)

    def closest(
        self, ray: tuple[Vec, Vec], limit: Tensor, near: float, skin: float | None
    ) -> MeshHits:
        """Return the hits of N rays.

        Args:
            ray: Origins and directions in the mesh's own space, N; directions of any length but 0.
            limit: Hits as far as this or farther do not count, in lengths of the direction, (N,).
            near: Nor do those that are as near as this or nearer.
            skin: Depth below the surface of `MeshHits.point`, scene units; None: it is the color.
        """
        rays = self._entering(torch.stack(ray[0], 1), torch.stack(ray[1], 1), limit, near)
        length = rays.direction.norm(dim=1)
        far, face = self._bvh.closest(
            rays.origin.float(),
            (rays.direction / length[:, None]).float(),
            ((rays.end - rays.begin) * length).float(),
        )
        found = (face >= 0).nonzero()[:, 0]
        rays, triangle = rays.keep(found), face[found].long()
        along = self._on_plane(rays, triangle, far[found] / length[found])
        distance = rays.begin + along
        point = rays.origin + rays.direction * along[:, None]
        counts = ((distance > near) & (distance < limit[rays.which])).nonzero()[:, 0]
        rays, triangle = rays.keep(counts), triangle[counts]
        own, normal = self._surface(rays, triangle, point[counts], skin)
        return MeshHits(rays.which, distance[counts], own, normal)

    def _entering(self, origin: Tensor, direction: Tensor, limit: Tensor, near: float) -> _Rays:
        """Return the rays that meet the ball around the mesh, from where they enter it on."""
        origin = origin - self._center
        square = (direction * direction).sum(1)
        middle = -(origin * direction).sum(1) / square
        nearest = origin + direction * middle[:, None]
        room = (self._radius * _PAD) ** 2 - (nearest * nearest).sum(1)
        half = (room.clamp(min=0) / square).sqrt()
        begin = (middle - half).clamp(min=near)
        end = torch.minimum(middle + half, limit)
        index = ((room >= 0) & (begin < end)).nonzero()[:, 0]
        start = origin + direction * begin[:, None]
        return _Rays(index, start[index], direction[index], begin[index], end[index])

    def _on_plane(self, rays: _Rays, triangle: Tensor, found: Tensor) -> Tensor:
        """Return how far along the rays their triangles' planes are, in the rays' own type."""
        if rays.origin.dtype == torch.float32:
            return found
        corner = self._geometry.corners[triangle]
        normal = _cross(corner)
        across = (normal * rays.direction).sum(1)
        exact = (normal * (corner[:, 0] - rays.origin)).sum(1) / across
        length = rays.direction.norm(dim=1)
        # Along a plane that the ray only grazes the quotient is anything.
        is_same = ((exact - found).abs() * length).nan_to_num(torch.inf) < _SAME * self._radius
        return torch.where(is_same, exact, found)

    def _surface(
        self, rays: _Rays, triangle: Tensor, point: Tensor, skin: float | None
    ) -> tuple[Tensor, Tensor]:
        corner = self._geometry.corners[triangle]
        flat = torch.nn.functional.normalize(_cross(corner), dim=1, eps=1e-30)
        weights = _weights(corner, point)
        normal = flat
        if self._geometry.normals is not None:
            mean = (self._geometry.normals[triangle] * weights[..., None]).sum(1)
            normal = torch.nn.functional.normalize(mean, dim=1, eps=1e-30)
        is_inside = (flat * rays.direction).sum(1, keepdim=True) > 0
        facing = torch.where(is_inside, -normal, normal)
        if skin is not None:
            return point + self._center - skin * flat, facing
        return self._color(triangle, weights), facing

    def _color(self, triangle: Tensor, weights: Tensor) -> Tensor:
        coloring = self._geometry.coloring
        if coloring is None:
            return torch.full_like(weights, GRAY)
        return coloring.at(triangle, weights)


class _Rays(NamedTuple):
    """Rays that may meet a mesh: where they come from, and where they begin and end to matter.

    `origin` is at the parameter `begin`, relative to the middle of the mesh.
    """

    which: Tensor
    origin: Tensor
    direction: Tensor
    begin: Tensor
    end: Tensor

    def keep(self, rows: Tensor) -> _Rays:
        return _Rays(*(part[rows] for part in self))


@functools.lru_cache(maxsize=16)
def _mesh_rays(source: Source, device: torch.device, dtype: torch.dtype) -> MeshRays:
    return MeshRays(source, device, dtype)


@functools.lru_cache(maxsize=16)
def _bvh(source: Source, device: torch.device) -> Bvh:
    try:
        from torchblur.render.mesh_kernel import Bvh
    except ImportError as error:
        raise missing_extra(error) from error
    corners = load_geometry(source).corners
    return Bvh((corners - _ball(corners)[0]).float().to(device))


def _ball(corners: Tensor) -> tuple[Tensor, float]:
    """Return center and radius of a ball around triangles, float64, (3,)."""
    points = corners.reshape(-1, 3)
    center = (points.amin(0) + points.amax(0)) / 2
    return center, float((points - center).norm(dim=1).max())


def _cross(corner: Tensor) -> Tensor:
    a, b, c = corner.unbind(1)
    normals: Tensor = torch.linalg.cross(b - a, c - a)
    return normals


def _weights(corner: Tensor, point: Tensor) -> Tensor:
    """Return the shares of three corners in points of their triangles, (K, 3)."""
    u, v, p = (x - corner[:, 0] for x in (corner[:, 1], corner[:, 2], point))
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    pu, pv = (p * u).sum(1), (p * v).sum(1)
    square = uu * vv - uv * uv
    second, third = (vv * pu - uv * pv) / square, (uu * pv - uv * pu) / square
    shares = torch.stack((1 - second - third, second, third), 1)
    shares = torch.nan_to_num(shares, 0.0, 1.0, 0.0).clamp(0, 1)
    return shares / shares.sum(1, keepdim=True).clamp(min=1e-9)
