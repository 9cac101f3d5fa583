"""The 2025 notes on motion blur rendering: Jimenez 2014 with two directions and a post-filter."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchblur.configured import batch_size_of
from torchblur.filters.notes2025.config import Notes2025Config
from torchblur.filters.notes2025.gather import SHARED_PARAMETERS, Line, gather_line, shared_inputs
from torchblur.filters.notes2025.post_filter import post_filter
from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import (
    TWO_SUMS,
    WEIGHTS,
    Cost,
    even,
    gather,
    tiles,
    with_background,
)
from torchblur.filters.parts.cost import post_filter as post_filter_cost
from torchblur.filters.parts.front_back import Blurred, compose
from torchblur.filters.parts.moving import (
    least_spread,
    moving_among,
    moving_pixels,
    packed_values,
    tile_planes,
)
from torchblur.filters.parts.places import num_pairs
from torchblur.filters.parts.reach import ReachingBlur, code_range, longest_spread, tap_counts
from torchblur.filters.parts.reconstruction import color_from
from torchblur.filters.parts.revealed import layer_behind, revealed_inputs
from torchblur.filters.parts.spreads import Spread, exact_spread, tile_motions
from torchblur.frame import Frame
from torchblur.ops.directions import TileDirections
from torchblur.ops.gather import Engine
from torchblur.ops.pixels import PixelList, select
from torchblur.ops.resample import HalfImage, UpsampleRules, box_halve, depth_halve, upsample_over
from torchblur.ops.velocity import clamp_length, direction, half_velocity, length, quantize_uint8
from torchblur.params import declared

__all__ = ["Notes2025Blur", "Notes2025Config", "notes2025"]


def notes2025(frame: Frame, config: Notes2025Config | None = None, **params: Any) -> Tensor:
    """Blur with the filter of the 2025 notes.

    Along the dominant velocity of the tiles, and along a second direction that differs from it,
    pairs of taps are weighted by depth, by spread and by direction. Foreground and background
    are summed apart, ``lerp(bg, fg, max(α₁, α₂))``. Each foreground sample spreads its alpha over
    ``1 + 2V`` px. A post-filter then fills the gaps between the taps. All of this may run at half
    resolution; where the background is sharp, it is kept at full resolution.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity through the weights (not through the
        positions of nearest lookups), and in every parameter that `torchblur params` calls
        smooth. Tiles, the mirror filter and the hard thresholds of the post-filter choose, which
        has no gradient.
    Border: replicated.
    Reference: "Notes On Motion Blur Rendering", 9 December 2025. We differ where the text leaves
        a gap: depth ranges are guesses; the spread weight gives static pixels no background, or
        the half resolution would never keep a sharp one; the second direction is reduced exactly
        unless asked otherwise; with one sum for both (not `separate_sums`) two directions share
        it; the alpha fade works in full-resolution px; taps and center of the post-filter; the
        fast class of tiles is off unless asked for (`tile_classes`), as it gains little here (it
        saves at most a sixth), and asks for one direction of motion, too; shutters that are not
        centered shift the taps along the velocity.
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = Notes2025Blur(config, **params)(frame)
    return result


