"""Jimenez 2014: the motion blur of Call of Duty: Advanced Warfare."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.jimenez2014.config import Jimenez2014Config
from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import Cost, even, gather, tiles, with_background
from torchblur.filters.parts.moving import (
    Filtered,
    Moving,
    Stray,
    least_spread,
    moving_part,
    revealed_part,
)
from torchblur.filters.parts.places import SHORTEST_REACH, num_pairs, tap_shift, tile_noise
from torchblur.filters.parts.reach import ReachingBlur, by_length, code_range
from torchblur.filters.parts.reconstruction import Tap, sample
from torchblur.filters.parts.spreads import pixel_spread, tiles_of
from torchblur.frame import Frame, Shutter
from torchblur.ops.gather import (
    Engine,
    Inputs,
    Lookup,
    Planes,
    components,
    gather_some,
    vector,
    weighted,
)
from torchblur.ops.pixels import PixelList
from torchblur.ops.spread import Mirror, SpreadForm, TapPair, depth_shares, mirror, spread_weight
from torchblur.ops.tiles import tile_lookup
from torchblur.ops.velocity import direction, length, quantize_uint8

__all__ = ["Jimenez2014Blur", "Jimenez2014Config", "jimenez2014"]


class _Options(NamedTuple):
    center: int
    relative_depth: bool
    spread_form: SpreadForm
    mirror: Mirror
    softness: float
    color_lookup: Lookup


def jimenez2014(frame: Frame, config: Jimenez2014Config | None = None, **params: Any) -> Tensor:
    """Blur with the filter of Jimenez 2014.

    Taps lie in pairs on the dominant velocity of the neighborhood of tiles, ``o = i + ½`` steps
    to both sides of the pixel. The weight of a tap is

    ``bg · sat(a s_p − o + 1) + fg · sat(a s_S − o + 1)``,  ``bg = sat(½ + κ_d (Z_S − Z_p))``

    with ``fg = 1 − bg``, half spreads s and a steps per px. The mirror filter copies the weight
    of the nearer and faster tap of a pair to the other. The mean of ``weight · (color, 1)`` over
    all taps is a color with an alpha; what is missing to 1 is the pixel's own color.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity through the weights (not through the
        positions of nearest lookups), and in every parameter that `torchblur params` calls
        smooth. Tile classes and the mirror filter choose by thresholds, which have no gradient.
    Border: replicated.
    Reference: Jimenez 2014, "Next Generation Post Processing in Call of Duty: Advanced Warfare";
        the slides are not public, the formulas are those on which public ports agree. We differ:
        the tile lookup is jittered along one axis and near edges only; pixels, not tiles, have a
        class, that of the tile that they look up; the fast one asks for more than the ports do
        (with their 1/4 what moves another way is blurred wrongly); shutters that are not
        centered shift the taps along the velocity.
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = Jimenez2014Blur(config, **params)(frame)
    return result


class Jimenez2014Blur(ReachingBlur):
    """The filter of Jimenez 2014: tile classes, mirrored pairs of taps, center fill.

    See `jimenez2014` for the formula. `layers` adds "alpha" (the mean weight in [0, 1],
    (B, 1, H, W)), "tile_class" (0 static, 1 fast, 2 full, per pixel as the jittered lookup saw
    it, (B, 1, H, W)), "tile_max" and "neighbor_max" (half spread in px, (B, 2, Ty, Tx)), and
    "tile_min" (shortest half spread of the 3x3 tiles in px, (B, 1, Ty, Tx)).
    """

    name = "jimenez2014"
    config_class = Jimenez2014Config
    per_frame = ("shutter", "early_out", "fast_ratio", "tile_jitter")

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        taps = even(config.num_samples)
        return with_background(
            tiles(config.tile_size, 2) + gather(taps, config.color_lookup), config
        )

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", "alpha", "tile_class" and the tiles."""
        return _filtered(frame, values, self.engine).layers(frame)

    def color(self, frame: Frame, values: Values) -> Tensor:
        """Return the blurred color alone, (B, 3, H, W)."""
        return _filtered(frame, values, self.engine).color(frame)


