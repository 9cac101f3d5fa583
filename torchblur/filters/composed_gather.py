"""Taps of the composed filter: one direction by turns, or both sides of the pixel in pairs."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.front_back import Added, sample_classes, sum_planes
from torchblur.filters.reconstruction import WEIGHT_PARAMETERS, ColorLookup, Tap, is_one, sample
from torchblur.frame import Shutter
from torchblur.ops.gather import Inputs, vector, weighted
from torchblur.ops.spread import Mirror, SpreadForm, TapPair, mirror, spread_weight
from torchblur.ops.weights import cone, cylinder, power, saturate

__all__ = ["TAP_PARAMETERS", "TapOptions", "alternate_tap", "pair_tap", "tap_options"]

_TINY = 1e-6
TAP_PARAMETERS = (
    *WEIGHT_PARAMETERS,
    "spread_offset",
    "spread_slope",
    "direction_exponent",
    "area_slope",
)
"""Parameters that the taps take as they are: sets of them share one frame."""


class TapOptions(NamedTuple):
    """Switches of the taps; each set is compiled once."""

    directions: tuple[str, ...]
    """"first", "own", "second": those that take part, in the order of their taps."""
    center: int
    relative_depth: bool
    shares: bool
    spread: Literal["cone", "ramp"]
    spread_form: SpreadForm
    third: Literal["shorter", "product", "none"]
    direction_weights: bool
    linear_direction: bool
    linear_cone: bool
    mirror: Mirror
    skip_middle_tap: bool
    accurate_alpha: bool
    fast_tiles: bool
    softness: float
    color_lookup: ColorLookup


class _Weights(NamedTuple):
    background: Tensor
    foreground: Tensor
    alpha: Tensor


def tap_options(values: Values, directions: tuple[str, ...]) -> TapOptions:
    """Return the switches that the parameters stand for."""
    return TapOptions(
        directions=directions,
        center=Shutter(1, values.shutter_position).center,
        relative_depth=values.depth_compare == "relative",
        shares=values.depth_classes == "shares",
        spread=values.spread,
        spread_form=values.spread_compare,
        third=values.third_form,
        direction_weights=values.direction_weights,
        linear_direction=is_one(values.direction_exponent),
        linear_cone=is_one(values.cone_exponent),
        mirror=values.mirror_filter,
        skip_middle_tap=values.skip_middle_tap and values.shutter_position == "centered",
        accurate_alpha=values.accurate_alpha,
        fast_tiles=values.tile_classes,
        softness=values.softness,
        color_lookup=values.color_lookup,
    )


# -- one direction by turns ------------------------------------------------------------------------


def alternate_tap(index: Tensor, count: Tensor, inputs: Inputs, options: TapOptions) -> Added:
    """Return what one tap adds; the directions take turns."""
    names = options.directions
    turn = torch.remainder(index, len(names))
    dx, dy = vector(inputs, f"{names[0]}_unit")
    reach, own = (inputs[f"{names[0]}_{key}"] for key in ("reach", "agrees"))
    for number, name in enumerate(names[1:], 1):
        mine = turn == number
        unit_x, unit_y = vector(inputs, f"{name}_unit")
        dx, dy = torch.where(mine, unit_x, dx), torch.where(mine, unit_y, dy)
        reach = torch.where(mine, inputs[f"{name}_reach"], reach)
        own = torch.where(mine, inputs[f"{name}_agrees"], own)
    t = (2 * (index + 1 + inputs["shift"]) / (count + 1) - 1).clamp(-1, 1)
    per_px = 0.5 * count / reach.clamp_min(_TINY)
    tap, weights = _tap(t, _Line(dx, dy, reach, own, per_px), inputs, options)
    if options.skip_middle_tap:
        weights = _Weights(*(w * (2 * index != count - 1) for w in weights))
    return _sums(tap, _plain(weights, inputs, options))


# -- both sides of the pixel -----------------------------------------------------------------------


def pair_tap(index: Tensor, count: Tensor, inputs: Inputs, options: TapOptions) -> Added:
    """Return what two taps add, at equal times before and after the middle of the exposure."""
    pairs = inputs["pairs"]
    step, shift = (index + 0.5) / pairs, inputs["shift"] / pairs
    reach = inputs["reach"]
    line = _Line(*vector(inputs, "unit"), reach, inputs["agrees"], pairs / reach)
    times = [(side * step + shift).clamp(-1, 1) for side in (1, -1)]
    taps, weights = zip(*(_tap(t, line, inputs, options) for t in times), strict=True)
    mirrored = mirror(
        weights,
        TapPair(*(tap.depth for tap in taps)),
        TapPair(*(tap.length for tap in taps)),
        options.mirror,
    )
    taken = (index < pairs).to(step.dtype)
    parts = []
    for tap, chosen in zip(taps, mirrored, strict=True):
        plain = _plain(_Weights(*chosen), inputs, options)
        parts.append(_sums(tap, _Weights(*(taken * w for w in plain))))
    later, earlier = parts
    return (
        sum_planes(later[0], earlier[0]),
        later[1] + earlier[1],
        sum_planes(later[2], earlier[2]),
        later[3] + earlier[3],
        later[4] + earlier[4],
    )


# -- weights ---------------------------------------------------------------------------------------


def _plain(weights: _Weights, inputs: Inputs, options: TapOptions) -> _Weights:
    """Return the weights; where all tiles move alike all of it is front."""
    if not options.fast_tiles:
        return weights
    fast = inputs["fast"] > 0
    back, front, alpha = weights
    return _Weights(
        *(torch.where(fast, v, w) for v, w in ((0.0, back), (1.0, front), (1.0, alpha)))
    )


def _sums(tap: Tap, weights: _Weights) -> Added:
    back, front, alpha = weights
    colors = weighted(back, tap.color), weighted(front, tap.color)
    if tap.valid is not None:
        back, front = back * tap.valid, front * tap.valid
    return colors[0], back, colors[1], front, alpha


class _Line(NamedTuple):
    dx: Tensor
    dy: Tensor
    reach: Tensor
    """Half spread of the tile, px."""
    own: Tensor
    """Agreement with the pixel's direction."""
    per_px: Tensor
    """Taps per px."""


