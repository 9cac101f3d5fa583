"""Weights of a tap: cone, cylinder, and depth comparison. All work elementwise."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["DepthWeights", "cone", "cylinder", "depth_weights", "power", "saturate", "threshold"]

_TINY = 1e-9


def saturate(value: Tensor, softness: float = 0.0) -> Tensor:
    """Clamp to [0, 1].

    Args:
        value: Any shape.
        softness: 0 clamps hard, as the papers do; above 0 the corners are rounded over about
            this width, and the gradient is nowhere exactly zero.

    Returns:
        Values in [0, 1], same shape.
    """
    if softness == 0:
        return value.clamp(0, 1)
    beta = 4 / softness
    return F.softplus(value, beta) - F.softplus(value - 1, beta)


def cone(
    distance: Tensor,
    length: Tensor,
    slope: float | Tensor = 1.0,
    exponent: float | Tensor | None = None,
    softness: float = 0.0,
) -> Tensor:
    """Return ``sat(1 − slope · distance / length) ** exponent``.

    Args:
        distance: Distance between pixel and sample along the blur, px, >= 0.
        length: Half spread of whichever of the two blurs, px, > 0.
        slope: 1 reaches zero at the end of the spread.
        exponent: > 0; towards 0 the cone becomes the box that a constant speed would leave.
            None leaves it out (an exponent of 1, without its cost).
        softness: See `saturate`.

    Reference: McGuire 2012, section 3.3. We differ: slope and exponent are parameters.
    """
    weight = saturate(1 - slope * distance / length, softness)
    return weight if exponent is None else power(weight, exponent)


def cylinder(
    distance: Tensor, length: Tensor, inner: float | Tensor = 0.95, outer: float | Tensor = 1.05
) -> Tensor:
    """Return ``1 − smoothstep(inner · length, outer · length, distance)``.

    Args:
        distance: Distance between pixel and sample along the blur, px, >= 0.
        length: Half spread, px, > 0.
        inner: Distance / length up to which the weight is 1.
        outer: Distance / length from which it is 0; greater than `inner`.

    Reference: McGuire 2012, section 3.3. We differ: both ends are parameters.
    """
    t = ((distance / length - inner) / (outer - inner)).clamp(0, 1)
    return 1 - t * t * (3 - 2 * t)


class DepthWeights(NamedTuple):
    """How much a sample counts as in front of a pixel, and how much as behind it."""

    foreground: Tensor
    background: Tensor


def depth_weights(
    pixel: Tensor,
    sample: Tensor,
    extent: float | Tensor,
    *,
    relative: bool,
    level: float | Tensor = 1.0,
    softness: float = 0.0,
) -> DepthWeights:
    """Return the soft classification of a sample as foreground and background.

    ``foreground = sat(level + (Z_p − Z_S) / extent)``, background with the sign swapped. With
    `relative`, the extent is multiplied by the nearer depth.

    Args:
        pixel: Z_p, positive depth of the pixel, scene units, finite.
        sample: Z_S, positive depth of the sample, scene units, finite.
        extent: Difference over which a weight falls from 1 to 0: scene units, or (relative) as
            a fraction of the nearer depth.
        level: What both weights are where the depths are level: 1 in McGuire 2012, 1/2 in
            Jimenez 2014 (the two then add up to 1).
        relative: Relative comparison (Guertin 2014) or absolute (McGuire 2012).
        softness: See `saturate`.

    Differentiable: yes.
    Reference: McGuire 2012, section 3.3 (softDepthCompare); Guertin 2014, section 5 (zCompare).
        We differ from the latter: for positive depths the test as printed would take nearer
        samples for background; ours has the sign that its text means, and the extent that it
        fixes at 1 is a parameter, and so is the level.
    """
    scale = extent * torch.minimum(pixel, sample) if relative else extent
    difference = (pixel - sample) / scale
    return DepthWeights(
        saturate(level + difference, softness), saturate(level - difference, softness)
    )


def power(base: Tensor, exponent: float | Tensor) -> Tensor:
    """Return ``base ** exponent`` for a base in [0, 1], with finite gradients at 0.

    Args:
        base: Values >= 0.
        exponent: > 0.
    """
    # One logarithm for value and gradients, where `**` takes three powers.
    positive = base > _TINY
    logarithm = torch.where(positive, base, 1.0).log()
    return torch.where(positive, (exponent * logarithm).exp(), 0.0)


def threshold(value: Tensor, softness: float = 0.0) -> Tensor:
    """Return 1 where a value is above 0, else 0.

    Args:
        value: Any shape.
        softness: Above 0 a logistic step of about this width takes its place.

    Returns:
        Values in [0, 1], same shape.

    Differentiable: with a softness; a hard step has no gradient.
    """
    if softness == 0:
        return (value > 0).to(value.dtype)
    return torch.sigmoid(value * (4 / softness))
