"""What is seen at points of the image: depth, normal, object, and the motion of the surface.

Computed in float64; motion is the derivative, at each point's own time, of where the surface
point appears, through the transforms of body and camera.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchblur.render.camera import project
from torchblur.render.motion import into, place
from torchblur.render.trace import CHUNK, Hit, Tracer
from torchblur.render.vectors import Vec

__all__ = ["image_path", "path_motion", "pixel_centers", "surface_layers"]


def pixel_centers(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return x and y of the centers of all pixels, row by row, px, float64, (H*W,) each."""
    rows, columns = (torch.arange(n, dtype=torch.float64, device=device) + 0.5 for n in size)
    return columns.repeat(size[0]), rows.repeat_interleave(size[1])


def surface_layers(
    tracer: Tracer,
    size: tuple[int, int],
    x: Tensor,
    y: Tensor,
    times: Tensor,
    *,
    acceleration: bool = False,
    radiance: bool = False,
) -> dict[str, Tensor]:
    """Return what the camera sees at points of the image, each at its own time.

    Args:
        tracer: The scene, in the type of `x`.
        size: Height and width of the image in px.
        x: Position in the image, px right, (N,).
        y: Position in the image, px down, (N,).
        times: Frames after the tracer's frame, (N,).
        acceleration: Whether to compute the second derivative, too.
        radiance: Whether to shade what is seen, too.

    Returns:
        `depth` (N,), `normal` (3, N), `object_id` (N,), `velocity` (2, N) in px/frame, and, if
        asked for, `acceleration` (2, N) in px/frame², or `color` and `albedo`, (3, N) each.
    """
    parts = [
        _layers_of_chunk(tracer, size, planes, acceleration, radiance)
        for planes in zip(*(plane.split(CHUNK) for plane in (x, y, times)), strict=True)
    ]
    return {name: torch.cat([part[name] for part in parts], -1) for name in parts[0]}


def image_path(
    tracer: Tracer, size: tuple[int, int], rays: tuple[Tensor, Tensor], times: Tensor, hit: Hit
) -> Callable[[Tensor], Tensor]:
    """Return where the points that rays hit appear, as a function of time: (N,) -> (2, N).

    Args:
        tracer: The scene.
        size: Height and width of the image in px.
        rays: Origins and directions, (3, N) each.
        times: When each point was hit, frames after the tracer's frame, (N,).
        hit: What was hit. The sky is fixed to the world.
    """
    origins, directions = rays
    is_sky = torch.isinf(hit.distance)
    point = _planes(origins + directions * torch.where(is_sky, 1.0, hit.distance))
    sky = _planes(directions)
    levels = tracer.levels_of(hit.body)
    glass = tracer.lens(size)
    own, _ = into(levels, times, point, sky)

    def path(time: Tensor) -> Tensor:
        moved = place(levels, time, own)
        return torch.stack(project(tracer.camera_levels, glass, time, moved, sky, is_sky))

    return path


def path_motion(
    path: Callable[[Tensor], Tensor], times: Tensor, *, acceleration: bool = False
) -> tuple[Tensor, Tensor | None]:
    """Return first and, if asked for, second derivative of N paths, (2, N) each.

    Each path depends on its own time alone, so the gradient of a sum has them all.
    """
    first, second = [], []
    with torch.enable_grad():
        time = times.clone().requires_grad_()
        for coordinate in path(time).unbind(0):
            (speed,) = torch.autograd.grad(
                coordinate.sum(), time, retain_graph=True, create_graph=acceleration
            )
            first.append(speed.detach())
            if acceleration:
                (change,) = torch.autograd.grad(speed.sum(), time, retain_graph=True)
                second.append(change)
    return torch.stack(first), torch.stack(second) if acceleration else None


def _layers_of_chunk(
    tracer: Tracer,
    size: tuple[int, int],
    planes: tuple[Tensor, ...],
    acceleration: bool,
    radiance: bool,
) -> dict[str, Tensor]:
    x, y, times = planes
    rays = tracer.rays(size, x, y, times)
    hit = tracer.closest_hit(*rays, times)
    path = image_path(tracer, size, rays, times, hit)
    velocity, change = path_motion(path, times, acceleration=acceleration)
    layers = {
        "depth": hit.distance,
        "normal": hit.normal,
        "object_id": tracer.object_ids[hit.body.long()],
        "velocity": velocity,
    }
    if change is not None:
        layers["acceleration"] = change
    if radiance:
        layers["color"], layers["albedo"] = tracer.radiances(hit)
    return layers


def _planes(vectors: Tensor) -> Vec:
    return vectors[0], vectors[1], vectors[2]
