"""Rays against a scene: the closest hit, each ray at its own time, and the radiance it sees.

One small function is run per body (`_step`) and per kind of texture (`_painter`). They are
compiled once per kind, not per scene: sizes, motions and colors are rows of tables. Meshes come
after all other bodies, and are never compiled by torch (`_mesh_step`). Without the compiler normals
and textures are computed for the rays alone that need them (`_trace_convex`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torchblur.render.bodies import Convex
from torchblur.render.camera import camera_rays, lens
from torchblur.render.compiling import execute
from torchblur.render.mesh_body import Mesh
from torchblur.render.mesh_rays import MeshRays, mesh_rays
from torchblur.render.motion import Placed, Triple, fold, into, level_table, turn
from torchblur.render.scene import Scene
from torchblur.render.textures import TABLE_WIDTH, TEXTURES, Carried
from torchblur.render.vectors import Vec, add, dot, normalize, scale, select, subtract

__all__ = ["CHUNK", "Hit", "Tracer"]

CHUNK = 1 << 16
"""Rays that are traced at once; bounds the memory to some 150 MB."""

_NEAR = 1e-4  # hits nearer than this, in lengths of the direction, are not seen
_ROOM = 64  # tables of bodies are as long as a multiple of this
_SKIN = 1e-4  # textures are taken this far below the surface: never on a border of cells


class Hit(NamedTuple):
    """What N rays meet first.

    Args:
        distance: Ray parameter of the hit, in lengths of the direction, +inf for the sky, (N,).
        body: Index of the body, the number of bodies for the sky, int32, (N,).
        point: What textures take: the hit in the body's own space, just below the surface, scene
            units; for the sky the unit direction; for a mesh without a texture its own color
            there; (3, N).
        normal: Unit normal in the world, facing the ray (interpolated normals of a mesh may lean
            away at its rim); 0 for the sky, (3, N).
    """

    distance: Tensor
    body: Tensor
    point: Tensor
    normal: Tensor


class Tracer:
    """A scene around one frame, ready to be asked for hits and radiances.

    Args:
        scene: The scene.
        frame: The frame that is time 0, in frames.
        dtype: float32 for references, float64 for what must be exact.
        device: Where the rays are.
        compiled: Whether to compile (`torch.compile`); without a compiler the same is done
            slowly, with one warning.
    """

    def __init__(
        self,
        scene: Scene,
        frame: float = 0.0,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        compiled: bool = False,
    ) -> None:
        self._dtype = dtype
        self._device = torch.device(device)
        self._compiled = compiled
        self.camera = scene.camera
        placed = scene.placed_bodies()
        self.bodies = [body for body, _, _ in placed]
        self.object_ids = torch.tensor([number for *_, number in placed] + [0], device=device)
        self.levels = [self._table(level_table(fold(each), frame)) for _, each, _ in placed]
        self.camera_levels = self._table(level_table(fold([scene.camera.level()]), frame))
        self._shapes = [
            self._table(_filled(body.shape, 4)) if isinstance(body, Convex) else None
            for body in self.bodies
        ]
        self._meshes = [
            mesh_rays(body, self._device, dtype) if isinstance(body, Mesh) else None
            for body in self.bodies
        ]
        self._numbers = torch.arange(len(placed), dtype=torch.int32, device=device).unbind(0)
        self._light = self._table([*_unit(scene.light.direction), scene.light.ambient])
        textures = [*(body.texture or Carried() for body in self.bodies), scene.sky]
        kinds = [TEXTURES.index(type(texture)) for texture in textures]
        # Tables have room for more, so that most scenes are alike to the compiler.
        width = -(-len(textures) // _ROOM) * _ROOM
        emissive = [*(float(body.emissive) for body in self.bodies), 1.0]
        self._emissive = self._table(_filled(emissive, width))
        rows = [_filled(texture.row(), TABLE_WIDTH) for texture in textures]
        rows += [[0.0] * TABLE_WIDTH] * (width - len(rows))
        self._paint = self._table(rows).T.contiguous()
        self._kinds = torch.tensor(_filled(kinds, width), device=device).int()

    def closest_hit(self, origins: Tensor, directions: Tensor, times: Tensor) -> Hit:
        """Return what each ray meets first at its own time.

        Args:
            origins: World points, scene units, (3, N).
            directions: World directions, any length but 0, (3, N).
            times: Frames after the tracer's frame, (N,).

        Returns:
            The hits.
        """
        parts = []
        for planes, count in self._chunks(*origins.unbind(0), *directions.unbind(0), times):
            state = self._trace(planes[:3], planes[3:6], planes[6])  # type: ignore[arg-type]
            parts.append([part[:count] for part in _flat(state)])
        whole = [torch.cat(layers) for layers in zip(*parts, strict=True)]
        return Hit(whole[0], whole[1], torch.stack(whole[2:5]), torch.stack(whole[5:8]))

    def image(self, size: tuple[int, int], x: Tensor, y: Tensor, times: Tensor) -> Tensor:
        """Return the scene-linear radiance that the camera sees at points of the image.

        Args:
            size: Height and width of the image in px.
            x: Position in the image, px right, (N,).
            y: Position in the image, px down, (N,).
            times: Frames after the tracer's frame, (N,).

        Returns:
            Radiance, (3, N).
        """
        glass = self.lens(size)
        parts = []
        for planes, count in self._chunks(x, y, times):
            rays = execute(camera_rays, self._compiled, self.camera_levels, glass, *planes)
            color = self._shade(self._trace(rays[0], rays[1], planes[2]))
            parts.append(torch.stack([plane[:count] for plane in color]))
        return torch.cat(parts, 1)

    def _table(self, values: Any) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float64).to(self._device, self._dtype)

    def rays(
        self, size: tuple[int, int], x: Tensor, y: Tensor, times: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return origins and directions of the camera's rays, (3, N) each; as `image`.

        A direction is 1 long along the view axis, so that the distance of a hit is its depth.
        """
        origin, direction = camera_rays(self.camera_levels, self.lens(size), x, y, times)
        return torch.stack(origin), torch.stack(direction)

    def levels_of(self, bodies: Tensor) -> Tensor:
        """Return the motion of a body per ray; the sky's is that of nothing.

        Args:
            bodies: Indices as in `Hit.body`, (N,).

        Returns:
            Tables for `motion.place`, (levels, 22, N).
        """
        depth = max(len(levels) for levels in self.levels)
        still = self._table(level_table([Placed().level()], 0.0))
        chains = [torch.cat([still] * (depth - len(c)) + [c]) for c in self.levels]
        chains.append(torch.cat([still] * depth))
        return torch.stack(chains, -1)[..., bodies.long()]

    def lens(self, size: tuple[int, int]) -> Tensor:
        """Return x and y of the view axis, and focal length, for an image size, px, (3,)."""
        return lens(self.camera, size).to(self._device, self._dtype)

    def radiance(self, hit: Hit) -> Tensor:
        """Return the scene-linear radiance of hits, (3, N)."""
        return self.radiances(hit)[0]

    def radiances(self, hit: Hit) -> tuple[Tensor, Tensor]:
        """Return the scene-linear radiance of hits, and the textures' own colors, (3, N) each.

        Args:
            hit: From `closest_hit`.
        """
        lit, own = [], []
        for planes, count in self._chunks(hit.body, *hit.point.unbind(0), *hit.normal.unbind(0)):
            color = self._painted(planes[0], planes[1:4])  # type: ignore[arg-type]
            own.append(torch.stack([plane[:count] for plane in color]))
            color = self._under_light(color, planes[4:7], planes[0])  # type: ignore[arg-type]
            lit.append(torch.stack([plane[:count] for plane in color]))
        return torch.cat(lit, 1), torch.cat(own, 1)

    def _trace(self, origin: Vec, direction: Vec, time: Tensor) -> _State:
        state = _nothing(direction, len(self.bodies))
        rays = (origin, direction, time)
        tables = list(zip(self.bodies, self.levels, self._shapes, self._numbers, strict=True))
        convex = [row for row in tables if isinstance(row[0], Convex)]
        if self._compiled:
            for body, levels, shape, number in convex:
                step = _step(type(body))
                state = execute(step, self._compiled, state, rays, levels, shape, number)
        else:
            state = _trace_convex(state, rays, convex)
        for (body, levels, _, number), mesh in zip(tables, self._meshes, strict=True):
            if mesh is not None:
                skin = None if body.texture is None else _SKIN
                state = _mesh_step(state, rays, levels, (mesh, skin), number)
        return state

    def _shade(self, state: _State, lit: bool = True) -> Vec:
        color = self._painted(state[1], state[2])
        return self._under_light(color, state[3], state[1]) if lit else color

    def _painted(self, body: Tensor, point: Vec) -> Vec:
        color = _zeros(point)
        kinds = self._kinds[body]
        seen = torch.bincount(kinds, minlength=len(TEXTURES)).tolist()
        for kind in (kind for kind, count in enumerate(seen) if count):
            if self._compiled:
                tables = (self._kinds, self._paint)
                color = execute(_painter(kind), True, color, point, body, *tables)
            else:
                which = (kinds == kind).nonzero()[:, 0]
                row = list(self._paint[:, body[which]].unbind(0))
                _put(color, which, TEXTURES[kind].paint(_at(point, which), row))
        return color

    def _under_light(self, color: Vec, normal: Vec, body: Tensor) -> Vec:
        tables = (self._emissive, self._light)
        lit: Vec = execute(_lit, self._compiled, color, normal, body, *tables)
        return lit

    def _chunks(self, *planes: Tensor) -> Iterator[tuple[tuple[Tensor, ...], int]]:
        """Cut planes of N rays into chunks; compiled code takes full ones only."""
        for chunk in zip(*(plane.split(CHUNK) for plane in planes), strict=True):
            count = chunk[0].shape[0]
            if self._compiled and count < CHUNK:
                yield tuple(torch.cat((c, c[-1:].expand(CHUNK - count))) for c in chunk), count
            else:
                yield chunk, count


