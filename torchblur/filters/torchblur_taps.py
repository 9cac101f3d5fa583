"""Taps of torchblur's own filter that are times, at which all directions compete."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.filters.front_back import Added, sample_classes, sum_planes
from torchblur.filters.reconstruction import ColorLookup, Tap, sample
from torchblur.ops.gather import Inputs, Planes, read, vector, weighted
from torchblur.ops.weights import saturate

__all__ = ["TimeOptions", "fill_hidden", "time_tap"]

_TINY = 1e-6
_TIE = 1e-4  # weights as close are equal: rounding must not decide


class TimeOptions(NamedTuple):
    """Switches of the taps; each set is compiled once."""

    directions: tuple[str, ...]
    """"first", "own", "second", "reversed": those that take part."""
    center: int
    refinements: int
    one_color: bool
    fill_hidden: bool
    relative_depth: bool
    shares: bool
    softness: float
    color_lookup: ColorLookup


class _Arrival(NamedTuple):
    """A sample that moves to the pixel."""

    x: Tensor
    y: Tensor
    depth: Tensor
    match: Tensor
    """How well it does, in [0, 1]."""


def time_tap(index: Tensor, count: Tensor, inputs: Inputs, options: TimeOptions) -> Added:
    """Return what the pixel shows at one time: what passes it then, and what else may lie behind.

    Each direction names a sample that would be at the pixel at this time. How well its own
    motion takes it there is its match; the nearer of those that match hides the others.
    """
    time = (2 * (index + 0.5 + inputs["shift"]) / count - 1).clamp(-1, 1) + options.center
    found = [
        _follow(vector(inputs, f"{name}_vector"), time, inputs, options)
        for name in options.directions
    ]
    weights = []
    open_share = torch.ones_like(found[0].match)
    for one in found:
        weight = one.match
        for other in found:
            if other is not one:
                hidden = sample_classes(one.depth, other.depth, inputs, options).foreground
                weight = weight * (1 - other.match * hidden)
        open_share = open_share * (1 - one.match)
        weights.append(weight)
    total = sum(weights[1:], weights[0])
    some = total > _TINY
    covered = torch.where(some, 1 - open_share, 0.0)
    colors = (_first_color if options.one_color else _mean_color)(found, weights, inputs, options)
    *front, seen = (covered * plane for plane in sum_planes(*(color for _, color in colors)))
    back, weight, hidden = _behind(time, 1 - covered, inputs, options)
    if not options.fill_hidden:
        return back, weight, tuple(front), seen, covered
    near = covered * (1 - time.abs() / (1 + abs(options.center))).square()
    visible = sum_planes(*(weighted(near * is_visible, color) for is_visible, color in colors))
    return (*back, *visible, hidden), weight, tuple(front), seen, covered


def fill_hidden(back: Tensor, weight: Tensor, gain: Tensor) -> tuple[Tensor, Tensor]:
    """Return color and weight of the back, hidden times filled with the pixel's own surface.

    Args:
        back: What `time_tap` sums up for it, (P, 8, 1, M): color; color and weight of what passes
            the pixel and is not in front of it; the share of hidden times.
        weight: Weight of that color, (P, 1, 1, M).
        gain: `background_gain`.
    """
    color, visible, seen, hidden = back.split((3, 3, 1, 1), 1)
    known = seen > _TINY
    hidden = torch.where(known, hidden, 0.0)
    filled = hidden * visible / torch.where(known, seen, 1.0)
    return gain * (color + filled), gain * (weight + hidden)


def _follow(
    motion: tuple[Tensor, Tensor], time: Tensor, inputs: Inputs, options: TimeOptions
) -> _Arrival:
    """Return the sample that moves to the pixel from where this motion would bring it."""
    dx, dy = motion
    for _ in range(options.refinements):
        place = inputs["x"] - time * dx, inputs["y"] - time * dy
        ux, uy, size = read(inputs, *place, channels=slice(0, 3))
        dx, dy = ux * size, uy * size
    x, y = inputs["x"] - time * dx, inputs["y"] - time * dy
    ux, uy, size, depth = read(inputs, x, y, channels=slice(0, 4))
    miss_x, miss_y = ux * size - dx, uy * size - dy
    miss = (miss_x.square() + miss_y.square() + 1e-12).sqrt() * time.abs()
    far = (dx.square() + dy.square() + 1e-12).sqrt() * time.abs()
    allowed = inputs["match_tolerance"] + inputs["match_slope"] * far
    return _Arrival(x, y, depth, saturate(1 - miss / allowed, options.softness))


def _first_color(
    found: list[_Arrival], weights: list[Tensor], inputs: Inputs, options: TimeOptions
) -> list[tuple[Tensor, Planes]]:
    """Return the color of the sample with the largest weight: one lookup for all."""
    x, y, most = found[0].x, found[0].y, weights[0]
    for one, weight in zip(found[1:], weights[1:], strict=True):
        larger = weight > most + _TIE
        x, y = torch.where(larger, one.x, x), torch.where(larger, one.y, y)
        most = torch.where(larger, weight, most)
    tap = sample(inputs, x, y, options.color_lookup)
    return [(_is_visible(tap, inputs, options), _colored(tap, torch.ones_like(most)))]


def _mean_color(
    found: list[_Arrival], weights: list[Tensor], inputs: Inputs, options: TimeOptions
) -> list[tuple[Tensor, Planes]]:
    """Return the colors of all samples by weights that add up to 1."""
    total = sum(weights[1:], weights[0])
    total = torch.where(total > _TINY, total, 1.0)
    colors = []
    for one, weight in zip(found, weights, strict=True):
        tap = sample(inputs, one.x, one.y, options.color_lookup)
        colors.append((_is_visible(tap, inputs, options), _colored(tap, weight / total)))
    return colors


def _is_visible(tap: Tap, inputs: Inputs, options: TimeOptions) -> Tensor:
    """Return 1 unless the tap lies in front of the pixel, which may hide what it shows."""
    behind = sample_classes(inputs["depth"], tap.depth, inputs, options).background
    return (behind > 0).to(behind.dtype)


def _behind(
    time: Tensor, share: Tensor, inputs: Inputs, options: TimeOptions
) -> tuple[Planes, Tensor, Tensor]:
    """Return color and weight of the tap on the pixel's own line behind it, and what is hidden."""
    dx, dy = vector(inputs, "half")
    tap = sample(inputs, inputs["x"] - time * dx, inputs["y"] - time * dy, options.color_lookup)
    behind = sample_classes(inputs["depth"], tap.depth, inputs, options).background
    gain = 1.0 if options.fill_hidden else inputs["background_gain"]  # there it comes after
    *color, weight = _colored(tap, gain * share * behind)
    return tuple(color), weight, share * (1 - behind)


def _colored(tap: Tap, weight: Tensor) -> Planes:
    """Return a tap's color times a weight, and the weight of it that is valid."""
    return *weighted(weight, tap.color), weight if tap.valid is None else weight * tap.valid