def _filtered(frame: Frame, values: Values, engine: Engine) -> Filtered:
    own, around = tiles_of(frame, values, cull=values.neighbor_culling)
    if values.tile_encoding == "uint8":
        own, around = (quantize_uint8(tile, code_range(values)) for tile in (own, around))
    shortest = least_spread(pixel_spread(frame, values).length, (around,), values)
    tiles = {"tile_max": own, "neighbor_max": around, "tile_min": shortest}
    part = moving_part(frame, values, around, stray=Stray(tile_noise(values), values.tile_jitter))
    if part is None:
        return Filtered.still(frame, tiles, "alpha", "tile_class")
    inputs, tile_class = _tap_inputs(part, shortest)
    inputs |= revealed_part(frame, values, part, lambda f, v: _filtered(f, v, engine).color(f))
    options = _Options(
        Shutter(1, values.shutter_position).center,
        values.depth_compare == "relative",
        values.spread_compare,
        values.mirror_filter,
        values.softness,
        values.color_lookup,
    )
    pairs = num_pairs(values)
    sums = by_length(
        lambda count, lists, pixels: _sums(part, options, count, lists, pixels, engine),
        values,
        inputs["reach"],
        inputs | {"tile_class": tile_class},
        part.pixels,
        pairs,
    )
    color, alpha = (total / (2 * pairs) for total in sums)
    lists = {
        "color": torch.where(tile_class > 0, _fill(part.frame, color, alpha), part.frame.color),
        "alpha": torch.where(tile_class > 0, alpha, 0.0),
        "tile_class": tile_class,
    }
    return Filtered(tiles, part.pixels, lists)


def _sums(
    part: Moving, options: _Options, pairs: int, inputs: Inputs, pixels: PixelList, engine: Engine
) -> tuple[Tensor, Tensor]:
    """Return sums of color and weight: of weighed taps in the full class, of plain in the fast.

    Args:
        part: The part of the frame that moves.
        options: Of the taps.
        pairs: Number of pairs.
        inputs: Of the taps, as lists of some pixels, and "tile_class".
        pixels: Those.
        engine: Of the gathers.
    """
    tile_class = inputs["tile_class"]
    inputs = {name: plane for name, plane in inputs.items() if name != "tile_class"}
    kinds = [(2, _pair)] + ([(1, _plain_pair)] if part.values.tile_classes else [])
    found = [
        gather_some(
            tap,
            options,
            pairs,
            inputs,
            pixels,
            tile_class == number,
            engine,
            color_from=part.color_from,
        )
        for number, tap in kinds
    ]
    color, alpha = (sum(sums[1:], sums[0]) for sums in zip(*found, strict=True))
    return color, alpha


def _tile_class(longest: Tensor, shortest: Tensor, values: Values) -> Tensor:
    """Return 0 where nothing moves, 1 where all moves alike, else 2, (B, 1, H, W)."""
    static = longest <= values.early_out
    fast = shortest >= values.fast_ratio * longest
    if not values.tile_classes:
        fast = torch.zeros_like(fast)
    return torch.where(static, 0.0, torch.where(fast, 1.0, 2.0)).to(longest.dtype)


def _tap_inputs(part: Moving, shortest: Tensor) -> tuple[Inputs, Tensor]:
    """Return what the taps look at, and the class of each pixel's tile."""
    color, values, pixels = part.frame.color, part.values, part.pixels
    least = tile_lookup(shortest, color, values.tile_size, part.tile_shift, pixels=pixels)
    reach = length(part.dominant)
    tile_class = _tile_class(reach, least, values)
    x, y = part.grid()
    inputs = {
        "texture": part.texture,
        "x": x,
        "y": y,
        "shift": tap_shift(color, values, pixels),
        **components("direction", direction(part.dominant)),
        "reach": reach.clamp_min(SHORTEST_REACH),
        "depth": part.frame.finite_depth(),
        **components("half", part.spread.half),
        "length": part.spread.length,
    }
    for key in ("depth_scale", "depth_level", "spread_offset", "spread_slope"):
        inputs[key] = getattr(values, key)
    return inputs, tile_class