_State: TypeAlias = tuple[Tensor, Tensor, Vec, Vec]  # distance, body, point, normal


def _flat(state: _State) -> tuple[Tensor, ...]:
    return state[0], state[1], *state[2], *state[3]


def _nothing(direction: Vec, sky: int) -> _State:
    distance = torch.full_like(direction[0], math.inf)
    body = torch.full_like(direction[0], sky, dtype=torch.int32)
    return distance, body, normalize(direction), _zeros(direction)


def _zeros(like: Vec) -> Vec:
    """Return three planes; one tensor thrice would be another case to the compiler."""
    return torch.zeros_like(like[0]), torch.zeros_like(like[1]), torch.zeros_like(like[2])


def _at(vectors: Vec, which: Tensor) -> Vec:
    return vectors[0][which], vectors[1][which], vectors[2][which]


def _put(vectors: Vec, which: Tensor, values: Vec) -> None:
    for plane, value in zip(vectors, values, strict=True):
        plane[which] = value


def _trace_convex(
    state: _State, rays: tuple[Vec, Vec, Tensor], bodies: Sequence[tuple[Any, Any, Any, Tensor]]
) -> _State:
    """Try convex bodies on all rays, as `_step` each; what a ray hits is looked at once, last."""
    origin, direction, time = rays
    distance, hit = state[0], state[1]
    for body, levels, shape, number in bodies:
        near, far = body.interval(*into(levels, time, origin, direction), shape.unbind(0))
        here = torch.where(near > _NEAR, near, far)
        is_closer = (near <= far) & (here > _NEAR) & (here < distance)
        distance = torch.where(is_closer, here, distance)
        hit = torch.where(is_closer, number, hit)
    for body, levels, shape, number in bodies:
        which = (hit == number).nonzero()[:, 0]
        if which.numel():
            own = (_at(origin, which), _at(direction, which), time[which])
            below, facing = _surface(body, own, levels, shape, distance[which])
            _put(state[2], which, below)
            _put(state[3], which, facing)
    return distance, hit, state[2], state[3]


