"""Stored numbers into torchblur's units: px/frame forward in time, and positive distances."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.io.conventions import Convention

__all__ = ["depth_to_distance", "mean_and_change", "time_to_shutter", "velocity_to_pixels"]


def velocity_to_pixels(
    stored: Tensor, convention: Convention, *, sign: int, image_size: tuple[int, int]
) -> Tensor:
    """Convert a stored pair to px/frame, forward in time, x right, y down.

    Args:
        stored: As the file has it, (1, 2, H, W).
        convention: Bias, scale, unit and y axis.
        sign: +1 if stored forward in time, -1 if against it.
        image_size: Height and width of the whole image in px, to which uv and ndc refer.

    Returns:
        Velocity, (1, 2, H, W).
    """
    height, width = image_size
    span = {"px": (1.0, 1.0), "uv": (width, height), "ndc": (width / 2, height / 2)}
    x, y = span[convention.velocity_unit]
    if convention.velocity_y == "up":
        y = -y
    factor = torch.tensor([x, y], dtype=stored.dtype)[:, None, None]
    velocity = (stored - convention.velocity_bias) * (factor * sign * convention.velocity_scale)
    return velocity + 0.0  # -0 becomes 0


def mean_and_change(
    following: Tensor | None, previous: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Return velocity and acceleration of a path through three frames.

    ``p(t) = p + v t + a t² / 2`` with ``v = (v_prev + v_next) / 2`` and ``a = v_next - v_prev``.

    Args:
        following: Displacement to the next frame, px, (1, 2, H, W), or None.
        previous: Displacement from the previous frame, px, or None.

    Returns:
        Velocity in px/frame, and acceleration in px/frame² if both are given.

    Raises:
        ValueError: if both are None.
    """
    if following is not None and previous is not None:
        return (following + previous) / 2, following - previous
    only = following if following is not None else previous
    if only is None:
        raise ValueError("a velocity needs a pair of channels, got none")
    return only, None


def depth_to_distance(stored: Tensor, convention: Convention) -> Tensor:
    """Convert a stored depth to the distance along the view axis, scene units.

    Args:
        stored: As the file has it, (1, 1, H, W).
        convention: Kind, near and far plane, scale, and the meaning of zero.

    Returns:
        Distance, (1, 1, H, W); +inf where there is nothing. Values that mean nothing (negative,
        NaN) stay as they are, for the `Frame` to refuse.
    """
    near, far = convention.depth_near, convention.depth_far
    if convention.depth_kind == "planar":
        distance = stored * convention.depth_scale
        if convention.depth_zero == "background":
            distance = torch.where(stored == 0, math.inf, distance)
        return distance
    if convention.depth_kind == "hyperbolic":
        distance = near * far / (far - stored * (far - near))
        return distance * convention.depth_scale
    numerator = near if convention.depth_kind == "reversed" else 1.0
    return torch.where(stored == 0, math.inf, numerator / stored * convention.depth_scale)


def time_to_shutter(stored: Tensor, convention: Convention) -> Tensor:
    """Convert stored times to times over the shutter, 0 the opening, 1 the closing.

    Args:
        stored: As the file has it, (1, 1, H, W).
        convention: The times at which the shutter opens and closes.

    Returns:
        Times, (1, 1, H, W).

    Raises:
        ConfigError: if the shutter opens and closes at one time.
    """
    start, end = convention.time_start, convention.time_end
    if start == end:
        raise ConfigError(f"`time_start` and `time_end` must differ, got {start} for both")
    return (stored - start) / (end - start)
