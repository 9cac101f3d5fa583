"""Iterative reprojection: where in the last frame was what is now here."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.ops.points import Points, flat, nearest_index

__all__ = ["FAILED", "Found", "Search", "reproject"]

FAILED = -1.0
"""Outcome of a pixel for which no place was found."""


class Search(NamedTuple):
    """When to stop."""

    iterations: int = 2
    accept: Tensor | float = 1.0
    """A place is good if it misses by less than this, px; a number or (1, N)."""
    cancel: Tensor | float = 16.0
    """The search ends if it misses by more than this and by more than the motion, px."""


class Found(NamedTuple):
    """Places in the last frame."""

    points: Points
    """The places, one for each pixel; only where `outcome` is positive they mean anything."""
    outcome: Tensor
    """At which evaluation the place was accepted, 1, 2 …, or `FAILED`, (1, N)."""


@torch.no_grad()
def reproject(
    points: Points, velocity: Tensor, past_velocity: Tensor, past_weight: Tensor, search: Search
) -> Found:
    """Return where the moving samples at pixels p were one frame ago.

    Starting at ``q = p − u_p``, ``δ = (p − ½ u_p) − (q + ½ u_q)`` tells by how much projecting
    back and forth miss each other half way; below the first threshold q is accepted, above the
    second the search ends, else q moves by δ.

    Args:
        points: The pixels p.
        velocity: u_p, filtered, px/frame, (2, N).
        past_velocity: u of the last frame's moving channel, px/frame, (B, 2, H, W).
        past_weight: Its weight; 0 where there is nothing, (B, 1, H, W).
        search: Number of evaluations and thresholds.

    Returns:
        The nearest pixels and the outcome.

    Differentiable: no, it chooses.
    Border: a place outside the image fails.
    Reference: Oberberger 2022, section 4.4.
    """
    past = flat(torch.cat((past_velocity, past_weight), 1))
    inputs = points.inputs()
    half_x, half_y = points.x - velocity[:1] / 2, points.y - velocity[1:] / 2
    x, y = points.x - velocity[:1], points.y - velocity[1:]
    longest = torch.maximum(
        velocity.square().sum(0, keepdim=True).sqrt(), torch.as_tensor(search.cancel)
    )
    outcome = torch.zeros_like(points.x)
    for turn in range(search.iterations):
        index, near_x, near_y = nearest_index(x, y, inputs)
        ux, uy, weight = past.index_select(1, index).split(1)
        inside = (near_x == x.round()) & (near_y == y.round()) & (weight > 0)
        dx, dy = half_x - (x + ux / 2), half_y - (y + uy / 2)
        missed = (dx * dx + dy * dy).sqrt()
        searching = outcome == 0
        good = searching & inside & (missed < search.accept)
        bad = searching & ~good & (~inside | (missed > longest))
        outcome = torch.where(good, float(turn + 1), torch.where(bad, FAILED, outcome))
        moved = outcome == 0
        x, y = torch.where(moved, x + dx, x), torch.where(moved, y + dy, y)
    index, x, y = nearest_index(x, y, inputs)
    outcome = torch.where(outcome == 0, FAILED, outcome)
    return Found(Points(index, x, y, points.first, points.shape), outcome)