def _surface(
    kind: Any, rays: tuple[Vec, Vec, Tensor], levels: Tensor, shape: Tensor, distance: Tensor
) -> tuple[Vec, Vec]:
    """Return the texture's point and the facing normal where rays hit a body."""
    origin, direction = into(levels, rays[2], rays[0], rays[1])
    point = add(origin, scale(direction, distance))
    normal = kind.normal(point, shape.unbind(0))
    below = subtract(point, scale(normal, _SKIN))
    outwards = turn(levels, rays[2], normal)
    return below, select(dot(normal, direction) > 0, scale(outwards, -1), outwards)


@functools.cache
def _step(kind: type[Convex]) -> Callable[..., _State]:
    """Return the function that tries one body of a kind on all rays."""

    def step(
        state: _State, rays: tuple[Vec, Vec, Tensor], levels: Tensor, shape: Tensor, body: Tensor
    ) -> _State:
        origin, direction = into(levels, rays[2], rays[0], rays[1])
        a, b, c, d = shape.unbind(0)
        numbers = (a, b, c, d)
        near, far = kind.interval(origin, direction, numbers)
        distance = torch.where(near > _NEAR, near, far)
        is_closer = (near <= far) & (distance > _NEAR) & (distance < state[0])
        point = add(origin, scale(direction, distance))
        normal = kind.normal(point, numbers)
        below = subtract(point, scale(normal, _SKIN))
        outwards = turn(levels, rays[2], normal)
        facing = select(dot(normal, direction) > 0, scale(outwards, -1), outwards)
        return (
            torch.where(is_closer, distance, state[0]),
            torch.where(is_closer, body, state[1]),
            select(is_closer, below, state[2]),
            select(is_closer, facing, state[3]),
        )

    step.__name__ = f"step_{kind.__name__.lower()}"
    return step


