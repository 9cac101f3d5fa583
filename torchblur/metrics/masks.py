"""Where to measure: means over a mask, and the band around moving borders."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.frame import Frame, Shutter

__all__ = ["border_band", "masked_mean"]

_MAX_MARGIN = 256
_NEIGHBORS = (-1, -2)  # a border lies between horizontal (-1) or vertical (-2) neighbors


def masked_mean(map: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of a map over the pixels of a mask, per image.

    ``sum(mask * map) / (sum(mask) * C)``. Values outside the mask do not count, even if NaN.

    Args:
        map: Values per pixel, (B, C, H, W), any unit.
        mask: Pixels that count, (B, 1, H, W) or (1, 1, H, W): bool, or weights >= 0. All if None.

    Returns:
        The mean, (B,); NaN where the mask is empty, as there is nothing to average.

    Differentiable: yes, in the map and in float weights; zero gradient for an empty mask.

    Raises:
        FrameError: if the mask has another shape, or a weight is negative or NaN.
    """
    if mask is None:
        return map.flatten(1).mean(dim=1)
    weights = _weights(map, mask)
    total = torch.where(weights > 0, map * weights, 0.0).flatten(1).sum(dim=1)
    count = weights.flatten(1).sum(dim=1) * map.shape[1]
    empty = count == 0
    return torch.where(empty, math.nan, total / torch.where(empty, 1.0, count))


def _weights(values: Tensor, mask: Tensor) -> Tensor:
    """Return a mask as weights in the type of the values, or refuse it."""
    batch, _, height, width = values.shape
    if tuple(mask.shape) not in ((batch, 1, height, width), (1, 1, height, width)):
        raise FrameError(
            f"`mask` must have shape ({batch}, 1, {height}, {width}) or (1, 1, {height}, {width}),"
            f" got {tuple(mask.shape)}"
        )
    if mask.dtype == torch.bool:
        return mask.to(values.dtype)
    if not bool((mask >= 0).all()):
        raise FrameError(f"`mask` must be bool or weights >= 0, got {float(mask[~(mask >= 0)][0])}")
    return mask.to(values.dtype)


def border_band(
    frame: Frame,
    shutter: Shutter,
    *,
    margin: int = 2,
    min_blur: float = 0.5,
    depth_jump: float = 0.1,
    velocity_jump: float = 1.0,
) -> Tensor:
    """Return the pixels that a moving object border sweeps over while the shutter is open.

    There the blurs of different filters differ: objects mix with what they hide and reveal.
    Elsewhere most of them are the same line blur.

    A border lies between two pixels, side by side or one above the other, that belong to
    different objects. With `object_id` that is where the numbers differ. Without it, it is where
    the depth jumps, ``|z1 - z2| > depth_jump * min(z1, z2)``, or the velocity does,
    ``|v1 - v2| * open > velocity_jump``. A depth jump that continues a slope on both sides is no
    border: 1/z of a plane changes by equal steps, so a step counts only if it is more than twice
    that of one of its sides.
    A border counts if either side moves by `min_blur` or more while the shutter is open. Each
    pixel of it is then carried along both sides' paths, ``p + v t + a t² / 2`` for t over the
    open interval (a if the frame has `acceleration`), in steps of at most a pixel, and what
    these paths touch is widened by `margin` on all sides.

    Args:
        frame: The sharp frame; its velocity, and `object_id` or (if that is absent) depth.
        shutter: When the shutter is open; the band of a leading shutter lies ahead of the border.
        margin: Added on all sides, px, in [0, 256]; 2 covers the pixel filter and the feature
            filters of the metrics.
        min_blur: Least path of a border that counts, px over the open shutter, at least 0.
        depth_jump: Least relative jump of depth, 1, above 0; used without `object_id`.
        velocity_jump: Least jump of the blur's length, px over the open shutter, above 0; used
            without `object_id`.

    Returns:
        The band, bool, (B, 1, H, W); empty if nothing moves.

    Differentiable: no.
    Border: paths that leave the image are cut there; objects outside the image are unknown.

    Raises:
        FrameError: if an argument lies out of range.
    """
    _check_settings(margin, min_blur, depth_jump, velocity_jump)
    with torch.no_grad():
        touched = torch.zeros_like(frame.velocity[:, :1], dtype=torch.bool)
        path = _path(frame)
        moving = _reach(path, shutter) >= max(min_blur, torch.finfo(path.dtype).tiny)
        for dim in _NEIGHBORS:
            if path.shape[dim] == 1:
                continue
            near, far = _pair(moving, dim)
            border = _borders(frame, shutter, dim, depth_jump, velocity_jump) & (near | far)
            _sweep(touched, border, path, shutter, dim)
        return _widen(touched, margin)