def _tap(t: Tensor, line: _Line, inputs: Inputs, options: TapOptions) -> tuple[Tap, _Weights]:
    """Return what lies at a time t in [-1, 1] of a line, and its weights."""
    dx, dy, reach, own, per_px = line
    along = (t + options.center) * reach
    tap = sample(inputs, inputs["x"] - along * dx, inputs["y"] - along * dy, options.color_lookup)
    toward = tap.unit_x * dx + tap.unit_y * dy
    distance_s = distance_p = along.abs()
    if options.center:
        half_x, half_y = vector(inputs, "half")
        moved_p = half_x * dx + half_y * dy
        distance_s = (along - options.center * tap.length * toward).abs()
        distance_p = (along - options.center * moved_p).abs()
    classes = sample_classes(inputs["depth"], tap.depth, inputs, options)
    front = inputs["foreground_gain"] * classes.foreground
    back = inputs["background_gain"] * classes.background
    if options.spread == "ramp":
        front = front * _ramp(distance_s * per_px, tap.length * per_px, inputs, options)
        back = back * _ramp(distance_p * per_px, inputs["length"] * per_px, inputs, options)
    else:
        front = front * _cone(distance_s, tap.length, inputs, options)
        back = back * _cone(distance_p, inputs["length"], inputs, options)
    third = _third(distance_s, distance_p, tap, inputs, options)
    if options.direction_weights:
        theirs = toward.abs()
        if not options.linear_direction:
            theirs = power(theirs, inputs["direction_exponent"])
        front, back = front * theirs, back * own
        third = None if third is None else third * torch.maximum(own, theirs)
    if third is not None:
        front = front + third
    alpha = front
    if options.accurate_alpha:
        alpha = saturate(front / (1 + inputs["area_slope"] * tap.length), options.softness)
    return tap, _Weights(back, front, alpha)


def _ramp(distance: Tensor, reach: Tensor, inputs: Inputs, options: TapOptions) -> Tensor:
    return spread_weight(
        distance,
        reach,
        offset=inputs["spread_offset"],
        slope=inputs["spread_slope"],
        form=options.spread_form,
        softness=options.softness,
    )


def _cone(distance: Tensor, size: Tensor, inputs: Inputs, options: TapOptions) -> Tensor:
    exponent = None if options.linear_cone else inputs["cone_exponent"]
    size = torch.maximum(size, inputs["min_length"])
    return cone(distance, size, inputs["cone_slope"], exponent, options.softness)


def _third(
    distance_s: Tensor, distance_p: Tensor, tap: Tap, inputs: Inputs, options: TapOptions
) -> Tensor | None:
    """Return the weight of two blurs over each other."""
    if options.third == "none":
        return None
    ends = inputs["cylinder_inner"], inputs["cylinder_outer"]
    length_s = torch.maximum(tap.length, inputs["min_length"])
    length_p = torch.maximum(inputs["length"], inputs["min_length"])
    if options.third == "product":
        both = cylinder(distance_s, length_s, *ends) * cylinder(distance_p, length_p, *ends)
    else:
        distance = torch.where(length_s <= length_p, distance_s, distance_p)
        both = cylinder(distance, torch.minimum(length_s, length_p), *ends)
    third: Tensor = inputs["third_gain"] * both
    return third
