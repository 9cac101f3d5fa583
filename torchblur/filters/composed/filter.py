"""The published filters in one: every part of theirs is a parameter, and they are sets of them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.composed.config import ComposedConfig
from torchblur.filters.composed.taps import (
    TAP_PARAMETERS,
    TapOptions,
    alternate_tap,
    pair_tap,
    tap_options,
)
from torchblur.filters.guertin2014.filter import center_direction
from torchblur.filters.notes2025.gather import Line
from torchblur.filters.notes2025.post_filter import post_filter
from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import TWO_SUMS, Cost, even, gather, with_background
from torchblur.filters.parts.cost import post_filter as post_filter_cost
from torchblur.filters.parts.edges import clean_edges, half_spreads
from torchblur.filters.parts.front_back import Blurred, Sums, compose, over_nothing, tap_inputs
from torchblur.filters.parts.front_back_config import motion_cost, num_ways
from torchblur.filters.parts.moving import least_spread, moving_pixels, packed_values, tile_planes
from torchblur.filters.parts.places import SHORTEST_REACH, num_pairs
from torchblur.filters.parts.reach import Gather, ReachingBlur, by_length, tap_counts
from torchblur.filters.parts.reconstruction import color_from, resolve, texture_of
from torchblur.filters.parts.revealed import revealed_inputs
from torchblur.filters.parts.spreads import Spread
from torchblur.frame import Frame
from torchblur.ops.gather import Engine, Inputs, components, gather_lists
from torchblur.ops.pixels import PixelList
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import power, saturate

__all__ = ["ComposedBlur", "ComposedConfig", "composed"]


def composed(frame: Frame, config: ComposedConfig | None = None, **params: Any) -> Tensor:
    """Blur with the space of the published filters: each is a set of this one's parameters.

    The weight of a tap is depth × spread × direction, each in the forms that the texts have, plus
    the third weight of McGuire 2012 or Guertin 2014. Taps take one direction by turns (`sampling`
    "alternate") or lie in pairs on both sides of the pixel in each direction ("pairs"), and
    `resolve` has three ways to make a color of the sums. `composed.cases.special_case` gives the
    parameters with which this filter is a published one; what lies between them can be fitted.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity through the weights and through the
        positions of lookups that are not nearest, and in every parameter that `torchblur params`
        calls smooth.
    Border: replicated.
    Reference: McGuire 2012, Guertin 2014, Jimenez 2014 and the 2025 notes, as each parameter says;
        `edge_motion` is known from temporal anti-aliasing (Karis 2014). Not special cases: the
        second pass of Sousa 2013, which filters a result (`TwoPassBlur` does that with any filter),
        half resolution of the 2025 notes, and taps assigned by the variance of tiles (Guertin
        2014).
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = ComposedBlur(config, **params)(frame)
    return result


class ComposedBlur(ReachingBlur):
    """The published filters in one: they are sets of its parameters. See `composed`.

    `layers` adds "alpha" (the front's share; with one sum the mean weight), "output_alpha" (how
    much replaces the pixel's own color) and "weight" (the mean weight of all taps), (B, 1, H, W),
    and "primary" and "secondary" (half spread per tile in px, (B, 2, Ty, Tx)).
    """

    name = "composed"
    published = False
    config_class = ComposedConfig

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        ways, taps = num_ways(config), config.num_samples
        main = gather(taps, config.color_lookup, TWO_SUMS)
        if config.sampling == "pairs":
            lines = ways + (1 if config.double_samples else 0)
            main = gather(even(taps), config.color_lookup, TWO_SUMS) * lines
        whole = with_background(motion_cost(config) + main, config)
        return whole + post_filter_cost(config.post_samples, ways) if config.post_filter else whole

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", the alphas, "weight" and the tiles."""
        return _layers(frame, values, self.engine)


