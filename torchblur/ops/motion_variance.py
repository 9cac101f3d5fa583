"""How samples move around each pixel: mean length and angle, their variances, and the share.

The estimate needs no color: in a stochastic stream it is the motion that makes the noise.
"""

from __future__ import annotations

from collections import abc
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.points import (
    Points,
    flat,
    nearest_index,
    per_point,
    points_where,
    put,
    take,
    total,
)
from torchblur.ops.taps import Engine, Inputs, sum_taps

__all__ = ["AngleMode", "MotionEstimate", "Motions", "estimate_motion"]

AngleMode = Literal["relative", "double_angle"]

_NOTHING = 1e-12


class Motions(NamedTuple):
    """What the estimate needs of one sample per pixel, as planes."""

    displacement: Tensor
    """v, over the shutter, px, (B, 2, H, W)."""
    depth: Tensor
    """Scene units, finite, (B, 1, H, W)."""
    moving: Tensor
    """1 where the sample moves and can be trusted, else 0, (B, 1, H, W)."""
    trusted: Tensor
    """1 where it can be trusted at all, else 0, (B, 1, H, W)."""


class MotionEstimate(NamedTuple):
    """Planes (B, 1, H, W); all 0 where no moving sample is seen."""

    share: Tensor
    """f, share of moving samples among those that pass the depth test, in [0, 1]."""
    length: Tensor
    """l, mean length of the displacement over the shutter, px."""
    angle: Tensor
    """Mean angle to the x axis, y down, radians; a direction and its opposite are one."""
    length_variance: Tensor
    """Variance of the length, px²."""
    angle_variance: Tensor
    """Variance of the angle, radians²; at most (π/2)²."""
    active: Tensor
    """bool: some moving sample is seen."""


class _Options(NamedTuple):
    window: int


def estimate_motion(
    samples: abc.Sequence[Motions],
    extent: Tensor | float,
    window: int = 15,
    stride: int = 2,
    mode: AngleMode = "relative",
    engine: Engine = "eager",
) -> MotionEstimate:
    """Return mean and variance of length and angle of the motion around each pixel.

    Samples q of the window count with ``m(q) sat(1 + (Z_p − Z_q) / (extent · Z_p))``. Angles are
    taken relative to that of the pixel's own sample, or of the longest moving one of the window
    if the pixel's is still; beyond ±90° they are flipped by 180°. "double_angle" takes them
    relative to ``½ atan2(Σ sin 2θ, Σ cos 2θ)`` instead, which is then the mean.

    Args:
        samples: One entry per sample of the pixels; the first is the pixel's own.
        extent: Relative depth behind a pixel at which a sample does not count; a number or
            (B, 1, H, W).
        window: Edge of the window, px; an even one has one pixel more at the right and below.
        stride: The estimate is made at the top left pixel of each block of so many px squared,
            and holds for the block.
        mode: What angles are measured against.
        engine: See `ops.taps`.

    Returns:
        Planes (B, 1, H, W). Windows without motion cost one look at the mask.

    Differentiable: in the displacements, the depth and the extent. The reference sample, and
        which pixels are active, are choices.
    Border: replicated: samples at the border count several times.
    Reference: Oberberger 2022, section 4.1. We differ: the depth test, which the paper does not
        give, is a ramp; a still pixel refers to the longest motion; lengths are taken relative to
        the reference, too, which changes rounding only.
    """
    first = samples[0]
    size = first.depth.shape[-2:]
    points = _candidates(samples, window, stride)
    if points.number == 0:
        nothing = torch.zeros_like(first.depth)
        return MotionEstimate(nothing, nothing, nothing, nothing, nothing, first.depth < 0)
    textures = [flat(torch.cat(sample, 1)) for sample in samples]
    inputs = {"depth": take(first.depth, points)} | points.inputs()
    inputs["extent"] = inputs["depth"] * per_point(extent, points, first.depth)
    inputs["reference"] = _reference(first, textures, points, inputs, window)
    if mode == "double_angle":
        doubled = _over_samples(_doubled_tap, window, textures, inputs, engine)
        inputs["reference"] = _mean_direction(inputs["reference"], doubled[0], doubled[1])
    moving, seen, moments = _over_samples(_moment_tap, window, textures, inputs, engine)
    values = _moments(inputs["reference"], moving, seen, moments, mode)
    grid = put(values, points)[..., ::stride, ::stride]
    planes = grid.repeat_interleave(stride, 2).repeat_interleave(stride, 3)
    planes = planes[..., : size[0], : size[1]]
    share, length, angle, length_variance, angle_variance = planes.split(1, 1)
    return MotionEstimate(share, length, angle, length_variance, angle_variance, length > 0)


def _candidates(samples: abc.Sequence[Motions], window: int, stride: int) -> Points:
    """Return the top left pixels of the blocks whose windows hold any motion."""
    moving = torch.stack([sample.moving for sample in samples]).amax(0)
    before, after = (window - 1) // 2, window // 2
    padded = F.pad(moving, (before, after, before, after))
    rows = F.max_pool2d(padded, (1, window), (1, stride))
    blocks = F.max_pool2d(rows, (window, 1), (stride, 1))
    mask = torch.zeros_like(moving, dtype=torch.bool)
    mask[..., ::stride, ::stride] = blocks > 0
    return points_where(mask, moving.dtype)


