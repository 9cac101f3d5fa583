"""Where moving objects uncover what lies behind them: the pixels for which a ray pays.

Three passes over the layers of a frame: pixels that a deeper object takes over (`uncovered`),
those of them at an edge (`edge_strength` above a threshold), and those from which the own motion
meets such an edge (`reaches`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.gather import Engine, Inputs, gather, lookup, pixel_grid, read
from torchblur.ops.velocity import direction
from torchblur.ops.weights import threshold

__all__ = ["RayMask", "edge_strength", "ray_mask", "reaches", "uncovered"]

_SMOOTH = (1.0, 4.0, 6.0, 4.0, 1.0)
_SLOPE = (-1.0, -2.0, 0.0, 2.0, 1.0)


class RayMask(NamedTuple):
    """The mask and what it was made of; planes in [0, 1], (B, 1, H, W)."""

    mask: Tensor
    edges: Tensor
    candidates: Tensor


def edge_strength(
    depth: Tensor,
    normal: Tensor | None = None,
    depth_gain: float | Tensor = 1.0,
    normal_gain: float | Tensor = 1.0,
) -> Tensor:
    """Return ``x_n = 1 − 1 / (x + 1)`` of the 5x5 Sobel operator, ``x = δ_d + δ_n``.

    δ_d is the length of the gradient of Z / Z_p, δ_n that of the gradient of the normal (over
    both axes and the three components).

    Args:
        depth: Positive depth, scene units, finite, (B, 1, H, W).
        normal: Unit normals, (B, 3, H, W); None leaves δ_n out.
        depth_gain: Factor of δ_d.
        normal_gain: Factor of δ_n.

    Returns:
        Strength in [0, 1], (B, 1, H, W).

    Differentiable: yes.
    Border: replicated.
    Reference: Tan 2022, section 3.2.1, eq. 3 and 4. The paper names neither kernel nor scale.
        Ours is the usual first-order kernel, (1, 4, 6, 4, 1) across and (−1, −2, 0, 2, 1) along,
        not normalized: with sums of 1, x would stay below 1 and never pass the paper's threshold
        of 0.9, which is x > 9, a step of 19 % of the depth. Depth is divided by the pixel's, so
        that the threshold does not depend on the unit.
    """
    x = depth_gain * _sobel(depth) / depth
    if normal is not None:
        x = x + normal_gain * _sobel(normal)
    return 1 - 1 / (x + 1)


def _sobel(planes: Tensor) -> Tensor:
    """Return the length of the gradient of all channels together, (B, 1, H, W)."""
    smooth, slope = planes.new_tensor(_SMOOTH), planes.new_tensor(_SLOPE)
    kernels = torch.stack((smooth[:, None] * slope, slope[:, None] * smooth))[:, None]
    padded = F.pad(planes, (2, 2, 2, 2), mode="replicate").flatten(0, 1)[:, None]
    gradient = F.conv2d(padded, kernels)
    squared = gradient.reshape(planes.shape[0], -1, *planes.shape[-2:]).square()
    return (squared.sum(1, keepdim=True) + 1e-12).sqrt()


def uncovered(
    displacement: Tensor,
    depth: Tensor,
    object_id: Tensor | None,
    soft_depth_extent: float | Tensor,
    softness: float = 0.0,
) -> Tensor:
    """Return the pixels that lie on another, deeper object once they are displaced.

    Args:
        displacement: Where to look, px, (B, 2, H, W).
        depth: Positive depth, scene units, finite, (B, 1, H, W).
        object_id: Object numbers, (B, 1, H, W); None compares depths alone.
        soft_depth_extent: The other must be deeper by more than this, scene units.
        softness: Width of the threshold in extents; 0 is hard.

    Returns:
        1 or 0 (between with a softness), (B, 1, H, W); 0 at pixels that do not move, and where
        the displaced position lies outside the image.

    Differentiable: with a softness, in depths and the extent.
    Reference: Tan 2022, section 3.2.1, eq. 1 and 2.
    """
    x, y = _moved(displacement, 1.0)
    deeper = (lookup(depth, x, y) - depth) / soft_depth_extent
    result = threshold(deeper - 1, softness) * _inside(x, y, *depth.shape[-2:])
    result = result * (direction(displacement) != 0).any(1, keepdim=True)
    if object_id is not None:
        result = result * (lookup(object_id, x, y) != object_id)
    return result


def reaches(
    mask: Tensor, displacement: Tensor, num_samples: int, engine: Engine = "eager"
) -> Tensor:
    """Return the largest value of a mask on the way along each pixel's displacement.

    Args:
        mask: Values in [0, 1], (B, 1, H, W).
        displacement: Length and direction of the way, px, (B, 2, H, W).
        num_samples: Samples on the way, at ``i / num_samples`` of it.
        engine: Of the gather.

    Returns:
        Values in [0, 1], (B, 1, H, W); 0 at pixels that do not move.

    Differentiable: in the mask.
    Border: samples outside the image do not count.
    Reference: Tan 2022, section 3.2.1 (range check).
    """
    x, y = pixel_grid(mask)
    inputs = {"texture": mask, "displacement": displacement, "x": x, "y": y}
    (found,) = gather(_reach_tap, None, num_samples, inputs, engine, num_maxima=1)
    return found * (direction(displacement) != 0).any(1, keepdim=True)


def ray_mask(
    displacement: Tensor,
    strength: Tensor,
    candidates: Tensor,
    edge_threshold: float | Tensor,
    num_samples: int,
    softness: float = 0.0,
    engine: Engine = "eager",
) -> RayMask:
    """Return the mask of the pixels whose own motion meets the edge of an uncovering object.

    Args:
        displacement: Where a pixel looks, px, (B, 2, H, W).
        strength: From `edge_strength`, (B, 1, H, W).
        candidates: From `uncovered`, (B, 1, H, W).
        edge_threshold: Strength above which a candidate is an edge.
        num_samples: Samples of the range check.
        softness: Width of the threshold; 0 is hard.
        engine: Of the gather.

    Differentiable: with a softness, in all but the displacement.
    Reference: Tan 2022, section 3.2.1.
    """
    edges = candidates * threshold(strength - edge_threshold, softness)
    return RayMask(reaches(edges, displacement, num_samples, engine), edges, candidates)


def _reach_tap(index: Tensor, count: Tensor, inputs: Inputs, options: None) -> tuple[Tensor, ...]:
    dx, dy = (inputs["displacement"] * (index / count)).split(1, 1)
    x, y = inputs["x"] + dx, inputs["y"] + dy
    inside = _inside(x, y, inputs["height"], inputs["width"])
    return (read(inputs, x, y)[0] * inside,)


def _moved(displacement: Tensor, share: float) -> tuple[Tensor, Tensor]:
    x, y = pixel_grid(displacement)
    dx, dy = (displacement * share).split(1, 1)
    return x + dx, y + dy


def _inside(x: Tensor, y: Tensor, height: Tensor | int, width: Tensor | int) -> Tensor:
    column, row = x.round(), y.round()
    inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    return inside.to(x.dtype)
