"""How fast a frame moves, and whether color and velocity fit together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.frame import Shutter

__all__ = ["BlurCheck", "SignMatch", "VelocityInfo", "check_blur", "check_speed", "compare_signs"]

_MOVING = 0.5
"""Least speed in px/frame that counts as moving."""

_FAST = 12.0
"""Least speed in px/frame at which blur in the color can be told."""
_NEAR, _FAR = 2.0, 6.0
_MIN_PIXELS = 500
_SMOOTH_ALONG, _SMOOTHER_THAN_ACROSS = 0.21, 0.87


@dataclass(frozen=True)
class VelocityInfo:
    """Speeds in px/frame: median, 95th percentile and maximum of the pixels that move.

    Moving is 0.5 px/frame and more; `moving_share` is their share of all pixels. `percentiles` are
    of all pixels, 0 to 100.
    """

    median: float
    percentile_95: float
    maximum: float
    moving_share: float
    percentiles: tuple[float, ...]


@dataclass(frozen=True)
class BlurCheck:
    """Whether the color seems to hold motion blur already.

    Args:
        along: Mean squared color difference over 2 px along the motion, divided by that over
            6 px: 1/3 at sharp edges, 1/9 in a blur that is longer.
        across: The same across the motion: what the scene has where motion blur cannot be.
        pixels: Number of pixels that move at least 12 px/frame, on which this rests.
        blurred: The verdict; None if too few pixels move, or nothing is to be seen on them.
    """

    along: float
    across: float
    pixels: int
    blurred: bool | None


@dataclass(frozen=True)
class SignMatch:
    """How well a blur along the velocity, changed in one way, meets the reference.

    Args:
        change: What was done to the velocity: "as read", "y negated", "x and y swapped" …
        psnr: PSNR to the reference in dB, linear RGB, peak 1.
    """

    change: str
    psnr: float


def check_speed(velocity: Tensor) -> VelocityInfo:
    """Return the speeds of a velocity in px/frame, (1, 2, H, W)."""
    speed = velocity.norm(dim=1).numpy()
    moving = speed[speed >= _MOVING]
    percentiles = tuple(np.percentile(speed, range(101)).tolist())
    if not moving.size:
        return VelocityInfo(0.0, 0.0, float(speed.max()), 0.0, percentiles)
    median, high = (float(q) for q in np.percentile(moving, [50, 95]))
    share = moving.size / speed.size
    return VelocityInfo(median, high, float(moving.max()), share, percentiles)


def check_blur(color: Tensor, velocity: Tensor) -> BlurCheck:
    """Tell whether a color image has motion blur along its velocity already.

    How smooth an image is shows in how fast color differences grow with distance: linearly over
    sharp edges, quadratically within a blur. Both distances are measured on the same pixels, and
    along the motion against across it, so neither texture nor a soft pixel filter raises alarm.
    The verdict is "blurred" if along < 0.21 and along / across < 0.87; both numbers come from
    frames of another renderer, sharp and with their motion-blurred references in place of the
    color. It misses what noise or a soft lens covers, and a wrong sign of velocity misleads it.

    Args:
        color: Scene-linear, (1, 3, H, W); clipped to [0, 1].
        velocity: px/frame, (1, 2, H, W).

    Returns:
        The verdict and what it rests on.
    """
    speed = velocity.norm(dim=1, keepdim=True)
    fast = speed >= _FAST
    pixels = int(fast.sum())
    along = velocity / speed.clamp_min(1e-6)
    across = torch.stack([-along[:, 1], along[:, 0]], dim=1)
    image = color.clamp(0, 1)
    ratios, seen = [], pixels >= _MIN_PIXELS
    for direction in (along, across):
        near, far = (_change(image, direction * d, fast) for d in (_NEAR, _FAR))
        seen = seen and far > 1e-5
        ratios.append(near / far if far > 0 else math.nan)
    blurred = ratios[0] < _SMOOTH_ALONG and ratios[0] < _SMOOTHER_THAN_ACROSS * ratios[1]
    return BlurCheck(ratios[0], ratios[1], pixels, blurred if seen else None)


def compare_signs(
    color: Tensor, velocity: Tensor, reference: Tensor, shutter: Shutter | None = None
) -> list[SignMatch]:
    """Blur the color along the velocity, with each sign and order of axes; best match first.

    With a centered shutter the sign of the whole vector cannot show: the blur along v and along
    -v is the same, so combinations come in pairs of equal PSNR, and "as read" stands for its pair.

    Args:
        color: Sharp color, (1, 3, H, W).
        velocity: px/frame, (1, 2, H, W).
        reference: The same frame with motion blur, (1, 3, H, W).
        shutter: Of the reference; half a frame, centered, if left out.

    Returns:
        Nine entries: "not blurred" (the color itself) and eight combinations.
    """
    shutter = shutter or Shutter()
    matches = [SignMatch("not blurred", _psnr(color, reference))]
    for swap in (False, True):
        for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            changed = velocity.flip(1) if swap else velocity
            changed = changed * velocity.new_tensor([x, y])[:, None, None]
            blurred = _line_blur(color, changed, shutter)
            matches.append(SignMatch(_describe(swap, x, y), _psnr(blurred, reference)))
    return sorted(matches, key=lambda match: -round(match.psnr, 4))


def _describe(swap: bool, x: int, y: int) -> str:
    signs = {(1, 1): "", (1, -1): "y negated", (-1, 1): "x negated", (-1, -1): "x and y negated"}
    parts = ["x and y swapped" if swap else "", signs[x, y]]
    return ", then ".join(part for part in parts if part) or "as read"


def _line_blur(color: Tensor, velocity: Tensor, shutter: Shutter, taps: int = 24) -> Tensor:
    start, end = shutter.interval
    total = torch.zeros_like(color)
    for tap in range(taps):
        time = start + (tap + 0.5) / taps * (end - start)
        total += _moved(color, -velocity * time)
    return total / taps


def _change(image: Tensor, offset: Tensor, where: Tensor) -> float:
    difference = _moved(image, offset / 2) - _moved(image, -offset / 2)
    squares = difference.square().mean(dim=1, keepdim=True)
    return float(squares[where].mean()) if bool(where.any()) else 0.0


def _moved(image: Tensor, offset: Tensor) -> Tensor:
    """Look up an image at each pixel plus an offset in px, (1, 2, H, W); bilinear."""
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=image.dtype) + 0.5,
        torch.arange(width, dtype=image.dtype) + 0.5,
        indexing="ij",
    )
    grid = torch.stack(
        [(x + offset[:, 0]) / width * 2 - 1, (y + offset[:, 1]) / height * 2 - 1], dim=-1
    )
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False)


def _psnr(image: Tensor, reference: Tensor) -> float:
    error = float((image - reference).square().mean())
    return math.inf if error == 0 else -10 * math.log10(error)