def _reference(
    first: Motions, textures: list[Tensor], points: Points, inputs: Inputs, window: int
) -> Tensor:
    """Return the displacement that angles refer to: the pixel's own, or the longest seen."""
    own = take(first.displacement.detach(), points)
    still = take(first.moving, points) == 0
    some = points.among(still)
    if some.number == 0:
        return own
    keys = {"depth": inputs["depth"][still][None], "extent": inputs["extent"][still][None]}
    near = {name: tensor.detach() for name, tensor in (keys | some.inputs()).items()}
    longest, best = torch.zeros_like(some.x), torch.zeros_like(own[:, still[0]])
    with torch.no_grad():
        for texture in textures:
            for index in range(window * window):
                step = own.new_tensor(float(index))
                velocity, moving, _ = _tap(step, near | {"texture": texture}, window)
                length = torch.where(moving > 0, velocity.square().sum(0, keepdim=True), 0.0)
                best = torch.where(length > longest, velocity, best)
                longest = torch.maximum(length, longest)
        return own.index_copy(1, still[0].nonzero()[:, 0], best)


def _over_samples(
    tap: abc.Callable[..., tuple[Tensor, ...]],
    window: int,
    textures: list[Tensor],
    inputs: Inputs,
    engine: Engine,
) -> tuple[Tensor, ...]:
    options = _Options(window)
    parts = [
        sum_taps(tap, options, window * window, inputs | {"texture": texture}, engine)
        for texture in textures
    ]
    return total(parts)


def _tap(index: Tensor, inputs: Inputs, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return a sample's displacement, its weight as a moving one, and its weight as any."""
    before = (window - 1) // 2
    row = torch.div(index, window, rounding_mode="floor")
    column = index - row * window
    place, _, _ = nearest_index(
        inputs["x"] + (column - before), inputs["y"] + (row - before), inputs
    )
    planes = inputs["texture"].index_select(1, place)
    depth, moving, trusted = planes[2:3], planes[3:4], planes[4:5]
    seen = trusted * (1 + (inputs["depth"] - depth) / inputs["extent"]).clamp(0, 1)
    return planes[:2], moving * seen, seen


def _relative(velocity: Tensor, reference: Tensor) -> Tensor:
    """Return angles of displacements against a direction, in [−π/2, π/2], radians."""
    along = (velocity * reference).sum(0, keepdim=True)
    across = reference[:1] * velocity[1:] - reference[1:] * velocity[:1]
    sign = torch.where(along < 0, -1.0, 1.0).to(along.dtype)
    # At 0 (no motion) atan2 has no gradient.
    nothing = along.abs() + across.abs() < _NOTHING
    across, along = torch.where(nothing, 0.0, across), torch.where(nothing, 1.0, sign * along)
    return torch.atan2(sign * across, along)


def _moment_tap(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Tensor, ...]:
    velocity, weight, seen = _tap(index, inputs, options.window)
    reference = inputs["reference"]
    longer = _length(velocity) - _length(reference)
    angle = _relative(velocity, reference)
    moments = torch.cat((longer, longer.square(), angle, angle.square()), 0)
    return weight, seen, weight * moments


def _doubled_tap(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Tensor, ...]:
    velocity, weight, _ = _tap(index, inputs, options.window)
    doubled = 2 * _relative(velocity, inputs["reference"])
    return weight * doubled.sin(), weight * doubled.cos()


def _length(vector: Tensor) -> Tensor:
    return (vector.square().sum(0, keepdim=True) + 1e-12).sqrt()


def _mean_direction(reference: Tensor, sines: Tensor, cosines: Tensor) -> Tensor:
    """Return the reference turned to the mean angle; its length is kept."""
    nothing = sines.abs() + cosines.abs() < _NOTHING
    turn = torch.atan2(torch.where(nothing, 0.0, sines), torch.where(nothing, 1.0, cosines)).div(2)
    x, y = reference[:1], reference[1:]
    return torch.cat((turn.cos() * x - turn.sin() * y, turn.sin() * x + turn.cos() * y), 0)


def _moments(
    reference: Tensor, moving: Tensor, seen: Tensor, moments: Tensor, mode: AngleMode
) -> Tensor:
    """Return share, length, angle and the two variances, (5, N); 0 where nothing moves."""
    some = moving > 0
    mean = moments / torch.where(some, moving, 1.0)
    longer, longer_squared, turn, turn_squared = mean.split(1)
    base = torch.where(some, reference, 1.0)
    angle = torch.atan2(base[1:], base[:1])
    angle_variance = turn_squared
    if mode == "relative":
        angle = angle + turn
        angle_variance = turn_squared - turn.square()
    result = torch.cat(
        (
            moving / torch.where(some, seen, 1.0),
            _length(reference) + longer,
            angle,
            (longer_squared - longer.square()).clamp(min=0),
            angle_variance.clamp(min=0),
        ),
        0,
    )
    return torch.where(some, result, 0.0)
