"""Guertin 2014: a fast and stable feature-aware motion blur filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.guertin2014.config import Guertin2014Config
from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import Cost, gather, tiles, with_background
from torchblur.filters.parts.moving import Filtered, Moving, Stray, moving_part, revealed_part
from torchblur.filters.parts.reach import ReachingBlur, by_length
from torchblur.filters.parts.reconstruction import WEIGHT_PARAMETERS, Tap, is_one, resolve, sample
from torchblur.filters.parts.spreads import Spread, per_image, tiles_of
from torchblur.frame import Frame, Shutter
from torchblur.ops.color import luma
from torchblur.ops.gather import (
    Engine,
    Inputs,
    Lookup,
    Planes,
    components,
    gather_lists,
    vector,
    weighted,
)
from torchblur.ops.noise import checkerboard, noise_plane
from torchblur.ops.tiles import tile_lookup, tile_variance
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import cone, cylinder, depth_weights, power, saturate

__all__ = ["Guertin2014Blur", "Guertin2014Config", "center_direction", "guertin2014"]

_GOLDEN = 0.6180339887498949  # spreads the taps of one direction evenly over the others


class _Options(NamedTuple):
    center: int
    two_directions: bool
    by_variance: bool
    direction_weights: bool
    linear_direction: bool
    linear_cone: bool
    own_length: bool
    relative_depth: bool
    softness: float
    color_lookup: Lookup


def guertin2014(frame: Frame, config: Guertin2014Config | None = None, **params: Any) -> Tensor:
    """Blur with the feature-aware filter of Guertin 2014.

    Taps alternate between the dominant velocity of the neighborhood of tiles (w_n) and the
    center direction w_c: the pixel's own, or, where that is short, the perpendicular of w_n.
    The weight of a tap at distance T along direction d is

    ``f · cone(T, ℓ_S) · B + b · cone(T, ℓ_p) · A + 2 · cyl(T, min(ℓ_S, ℓ_p)) · max(A, B)``

    with ``A = |w_c · d|`` and ``B = |û_S · d|``; the pixel itself has the weight N / (κ ℓ_p).

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the paper's if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity through the weights (not through the
        positions of nearest lookups), and in every parameter that `torchblur params` calls
        smooth. Tiles are chosen by a maximum, which has no gradient.
    Border: replicated.
    Reference: Guertin, McGuire, Nowrouzezahrai 2014, appendix A. We differ where the text
        contradicts itself or leaves a gap: the center direction mixes unit vectors and goes to
        the perpendicular for slow pixels (eq. 1 is reversed); depth comparison has the sign that
        the text means; both directions are unit vectors and taps on either reach as far as the
        dominant velocity; products of directions are absolute; positions are rounded, not
        floored, and T is the distance before rounding; samples below a thousandth of a pixel
        have no direction (B = 0); taps do not leave [-1, 1]; velocities are floats unless asked
        for in 8 bits.
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = Guertin2014Blur(config, **params)(frame)
    return result


class Guertin2014Blur(ReachingBlur):
    """The feature-aware filter of Guertin 2014. See `guertin2014` for the formula.

    `layers` adds "luma" for an anti-aliasing pass (B, 1, H, W), "tile_max" and "neighbor_max"
    (half spread in px, (B, 2, Ty, Tx)), "tile_variance" ((B, 1, Ty, Tx), if taps are assigned by
    it) and "weight" (the sum of all weights, (B, 1, H, W); 0 where nothing moves).
    """

    name = "guertin2014"
    config_class = Guertin2014Config
    per_frame = ("shutter",)

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        whole = tiles(config.tile_size) + gather(config.num_samples, config.color_lookup)
        if config.sample_assignment == "variance":
            whole += Cost(lookups=9, passes=1) * (1 / config.tile_size**2)
        return with_background(whole, config)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", "luma", "weight" and the tiles."""
        layers = _filtered(frame, values, self.engine).layers(frame)
        moving = layers.pop("moving") > 0
        return layers | {"luma": _luma(frame, moving, values.luma, layers["color"])}

    def color(self, frame: Frame, values: Values) -> Tensor:
        """Return the blurred color alone, (B, 3, H, W)."""
        return _filtered(frame, values, self.engine).color(frame)


