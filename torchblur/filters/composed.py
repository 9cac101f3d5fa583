"""torchblur's own filter: the parts of the published ones, and samples that arrive on time."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.composed_config import ComposedConfig
from torchblur.filters.composed_gather import (
    TapOptions,
    alternate_tap,
    pair_tap,
    shared_inputs,
    tap_options,
)
from torchblur.filters.composed_motion import clean_edges, half_spreads
from torchblur.filters.composed_times import fill_hidden, time_tap
from torchblur.filters.guertin2014 import center_direction
from torchblur.filters.moving import least_spread, moving_pixels, packed_values, tile_planes
from torchblur.filters.notes2025_gather import Blurred, Line, Sums, compose
from torchblur.filters.notes2025_postfilter import post_filter
from torchblur.filters.places import SHORTEST_REACH, num_pairs
from torchblur.filters.reach import Gather, ReachingBlur, by_length, tap_counts
from torchblur.filters.reconstruction import color_from, resolve, texture_of
from torchblur.filters.revealed import revealed_inputs
from torchblur.filters.spreads import Spread
from torchblur.frame import Frame
from torchblur.ops.gather import Engine, Inputs, components, gather_lists
from torchblur.ops.pixels import PixelList
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import power, saturate

__all__ = ["ComposedBlur", "ComposedConfig", "composed"]
_TRACE = 1e-6  # weight per tap


def composed(frame: Frame, config: ComposedConfig | None = None, **params: Any) -> Tensor:
    """Blur with torchblur's own filter, whose special cases are published ones.

    The taps are times. At time t four samples compete for a pixel at x: those that the tile's
    dominant motion, the same reversed, its second motion and the pixel's own would bring there,
    ``S = x − t v``. Each then follows the motion that it finds there instead (`refinements`). Its
    match says whether it arrives on time, and the nearer hide the others:

    ``m = sat(1 − |V_S − v| |t| / (match_tolerance + match_slope |v t|))``,
    ``w_k = m_k Π_j (1 − m_j f_kj)``,  ``f_kj = 1 − sat(level + (Z_j − Z_k) / extent)``.

    The front's share of this time is ``c = 1 − Π (1 − m_k)``, its color ``Σ w_k C_k / Σ w_k``, or
    with `arrivals` "winner" the color of the greatest w_k, which takes one lookup. Where nothing
    arrives, a surface has left the pixel and lets the back through: the tap on the pixel's own
    line, as far as it lies behind. With ``α = Σ c / N`` the result is
    ``α front + (1 − α) back``, each normalized; without a back it is the front alone. Times at
    which something nearer hides that line are filled with what passes the pixel and is not in
    front of it (`hidden_times`).

    With `sampling` "alternate" and "pairs" taps have the published weights in place of matches,
    depth × spread × direction, and `resolve` has three ways to make a color of the sums.
    `composed_cases.special_case` gives the parameters with which this filter is another one.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity (through the matches and through the
        positions of the color lookups; motion and depth are looked up at the nearest pixel), and
        in every parameter that `torchblur params` calls smooth.
    Border: replicated.
    Reference: torchblur. Parts of McGuire 2012, Guertin 2014, Jimenez 2014 and the 2025 notes, as
        each parameter says; following the motion that a tap finds is the fixed-point iteration of
        Bowles et al. 2012 (Iterative Image Warping); `edge_motion` is known from temporal
        anti-aliasing (Karis 2014). Not special cases: the second pass of Sousa 2013, which filters
        a result (`TwoPassBlur` does that with any filter), half resolution of the 2025 notes, and
        taps assigned by the variance of tiles (Guertin 2014).
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = ComposedBlur(config, **params)(frame)
    return result


class ComposedBlur(ReachingBlur):
    """torchblur's own filter; the published ones are sets of its parameters. See `composed`.

    `layers` adds "alpha" (the front's share; with one sum the mean weight), "output_alpha" (how
    much replaces the pixel's own color) and "weight" (the mean weight of all taps), (B, 1, H, W),
    and "primary" and "secondary" (half spread per tile in px, (B, 2, Ty, Tx)).
    """

    name = "torchblur"
    published = False
    config_class = ComposedConfig

    def engine_for(self, pixels: float) -> Engine:
        """Return the engine that suits an amount of work: "auto" is the eager one.

        The backward of taps that are times takes minutes to compile.

        Args:
            pixels: Of all calls together.
        """
        return self.engine

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
    inputs = shared_inputs(here, texture_of(seen, spread), pixels, local)
    first_channel = color_from(seen, spread)
    spread = Spread(*(pixels.pack(plane) for plane in spread))
    inputs |= components("half", spread.half) | {"length": spread.length}
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
    vector: Tensor
    """Half spread that a sample must have, px, (B, 2, H, W)."""

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
        "first": (tile, reach, first),
        "own": (own, own_reach, spread.half),
        "second": (direction(second), length(second), second),
        "reversed": (-tile, reach, -first),
    }
    wanted = [name for name in along if vars(values)[f"{name}_direction"]] or ["own"]
    if values.sampling != "times":  # the others look to both sides anyway
        wanted = [name for name in wanted if name != "reversed"] or ["own"]
    ways = {}
    for name in wanted:
        unit, far, vector = along[name]
        against = tile if values.own_direction_against == "tile" else unit
        cosine = (own * against).sum(1, keepdim=True).abs()
        if name == "own" and values.own_direction_against == "tap":
            cosine = torch.ones_like(cosine)
        ways[name] = _Way(unit, far, power(cosine, values.direction_exponent), vector)
    return ways


def _lines(
    ways: dict[str, _Way], linear: Tensor | None, moving: Tensor, values: Values
) -> dict[str, Line]:
    """Return where each direction is sampled, and how densely if in pairs."""
    pairs = num_pairs(values)
    lines = {}
    if len(ways) > 1:
        ways = {name: way for name, way in ways.items() if name != "reversed"}
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
    inputs, timed = dict(shared), values.sampling == "times"
    for name, one in ways.items():
        inputs |= components(f"{name}_vector", one.vector) if timed else one.line(f"{name}_")
    tap = time_tap if timed else alternate_tap
    totals = by_length(
        lambda taps, lists, some: gather_lists(
            tap, options, taps, lists, some, engine, color_from=first_channel
        ),
        values,
        _longest(ways, shared),
        inputs,
        pixels,
        values.num_samples,
    )
    if options.fill_hidden and timed:
        totals = (*fill_hidden(totals[0], totals[1], values.background_gain), *totals[2:])
    spreads = values.accurate_alpha and values.sampling == "alternate"
    area = values.area_slope * way.reach if spreads else None
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
        longest = torch.maximum(longest, length(way.vector))
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
        sums = _over_nothing(sums, values)
        changed["background_fade"] = 0.0
    return compose(frame, sums, moving, Values(**(vars(values) | changed)))


def _over_nothing(sums: list[Sums], values: Values) -> list[Sums]:
    """Return the sums with the front opaque where there is no back."""
    background = torch.stack([one.background for one in sums]).sum(0)
    # Rounding leaves a trace of a back where something arrives at every time.
    shown = (background > _TRACE).to(background.dtype)
    if values.background_fade > 0:
        shown = saturate(background / values.background_fade, values.softness)
    return [one._replace(alpha=1 - (1 - one.alpha) * shown) for one in sums]


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