def _mesh_step(
    state: _State,
    rays: tuple[Vec, Vec, Tensor],
    levels: Tensor,
    mesh: tuple[MeshRays, float | None],
    body: Tensor,
) -> _State:
    """Try a mesh on all rays, as `_step` does a body."""
    origin, direction = into(levels, rays[2], rays[0], rays[1])
    hits = mesh[0].closest((origin, direction), state[0], _NEAR, mesh[1])
    own = hits.normal.unbind(1)
    normal = turn(levels, rays[2][hits.which], (own[0], own[1], own[2]))

    def put(plane: Tensor, values: Tensor) -> Tensor:
        return plane.index_put((hits.which,), values)

    def put_vec(old: Vec, values: Sequence[Tensor]) -> Vec:
        return put(old[0], values[0]), put(old[1], values[1]), put(old[2], values[2])

    return (
        put(state[0], hits.distance),
        put(state[1], body),
        put_vec(state[2], hits.point.unbind(1)),
        put_vec(state[3], normal),
    )


@functools.cache
def _painter(kind: int) -> Callable[..., Vec]:
    """Return the function that colors the rays whose texture is of a kind."""
    paint = TEXTURES[kind].paint

    def painter(color: Vec, point: Vec, body: Tensor, kinds: Tensor, table: Tensor) -> Vec:
        row = list(table[:, body].unbind(0))
        return select(kinds[body] == kind, paint(point, row), color)

    painter.__name__ = f"paint_{TEXTURES[kind].__name__.lower()}"
    return painter


def _lit(color: Vec, normal: Vec, body: Tensor, emissive: Tensor, light: Tensor) -> Vec:
    x, y, z, ambient = light.unbind(0)
    cosine = torch.clamp(dot(normal, (x, y, z)), min=0)
    factor = ambient + (1 - ambient) * cosine
    return scale(color, torch.where(emissive[body] > 0, 1, factor))


def _filled(values: Sequence[float], width: int) -> list[float]:
    return [*values, *[0.0] * (width - len(values))]


def _unit(values: Triple) -> list[float]:
    length = math.hypot(*values)
    return [component / length for component in values]
