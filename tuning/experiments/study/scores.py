"""The masks that figures are taken over, and what a filter is worth in raw samples."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchblur.frame import Shutter
from tuning.experiments.study.frames import Moment

__all__ = ["agreement", "hidden_mask", "moving_mask", "worth_of"]

_MIN_BLUR = 0.5  # px over the shutter from which a pixel counts as moving
_HIDDEN_SHARE = 0.05  # of the shutter's time, from which background behind an object counts
_HIDDEN_TIMES = 33


def moving_mask(moment: Moment) -> Tensor:
    """Return where something moves, in the sharp frame or in a sample, bool, (1, 1, H, W)."""
    masks = [
        _speed(frame.velocity, moment.shutter) >= _MIN_BLUR
        for frame in (moment.sharp, *moment.samples)
    ]
    return torch.stack(masks).any(0)


def hidden_mask(moment: Moment) -> Tensor:
    """Return where the reference shows background behind a moving object, bool, (1, 1, H, W).

    A pixel counts if what its center sees at the middle of the shutter moves, and if for more
    than 5 % of the shutter's time something of another id lies there, farther away.

    For scenes that is counted over 32 rays, each at its own time. For files it is estimated from
    the sharp frame: the object is carried along its own velocity in a straight line, so at time s
    the pixel has what lies at ``p - v s`` in the sharp frame; if that has another id and lies
    deeper, the object has moved away. What comes in from outside the image is not known and does
    not count.

    Args:
        moment: A frame with object ids and depth.
    """
    sharp = moment.sharp
    assert sharp.object_id is not None
    moves = _speed(sharp.velocity, moment.shutter) >= _MIN_BLUR
    depth = sharp.finite_depth()
    if moment.seen is not None:
        ids, depths = moment.seen
        away = (ids != sharp.object_id) & (depths > depth)
    else:
        away = torch.cat([_away(moment, time) for time in _times(moment.shutter)])
    return moves & (away.float().mean(dim=0, keepdim=True) > _HIDDEN_SHARE)


def agreement(mask: Tensor, truth: Tensor) -> dict[str, float | None]:
    """Return recall and precision of a mask, and both shares of the image's pixels.

    Args:
        mask: bool, (1, 1, H, W).
        truth: bool, (1, 1, H, W).
    """
    both = int((mask & truth).sum())
    asked, true = int(mask.sum()), int(truth.sum())
    return {
        "recall": both / true if true else None,
        "precision": both / asked if asked else None,
        "mask_share": asked / mask.numel(),
        "hidden_share": true / truth.numel(),
    }


def worth_of(value: float | None, curve: Sequence[tuple[int, float]], *, rising: bool) -> str:
    """Return how many raw samples per pixel have the same error, "3.4", "< 1" or "> 16".

    Between the points of the curve the logarithm of the number is interpolated.

    Args:
        value: The figure of a filter.
        curve: Numbers of samples, rising, and the figures of their mean.
        rising: Whether a larger figure is better.
    """
    if value is None or len(curve) < 2:
        return ""
    sign = 1.0 if rising else -1.0
    points = [(math.log2(n), sign * figure) for n, figure in curve]
    level = sign * value
    if level < points[0][1]:
        return f"< {curve[0][0]}"
    for (n, low), (m, high) in itertools.pairwise(points):
        if low <= level <= high:
            share = (level - low) / (high - low) if high > low else 0.0
            return f"{2 ** (n + share * (m - n)):.1f}"
    return f"> {curve[-1][0]}"


def _speed(velocity: Tensor, shutter: Shutter) -> Tensor:
    """Return displacements over the shutter, px, (1, 1, H, W)."""
    return velocity.square().sum(dim=1, keepdim=True).sqrt() * shutter.open


def _times(shutter: Shutter) -> list[float]:
    start, end = shutter.interval
    return torch.linspace(start, end, _HIDDEN_TIMES).tolist()


def _away(moment: Moment, time: float) -> Tensor:
    """Return where the object of the sharp frame has moved away at a time, bool, (1, 1, H, W)."""
    sharp = moment.sharp
    assert sharp.object_id is not None
    height, width = sharp.size
    rows, columns = torch.arange(height).view(-1, 1), torch.arange(width).view(1, -1)
    x = (columns - sharp.velocity[0, 0] * time).round().long()
    y = (rows - sharp.velocity[0, 1] * time).round().long()
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    depth = sharp.finite_depth()[0, 0]
    other = sharp.object_id[0, 0][y, x] != sharp.object_id[0, 0]
    return (inside & other & (depth[y, x] > depth))[None, None]