def _check_settings(margin: int, min_blur: float, depth_jump: float, velocity_jump: float) -> None:
    if not 0 <= margin <= _MAX_MARGIN:
        raise FrameError(f"`margin` must lie in [0, {_MAX_MARGIN}] px, got {margin}")
    if not min_blur >= 0:
        raise FrameError(f"`min_blur` must be at least 0 px, got {min_blur}")
    for name, value in (("depth_jump", depth_jump), ("velocity_jump", velocity_jump)):
        if not value > 0:
            raise FrameError(f"`{name}` must be above 0, got {value}")


def _pair(layer: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Return each pixel and its next neighbor along a dimension, one shorter than the layer."""
    size = layer.shape[dim] - 1
    return layer.narrow(dim, 0, size), layer.narrow(dim, 1, size)


def _path(frame: Frame) -> Tensor:
    """Return velocity and acceleration, (B, 4, H, W), px/frame and px/frame²."""
    bend = frame.acceleration
    return torch.cat(
        [frame.velocity, torch.zeros_like(frame.velocity) if bend is None else bend], dim=1
    )


def _displacement(path: Tensor, time: float) -> Tensor:
    """Return v t + a t² / 2 in px; time in frames."""
    return path[:, :2] * time + path[:, 2:] * (time * time / 2)


def _reach(path: Tensor, shutter: Shutter) -> Tensor:
    """Return the length of each pixel's path while the shutter is open, px.

    It is that of the two chords by way of the middle of the interval, so a turn does not hide it.
    """
    start, stop = shutter.interval
    middle = _displacement(path, (start + stop) / 2)
    ends = (_displacement(path, start) - middle, _displacement(path, stop) - middle)
    return (
        ends[0].square().sum(dim=1, keepdim=True).sqrt()
        + ends[1].square().sum(dim=1, keepdim=True).sqrt()
    )


def _borders(
    frame: Frame, shutter: Shutter, dim: int, depth_jump: float, velocity_jump: float
) -> Tensor:
    """Return where neighbors along a dimension belong to different objects, one shorter."""
    if frame.object_id is not None:
        near, far = _pair(frame.object_id, dim)
        return near != far
    near, far = _pair(frame.velocity, dim)
    jumps = (far - near).square().sum(dim=1, keepdim=True).sqrt() * shutter.open > velocity_jump
    return jumps if frame.depth is None else jumps | _depth_jumps(frame, dim, depth_jump)


def _depth_jumps(frame: Frame, dim: int, depth_jump: float) -> Tensor:
    depth = frame.finite_depth()
    near, far = _pair(depth, dim)
    jumps = (far - near).abs() > depth_jump * torch.minimum(near, far)
    near, far = _pair(1 / depth, dim)
    step = (far - near).abs()
    before = F.pad(step, (1, 0) if dim == -1 else (0, 0, 1, 0)).narrow(dim, 0, step.shape[dim])
    after = F.pad(step, (0, 1) if dim == -1 else (0, 0, 0, 1)).narrow(dim, 1, step.shape[dim])
    return jumps & (step > 2 * torch.minimum(before, after))


def _sweep(touched: Tensor, border: Tensor, path: Tensor, shutter: Shutter, dim: int) -> None:
    """Mark what both pixels of each border touch along both pixels' paths, in place."""
    b, _, y, x = border.nonzero(as_tuple=True)
    if b.numel() == 0:
        return
    ahead = {-1: (0, 1), -2: (1, 0)}[dim]
    sides = ((y, x), (y + ahead[0], x + ahead[1]))
    for row, column in sides:
        motion = path[b, :, row, column]
        count = math.ceil(float(_reach(motion, shutter).max())) + 1
        for time in torch.linspace(*shutter.interval, max(count, 2)).tolist():
            dx, dy = _displacement(motion, time).round().long().unbind(dim=1)
            for origin_y, origin_x in sides:
                _mark(touched, b, origin_y + dy, origin_x + dx)


def _mark(touched: Tensor, b: Tensor, y: Tensor, x: Tensor) -> None:
    inside = (y >= 0) & (y < touched.shape[2]) & (x >= 0) & (x < touched.shape[3])
    touched[b[inside], 0, y[inside], x[inside]] = True


def _widen(mask: Tensor, margin: int) -> Tensor:
    """Return a mask dilated by a square of `margin` px on each side."""
    if margin == 0:
        return mask
    window = 2 * margin + 1
    grown = mask.to(torch.float32)
    for kernel in ((1, window), (window, 1)):
        padding = (kernel[0] // 2, kernel[1] // 2)
        grown = F.max_pool2d(grown, kernel, stride=1, padding=padding)
    return grown > 0