def _filtered(frame: Frame, values: Values, engine: Engine) -> Filtered:
    uint8 = values.velocity_encoding == "uint8"
    own, around = tiles_of(frame, values, uint8=uint8, cull=values.neighbor_culling)
    tiles = {"tile_max": own, "neighbor_max": around}
    if values.sample_assignment == "variance":
        tiles["tile_variance"] = tile_variance(own, per_image(values.min_length))
    stray = Stray(values.noise, values.tau) if values.stochastic_tiles else None
    part = moving_part(frame, values, around, stray=stray, uint8=uint8)
    if part is None:
        return Filtered.still(frame, tiles, "weight", "moving")
    inputs = _tap_inputs(part, tiles.get("tile_variance"))
    inputs |= revealed_part(frame, values, part, lambda f, v: _filtered(f, v, engine).color(f))
    options = _options(values)
    sums = by_length(
        lambda count, lists, pixels: gather_lists(
            _tap, options, count, lists, pixels, engine, color_from=part.color_from
        ),
        values,
        inputs["reach"],
        inputs,
        part.pixels,
        values.num_samples,
    )
    center_weight = values.num_samples / (part.values.kappa * inputs["length_p"])
    if not values.center_weight:
        center_weight = torch.zeros_like(center_weight)
    moving = inputs["reach"] > part.values.early_out
    color, weight = resolve(part.frame, sums, center_weight, moving)
    lists = {"color": color, "weight": weight * moving, "moving": moving.to(frame.dtype)}
    return Filtered(tiles, part.pixels, lists)


def _tap_inputs(part: Moving, variance: Tensor | None) -> Inputs:
    frame, values, spread, pixels = part.frame, part.values, part.spread, part.pixels
    x, y = part.grid()
    w_n = direction(part.dominant)
    noise = noise_plane(values.noise, frame.color, 0, values.seed, pixels)
    length_p = torch.maximum(spread.length, values.min_length)
    w_c = center_direction(w_n, spread, length_p, values)
    against_tile = power((w_c * w_n).sum(1, keepdim=True).abs(), values.direction_exponent)
    inputs = {
        "texture": part.texture,
        "x": x,
        "y": y,
        **components("w_n", w_n),
        **components("w_c", w_c),
        "reach": length(part.dominant),
        "jitter": (2 * noise - 1) * values.eta * values.phi / values.num_samples,
        "depth": frame.finite_depth(),
        **components("half", spread.half),
        "length": spread.length,
        "length_p": length_p,
        # A for a tap along w_n and along w_c, which is one plane for all taps
        "own_n": against_tile,
        "own_c": torch.ones_like(against_tile)
        if values.own_direction_against == "tap"
        else against_tile,
        "extent": values.relative_depth_extent
        if values.depth_compare == "relative"
        else values.soft_depth_extent,
    }
    if variance is not None:
        inputs["variance"] = tile_lookup(
            variance, frame.color, values.tile_size, bilinear=True, pixels=pixels
        )
    for key in (*WEIGHT_PARAMETERS, "direction_exponent"):
        inputs[key] = getattr(values, key)
    return inputs


def _options(values: Values) -> _Options:
    return _Options(
        center=Shutter(1, values.shutter_position).center,
        two_directions=values.directions == "two",
        by_variance=values.sample_assignment == "variance",
        direction_weights=values.direction_weights,
        linear_direction=is_one(values.direction_exponent),
        linear_cone=is_one(values.cone_exponent),
        own_length=values.tap_length == "own",
        relative_depth=values.depth_compare == "relative",
        softness=values.softness,
        color_lookup=values.color_lookup,
    )