class Notes2025Blur(ReachingBlur):
    """The filter of the 2025 notes; every section of the text is a switch. See `notes2025`.

    `layers` adds "alpha" (the foreground's) and "output_alpha" (how much of the result replaces
    the sharp color: at full resolution, after upsampling), "weight" (the larger of the mean
    weights along the two directions) and "influence" (the longest half spread that took part,
    px), all (B, 1, ·, ·), and "primary" and "secondary" (half spread per tile in px,
    (B, 2, Ty, Tx)). With `resolution` "half" these but "output_alpha" have half the size and
    px are half-resolution px; "half_color" and "half_alpha" are what was upsampled.
    """

    name = "notes2025"
    config_class = Notes2025Config
    per_frame = tuple(
        name
        for name, spec in declared(Notes2025Config).items()
        if spec.grad != "discrete" and name not in SHARED_PARAMETERS
    )

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        lines, full = 1 if config.directions == "one" else 2, config.resolution == "full"
        size = config.tile_size if full else (config.tile_size + 1) // 2
        taps = even(config.num_samples)
        main = gather(taps * (2 if config.double_samples else 1), config.color_lookup, TWO_SUMS)
        main += gather(taps, config.color_lookup, TWO_SUMS) * (lines - 1)
        whole = with_background(main + tiles(size, 1 + lines), config)
        if config.post_filter:
            whole += post_filter_cost(config.post_samples, lines)
        if full:
            return whole
        # Down: 2x2 pixels of color, motion and depth, once for four. Up: four small ones and their
        # depth around each pixel.
        return whole * 0.25 + Cost(lookups=2, passes=0.25) + Cost(4, 8, 4 * WEIGHTS, passes=1)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", the alphas, "weight", "influence" and the tiles."""
        if values.resolution == "half":
            frame = frame.expand(batch_size_of(values, frame.batch_size))
            return _half_layers(frame, values, self.engine)
        return _layers(frame, values, self.engine)


def _layers(frame: Frame, values: Values, engine: Engine) -> dict[str, Tensor]:
    spread, tiles = _motion(frame, values)
    pixels, planes = _moving(frame, spread, tiles, values)
    if pixels.count == 0:
        none = torch.zeros_like(frame.color[:, :1])
        return Blurred(frame.color, none, none, none, none)._asdict() | tiles._asdict()
    here, local = frame.only("depth", "valid").map(pixels.pack), packed_values(values, pixels)
    first, second, least = planes
    linear = least >= local.bilinear_min
    lines = _lines(first, second, least, local)
    shared = shared_inputs(frame, spread, linear, pixels, local)
    shared |= pixels.lists(revealed_inputs(frame, values, lambda f, v: _whole(f, v, engine)))
    first_channel = color_from(frame, spread)
    sums = [gather_line(shared, line, local, engine, pixels, first_channel) for line in lines]
    blurred = compose(here, sums, lines[0].used, local)
    if values.resolution == "half" and values.alpha_fade:
        blurred = _faded(blurred, local)
    image = blurred.images(frame, pixels)
    if values.post_filter:
        image = post_filter(frame, image, [line.image(pixels) for line in lines], values, engine)
    return image._asdict() | tiles._asdict()


def _moving(
    frame: Frame, spread: Spread, tiles: TileDirections, values: Values
) -> tuple[PixelList, list[Tensor]]:
    """Return the pixels whose tile moves; both motions and the `least_spread` of the tile."""
    pixels = moving_pixels(frame, tiles, values)
    if pixels.count == 0:
        return pixels, []
    least = least_spread(spread.length, tiles, values)
    planes = tile_planes(frame.color, (*tiles, least), pixels, values)
    chosen = moving_among(planes[0], pixels.pack(values.early_out))
    if chosen is None:
        return pixels, planes
    return pixels.some(chosen), [select(plane, chosen) for plane in planes]


def _with(values: Values, **changed: object) -> Values:
    return Values(**(vars(values) | changed))


def _whole(frame: Frame, values: Values, engine: Engine) -> Tensor:
    """Return the blurred color alone, over the sharp one also where that is left for later."""
    return _layers(frame, _with(values, resolution="full", post_filter=False), engine)["color"]


def _motion(frame: Frame, values: Values) -> tuple[Spread, TileDirections]:
    """Return half spreads per pixel, and both directions per tile.

    Tiles choose by the length before it is clamped: clamped vectors are all equally long, and
    rounding would choose among them.
    """
    size = code_range(values)
    longest = longest_spread(values)
    whole = half_velocity(frame.velocity, values.shutter)
    half = clamp_length(whole, longest)
    if values.velocity_encoding == "uint8":
        whole = half = quantize_uint8(half, size)
    tiles = tile_motions(whole, values, two=values.directions == "two")
    tiles = TileDirections(*(clamp_length(tile, longest) for tile in tiles))
    return exact_spread(half), tiles