def _fill(frame: Frame, color: Tensor, alpha: Tensor) -> Tensor:
    """Fill with the pixel's own color what alpha leaves; where that is invalid, normalize."""
    filled = color + (1 - alpha) * frame.color
    if frame.valid is None:
        return filled
    alone = ~frame.valid & (alpha > 0)
    return torch.where(alone, color / torch.where(alone, alpha, 1.0), filled)


def _pair(index: Tensor, count: Tensor, inputs: Inputs, options: _Options) -> tuple[Planes, Tensor]:
    times = _times(index, count, inputs)
    (one, one_weight), (other, other_weight) = (_tap(t, count, inputs, options) for t in times)
    taps = one, other
    (later,), (earlier,) = mirror(
        ((one_weight,), (other_weight,)),
        TapPair(one.depth, other.depth),
        TapPair(one.length, other.length),
        options.mirror,
    )
    weights = later, earlier
    colors = (weighted(w, tap.color) for w, tap in zip(weights, taps, strict=True))
    totals = (w if t.valid is None else w * t.valid for w, t in zip(weights, taps, strict=True))
    return tuple(a + b for a, b in zip(*colors, strict=True)), torch.add(*totals)


def _plain_pair(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Planes, Tensor]:
    """Return color and weight of two taps that count alike, whatever their depth and motion."""
    taps = [_look(time, inputs, options)[0] for time in _times(index, count, inputs)]
    ones = torch.ones_like(taps[0].length)
    totals = (ones if tap.valid is None else tap.valid for tap in taps)
    colors = (tap.color for tap in taps)
    return tuple(a + b for a, b in zip(*colors, strict=True)), torch.add(*totals)


def _times(index: Tensor, count: Tensor, inputs: Inputs) -> TapPair:
    """Return when a pair of taps lies, in units of the reach."""
    step = (index + 0.5) / count
    shift = inputs["shift"] / count
    return TapPair(*((side * step + shift).clamp(-1, 1) for side in (1, -1)))


def _look(time: Tensor, inputs: Inputs, options: _Options) -> tuple[Tap, Tensor]:
    """Return what lies at a time, and how far along the tile's motion that is, px."""
    along = (time + options.center) * inputs["reach"]
    dx, dy = vector(inputs, "direction")
    x, y = inputs["x"] - along * dx, inputs["y"] - along * dy
    return sample(inputs, x, y, options.color_lookup), along


def _tap(t: Tensor, count: Tensor, inputs: Inputs, options: _Options) -> tuple[Tap, Tensor]:
    """Return what lies at time t, in units of the reach, and its weight."""
    tap, along = _look(t, inputs, options)
    dx, dy = vector(inputs, "direction")
    distance_s = distance_p = along.abs()
    if options.center:
        half_x, half_y = vector(inputs, "half")
        moved_p = half_x * dx + half_y * dy
        moved_s = tap.length * (tap.unit_x * dx + tap.unit_y * dy)
        distance_p = (along - options.center * moved_p).abs()
        distance_s = (along - options.center * moved_s).abs()
    share = depth_shares(
        inputs["depth"],
        tap.depth,
        inputs["depth_scale"],
        level=inputs["depth_level"],
        relative=options.relative_depth,
        softness=options.softness,
    )
    per_px = count / inputs["reach"]
    weight = share.background * _spread_weight(
        distance_p, inputs["length"], per_px, inputs, options
    )
    weight = weight + share.foreground * _spread_weight(
        distance_s, tap.length, per_px, inputs, options
    )
    return tap, weight


def _spread_weight(
    distance: Tensor, size: Tensor, per_px: Tensor, inputs: Inputs, options: _Options
) -> Tensor:
    return spread_weight(
        distance * per_px,
        size * per_px,
        offset=inputs["spread_offset"],
        slope=inputs["spread_slope"],
        form=options.spread_form,
        softness=options.softness,
    )