def center_direction(w_n: Tensor, spread: Spread, length_p: Tensor, values: Values) -> Tensor:
    """Return w_c: the pixel's direction, or the perpendicular of w_n where the pixel is slow.

    Args:
        w_n: Unit vector of the tile's motion, (B, 2, H, W).
        spread: Half spreads of the pixels.
        length_p: Their lengths, floored, px, (B, 1, H, W).
        values: `min_length`, `gamma` and `softness`.

    Reference: Guertin 2014, eq. 1.
    """
    w_p = torch.cat((-w_n[:, 1:], w_n[:, :1]), 1)
    against = (w_p * spread.half).sum(1, keepdim=True) < 0
    w_p = torch.where(against, -w_p, w_p)
    mix = saturate((length_p - values.min_length) / values.gamma, values.softness)
    mixed = (1 - mix) * w_p + mix * spread.unit
    size = length(mixed)
    return torch.where(size < 1e-6, w_p, mixed / size)


def _luma(frame: Frame, moving: Tensor, kind: str, color: Tensor) -> Tensor:
    """Return luma for anti-aliasing, in a perceptual encoding (the square root), in [0, 1]."""
    true = luma(torch.where(moving, color, frame.color).clamp(0, 1)).clamp_min(1e-8).sqrt()
    if kind == "true":
        return true
    return torch.where(moving, checkerboard(true), true)


def _tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Options) -> tuple[Planes, Tensor]:
    t = (2 * (index + 1 + inputs["jitter"]) / (count + 1) - 1).clamp(-1, 1)
    (dx, dy), reach, own = vector(inputs, "w_n"), inputs["reach"], inputs["own_n"]
    if options.two_directions:
        along_center = _takes_center_direction(index, inputs, options)
        c_x, c_y = vector(inputs, "w_c")
        dx, dy = torch.where(along_center, c_x, dx), torch.where(along_center, c_y, dy)
        own = torch.where(along_center, inputs["own_c"], own)
        if options.own_length:
            reach = torch.where(along_center, inputs["length"], reach)
    along = (t + options.center) * reach
    tap = sample(inputs, inputs["x"] - along * dx, inputs["y"] - along * dy, options.color_lookup)
    weight = _weight(along, (dx, dy), tap, own, inputs, options)
    return weighted(weight, tap.color), weight if tap.valid is None else weight * tap.valid


def _takes_center_direction(index: Tensor, inputs: Inputs, options: _Options) -> Tensor:
    if options.by_variance:
        position = (index + 0.5) * _GOLDEN
        return position - position.floor() < inputs["variance"]
    return index - 2 * (index / 2).floor() == 1


def _weight(
    along: Tensor, d: Planes, tap: Tap, own: Tensor, inputs: Inputs, options: _Options
) -> Tensor:
    """Return the sum of the three weights of a tap."""
    front, behind = depth_weights(
        inputs["depth"],
        tap.depth,
        inputs["extent"],
        relative=options.relative_depth,
        level=inputs["depth_level"],
        softness=options.softness,
    )
    dx, dy = d
    length_s, length_p = torch.maximum(tap.length, inputs["min_length"]), inputs["length_p"]
    toward = tap.unit_x * dx + tap.unit_y * dy
    distance_s = distance_p = distance = along.abs()
    if options.center:
        half_x, half_y = vector(inputs, "half")
        moved_p = half_x * dx + half_y * dy
        distance_s = (along - options.center * tap.length * toward).abs()
        distance_p = (along - options.center * moved_p).abs()
        distance = torch.where(length_s <= length_p, distance_s, distance_p)
    slope, soft = inputs["cone_slope"], options.softness
    exponent = None if options.linear_cone else inputs["cone_exponent"]
    first = inputs["foreground_gain"] * front * cone(distance_s, length_s, slope, exponent, soft)
    second = inputs["background_gain"] * behind * cone(distance_p, length_p, slope, exponent, soft)
    third = inputs["third_gain"] * cylinder(
        distance,
        torch.minimum(length_s, length_p),
        inputs["cylinder_inner"],
        inputs["cylinder_outer"],
    )
    if not options.direction_weights:
        total: Tensor = first + second + third
        return total
    theirs = toward.abs()
    if not options.linear_direction:
        theirs = power(theirs, inputs["direction_exponent"])
    directed: Tensor = first * theirs + second * own + third * torch.maximum(own, theirs)
    return directed