def _lines(first: Tensor, second: Tensor, least: Tensor, values: Values) -> list[Line]:
    """Return the directions that are sampled, how densely, and where taps need no weights."""
    pairs = num_pairs(values)
    plane = tap_counts(values, length(first), pairs)
    moving, alike = length(first) > values.early_out, least >= values.fast_ratio * length(first)
    doubled, most = plane, pairs
    if values.double_samples:
        linear = least >= values.bilinear_min
        doubled, most = torch.where(linear, plane, 2 * plane), 2 * pairs
    others = []
    if values.directions == "two":
        unit = direction(first) * direction(second)
        cosine = unit.sum(1, keepdim=True).abs()
        apart = cosine < torch.cos(values.min_angle * (math.pi / 180))
        used = moving & apart & (length(second) > values.early_out)
        other = tap_counts(values, length(second), pairs)
        others, alike = [Line(second, used, other, pairs)], alike & ~used
    return [Line(first, moving, doubled, most, alike if values.tile_classes else None), *others]


# -- half resolution -------------------------------------------------------------------------------


def _half_layers(frame: Frame, values: Values, engine: Engine) -> dict[str, Tensor]:
    small_values = _halved(frame, values)
    small = _half_frame(frame, small_values)
    layers = _layers(small, small_values, engine)
    layers["half_color"], layers["half_alpha"] = layers["color"], layers["output_alpha"]
    rules = UpsampleRules(
        values.upsample_depth_range,
        values.depth_compare == "relative",
        values.upsample_depth_weights,
        values.alpha_weighted_color,
        values.corner_fallback,
    )
    half = HalfImage(layers["half_color"], layers["half_alpha"], small.require("depth"))
    layers["color"], layers["output_alpha"] = upsample_over(
        frame.color, frame.finite_depth(), half, rules
    )
    return layers


def _halved(frame: Frame, values: Values) -> Values:
    """Return the parameters for half the size; what is given per pixel is averaged."""
    small = {
        key: box_halve(value)
        if isinstance(value, Tensor) and value.ndim == 4 and value.shape[-2:] == frame.size
        else value
        for key, value in vars(values).items()
    }
    small["tile_size"] = (values.tile_size + 1) // 2
    for name in ("early_out", "max_reach", "tap_spacing"):
        small[name] = small[name] / 2
    return Values(**small)


def _half_frame(frame: Frame, values: Values) -> Frame:
    """Return the frame at half the size: plain color, motion and depth of what is nearest."""
    depth = frame.finite_depth()
    planes = depth_halve(
        torch.cat((frame.velocity / 2, depth), 1),
        depth,
        values.downsample_depth_range,
        relative=values.depth_compare == "relative",
    )
    color, valid = box_halve(frame.color), None
    if frame.valid is not None:
        share = box_halve(frame.valid.to(frame.dtype))
        color = box_halve(frame.color * frame.valid.to(frame.dtype))
        color = color / torch.where(share > 0, share, 1.0)
        valid = share > 0
    layer = None
    if values.background == "revealed":
        layer = _half_frame(layer_behind(frame)[0], _with(values, background="guessed"))
    return Frame(
        color=color, velocity=planes[:, :2], depth=planes[:, 2:], valid=valid, revealed=layer
    )


def _faded(image: Blurred, values: Values) -> Blurred:
    """Fade the output alpha where all motion is shorter than a half-resolution pixel."""
    full_px = 2 * image.influence
    t = ((full_px - values.fade_start) / (values.fade_end - values.fade_start)).clamp(0, 1)
    factor = values.fade_min_alpha + (1 - values.fade_min_alpha) * t
    return image._replace(output_alpha=image.output_alpha * factor)