def _layers(frame: Frame, values: Values, engine: Engine) -> dict[str, Tensor]:
    seen = clean_edges(frame, values)
    spread, tiles = half_spreads(seen, values)
    pixels = moving_pixels(seen, tiles, values)
    if pixels.count == 0:
        none = torch.zeros_like(frame.color[:, :1])
        planes = dict.fromkeys(("alpha", "output_alpha", "weight"), none)
        return {"color": frame.color} | planes | tiles._asdict()
    here, local = seen.only("depth", "valid").map(pixels.pack), packed_values(values, pixels)
    motions: list[Tensor] = [*tiles]
    if values.double_samples or values.tile_classes or values.color_lookup == "opportunistic":
        motions.append(least_spread(spread.length, tiles, values))
    first, second, *least = tile_planes(seen.color, motions, pixels, values)
    first_channel, texture = color_from(seen, spread), texture_of(seen, spread)
    spread = Spread(*(pixels.pack(plane) for plane in spread))
    inputs = tap_inputs(here, texture, spread, pixels, local, TAP_PARAMETERS)
    for shortest in least:
        inputs["linear"] = (shortest >= local.bilinear_min).to(frame.dtype)
        inputs["fast"] = (shortest >= local.fast_ratio * length(first)).to(frame.dtype)
    inputs |= pixels.lists(
        revealed_inputs(frame, values, lambda f, v: _layers(f, v, engine)["color"])
    )
    moving = length(first) > local.early_out
    ways = _ways(first, second, spread, local)
    lines = _lines(ways, inputs.get("linear"), moving, local)
    sums = _gather(ways, lines, inputs, pixels, local, engine, first_channel)
    image = _resolve(here, sums, spread, moving, local).images(frame, pixels)
    if values.post_filter:
        wide = [line.image(pixels) for line in lines.values()]
        image = post_filter(frame, image, wide, values, engine)
    layers = image._asdict() | tiles._asdict()
    del layers["influence"]
    return layers


# -- taps ------------------------------------------------------------------------------------------


class _Way(NamedTuple):
    """One direction of taps, per pixel."""

    unit: Tensor
    reach: Tensor
    """Half spread that the taps cover, px, (B, 1, H, W)."""
    agrees: Tensor
    """Weight of the pixel's own direction along it, in [0, 1], (B, 1, H, W)."""

    def line(self, prefix: str = "") -> Inputs:
        """Return what taps along it need."""
        planes = {f"{prefix}reach": self.reach, f"{prefix}agrees": self.agrees}
        return components(f"{prefix}unit", self.unit) | planes


def _ways(first: Tensor, second: Tensor, spread: Spread, values: Values) -> dict[str, _Way]:
    """Return the directions that the parameters ask for by name; the pixel's own if by none."""
    tile, reach = direction(first), length(first)
    own, own_reach = spread.unit, spread.length
    if values.center_direction == "blend":
        own = center_direction(
            tile, spread, torch.maximum(spread.length, values.min_length), values
        )
    if values.tap_length == "tile":
        own_reach = reach
    along = {
        "first": (tile, reach),
        "own": (own, own_reach),
        "second": (direction(second), length(second)),
    }
    wanted = [name for name in along if vars(values)[f"{name}_direction"]] or ["own"]
    ways = {}
    for name in wanted:
        unit, far = along[name]
        against = tile if values.own_direction_against == "tile" else unit
        cosine = (own * against).sum(1, keepdim=True).abs()
        if name == "own" and values.own_direction_against == "tap":
            cosine = torch.ones_like(cosine)
        ways[name] = _Way(unit, far, power(cosine, values.direction_exponent))
    return ways


def _lines(
    ways: dict[str, _Way], linear: Tensor | None, moving: Tensor, values: Values
) -> dict[str, Line]:
    """Return where each direction is sampled, and how densely if in pairs."""
    pairs = num_pairs(values)
    lines = {}
    for number, (name, way) in enumerate(ways.items()):
        plane, most, used = torch.full_like(way.reach, float(pairs)), pairs, moving
        if values.sampling == "pairs":
            plane = tap_counts(values, way.reach, pairs)
            if number == 0 and values.double_samples and linear is not None:
                plane, most = torch.where(linear > 0, plane, 2 * plane), 2 * pairs
        if name == "second" and "first" in ways:
            cosine = (ways["first"].unit * way.unit).sum(1, keepdim=True).abs()
            apart = cosine < torch.cos(values.min_angle * (math.pi / 180))
            used = moving & apart & (way.reach > values.early_out)
        lines[name] = Line(way.unit * way.reach, used, plane, most)
    return lines


