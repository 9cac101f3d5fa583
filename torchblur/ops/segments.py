"""The path of a sample over the shutter, and how near it comes to a pixel.

A sample seen at q at the time t of the shutter, with displacement v over the shutter, runs from
``q0 = q − v t`` to ``q1 = q0 + v``. All functions work elementwise on coordinates in px.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Projection", "path_distance", "path_weight", "project", "width_of_weights"]

_STILL_SQUARED = 1e-6  # a thousandth of a pixel: no line to project on
_LEAST_WEIGHT = 1e-4  # rounding makes weights up to 1e-5 of what is exactly as far as c


class Projection(NamedTuple):
    """Where a pixel falls on the line through a path."""

    share: Tensor
    """l: 0 at the path's begin, 1 at its end."""
    distance: Tensor
    """Distance to the line, px."""


def project(dx: Tensor, dy: Tensor, vx: Tensor, vy: Tensor, time: Tensor) -> Projection:
    """Return where a pixel p falls on the line along which a sample q moves.

    ``l = (p − q0) · v / |v|²`` and ``d = |p − (q0 + l v)|``, which are ``(p − q) · v / |v|² + t``
    and ``|(p − q) × v| / |v|``. A sample that moves less than 1/1000 px has no line: l = 1/2, and
    d is the distance to the sample.

    Args:
        dx: p − q, columns, px.
        dy: p − q, rows, px.
        vx: Displacement of the sample over the shutter, columns, px.
        vy: The same, rows.
        time: t of the sample in [0, 1].

    Differentiable: yes; d has a kink at 0, where its gradient is 0.
    Reference: Oberberger 2022, eq. 1.
    """
    squared = vx * vx + vy * vy
    still = squared < _STILL_SQUARED
    squared = torch.where(still, 1.0, squared)
    share = torch.where(still, 0.5, (dx * vx + dy * vy) / squared + time)
    across = (dx * vy - dy * vx).abs() / squared.sqrt()
    away = (dx * dx + dy * dy + 1e-12).sqrt()
    return Projection(share, torch.where(still, away, across))


def path_distance(dx: Tensor, dy: Tensor, vx: Tensor, vy: Tensor, time: Tensor) -> Tensor:
    """Return the distance of a pixel to the path of a sample, its ends included, px.

    Args:
        dx: See `project`.
        dy: See `project`.
        vx: See `project`.
        vy: See `project`.
        time: See `project`.

    Reference: Oberberger 2022, section 4.2.
    """
    share = project(dx, dy, vx, vy, time).share.clamp(0, 1)
    x, y = dx + vx * (time - share), dy + vy * (time - share)
    return (x * x + y * y).sqrt()


def path_weight(
    offset: tuple[Tensor, Tensor],
    velocity: tuple[Tensor, Tensor],
    time: Tensor,
    width: Tensor,
    softness: Tensor,
) -> Tensor:
    """Return how much a sample counts at a pixel that it passes at some other time.

    ``w = sat(1 − d / c)`` between the ends of its path, 0 beyond them; with a softness e the
    weight falls to 0 over ``e |v|`` beyond each end.

    Args:
        offset: p − q, columns and rows, px.
        velocity: Displacement of the sample over the shutter, columns and rows, px.
        time: t of the sample in [0, 1].
        width: c, the distance at which the weight is 0, px; see `width_of_weights`.
        softness: e >= 0, as a share of the path.

    Differentiable: yes; the ends are steps unless e is above 0.
    Reference: Oberberger 2022, section 4.3. We differ: negative weights are cut, and those below
        1/10000, so that rounding does not decide whether a sample is seen (uniform motion puts
        the taps across it at a distance of exactly c = 1 px); and the ends may be soft.
    """
    share, distance = project(*offset, *velocity, time)
    beyond = torch.maximum(-share, share - 1)
    ramp = (1 - beyond / torch.where(softness > 0, softness, 1.0)).clamp(0, 1)
    inside = torch.where(beyond <= 0, 1.0, torch.where(softness > 0, ramp, 0.0))
    weight = (1 - distance / width).clamp(0, 1)
    return torch.where(weight > _LEAST_WEIGHT, weight, 0.0) * inside


def width_of_weights(
    length_variance: Tensor, angle_variance: Tensor, length_gain: Tensor, angle_gain: Tensor
) -> Tensor:
    """Return ``c = (1 + min(1, β_a σ²_θ)) (1 + min(1, β_l σ²_‖v‖))``, px in [1, 4].

    Args:
        length_variance: σ²_‖v‖, px².
        angle_variance: σ²_θ in [0, 1].
        length_gain: β_l.
        angle_gain: β_a.

    Differentiable: yes, up to where it saturates.
    Reference: Oberberger 2022, section 4.3.
    """
    across = 1 + (angle_gain * angle_variance).clamp(max=1)
    along = 1 + (length_gain * length_variance).clamp(max=1)
    return across * along