def _gather(
    ways: dict[str, _Way],
    lines: dict[str, Line],
    shared: Inputs,
    pixels: PixelList,
    values: Values,
    engine: Engine,
    first_channel: int,
) -> list[Sums]:
    """Return the means over the taps: of each line if in pairs, else of all together."""
    options = tap_options(values, tuple(ways))
    if values.sampling == "pairs":
        found = []
        for name, line in lines.items():
            reach = ways[name].reach.clamp_min(SHORTEST_REACH)
            inputs = shared | ways[name].line() | {"reach": reach, "pairs": line.pairs}
            totals = by_length(
                _pair_gather(options, line, values, engine, first_channel),
                values,
                reach,
                inputs,
                pixels,
                num_pairs(values),
                means=True,
            )
            area = values.area_slope * reach if values.accurate_alpha else None
            found.append(_means(totals, 2 * line.pairs, line, area, values))
        return found
    name, way = next(iter(ways.items()))
    line = lines[name]
    count = torch.full_like(way.reach, float(values.num_samples))
    inputs = dict(shared)
    for name, one in ways.items():
        inputs |= one.line(f"{name}_")
    totals = by_length(
        lambda taps, lists, some: gather_lists(
            alternate_tap, options, taps, lists, some, engine, color_from=first_channel
        ),
        values,
        _longest(ways, shared),
        inputs,
        pixels,
        values.num_samples,
    )
    area = values.area_slope * way.reach if values.accurate_alpha else None
    return [_means(totals, count, line, area, values)]


def _pair_gather(
    options: TapOptions, line: Line, values: Values, engine: Engine, first_channel: int
) -> Gather:
    """Return the gather of one line; pixels whose taps are doubled have twice as many pairs."""
    times = line.most_pairs // num_pairs(values)

    def gather(pairs: int, lists: Inputs, pixels: PixelList) -> tuple[Tensor, ...]:
        return gather_lists(
            pair_tap, options, pairs * times, lists, pixels, engine, color_from=first_channel
        )

    return gather


def _longest(ways: dict[str, _Way], shared: Inputs) -> Tensor:
    """Return half of the longest path among the directions and the pixel's own, px."""
    longest = shared["length"]
    for way in ways.values():
        longest = torch.maximum(longest, way.reach)
    return longest


def _means(
    totals: tuple[Tensor, ...], count: Tensor, line: Line, area: Tensor | None, values: Values
) -> Sums:
    *sums, alpha = (total / count for total in totals)
    if area is not None:
        alpha = alpha * (1 + area)
    alpha = saturate(values.alpha_gain * alpha, values.softness)
    used = line.used.to(alpha.dtype)
    return Sums(*(plane * used for plane in (*sums, alpha, torch.zeros_like(alpha))))


# -- color -----------------------------------------------------------------------------------------


def _resolve(
    frame: Frame, sums: list[Sums], spread: Spread, moving: Tensor, values: Values
) -> Blurred:
    """Return the color that the sums stand for."""
    if values.resolve == "normalized":
        return _normalized(frame, sums, spread, moving, values)
    changed: dict[str, object] = {
        "separate_sums": values.resolve == "separate",
        "center_weight": values.center_taps,
        "resolution": "full",
    }
    if values.missing_background == "foreground":
        sums = over_nothing(sums, values)
        changed["background_fade"] = 0.0
    return compose(frame, sums, moving, Values(**(vars(values) | changed)))


def _normalized(
    frame: Frame, sums: list[Sums], spread: Spread, moving: Tensor, values: Values
) -> Blurred:
    total = Sums(*(torch.stack(planes).sum(0) for planes in zip(*sums, strict=True)))
    center = values.center_taps / values.num_samples
    if values.center_weight:
        center = center + 1 / (values.kappa * torch.maximum(spread.length, values.min_length))
    color, weight = resolve(
        frame,
        (total.background_color + total.foreground_color, total.background + total.foreground),
        center,
        moving,
    )
    alpha = torch.where(moving, (total.background + total.foreground).clamp(max=1), 0.0)
    return Blurred(color, alpha, moving.to(alpha.dtype), weight, torch.zeros_like(alpha))
