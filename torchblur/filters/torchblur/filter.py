"""torchblur's own filter: taps are times, and samples that arrive then compete."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import WEIGHTS, Cost, color_lookup, with_background
from torchblur.filters.parts.edges import clean_edges, half_spreads
from torchblur.filters.parts.front_back import Blurred, Sums, compose, over_nothing, tap_inputs
from torchblur.filters.parts.front_back_config import motion_cost, num_ways
from torchblur.filters.parts.moving import moving_pixels, packed_values, tile_planes
from torchblur.filters.parts.reach import ReachingBlur, by_length
from torchblur.filters.parts.reconstruction import color_from, texture_of
from torchblur.filters.parts.revealed import revealed_inputs
from torchblur.filters.parts.spreads import Spread
from torchblur.filters.torchblur.config import TorchblurConfig
from torchblur.filters.torchblur.taps import TimeOptions, fill_hidden, time_tap
from torchblur.frame import Frame, Shutter
from torchblur.ops.directions import TileDirections
from torchblur.ops.gather import Engine, components, gather_lists
from torchblur.ops.velocity import length
from torchblur.ops.weights import saturate

__all__ = ["TorchblurBlur", "TorchblurConfig", "torchblur"]

_TAP_PARAMETERS = ("background_gain", "depth_level", "match_tolerance", "match_slope")

_ONE_LINE = {"separate_sums": True, "alpha_combination": "max", "resolution": "full"}
"""What `compose` asks that this filter has no choice in."""


def torchblur(frame: Frame, config: TorchblurConfig | None = None, **params: Any) -> Tensor:
    """Blur with torchblur's own filter.

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
    Reference: torchblur. Tiles are those of McGuire 2012, the second motion and front over back
        those of the 2025 notes; following the motion that a tap finds is the fixed-point iteration
        of Bowles et al. 2012 (Iterative Image Warping); `edge_motion` is known from temporal
        anti-aliasing (Karis 2014).
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = TorchblurBlur(config, **params)(frame)
    return result


class TorchblurBlur(ReachingBlur):
    """torchblur's own filter, the default. See `torchblur`.

    `layers` adds "alpha" (the front's share), "output_alpha" (how much replaces the pixel's own
    color) and "weight" (the mean weight of all taps), (B, 1, H, W), and "primary" and "secondary"
    (half spread per tile in px, (B, 2, Ty, Tx)).
    """

    name = "torchblur"
    published = False
    config_class = TorchblurConfig

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        # At each time a sample of each direction, which is followed, and one on the pixel's line.
        ways, taps = num_ways(config), config.num_samples
        samples = taps * (ways + 1)
        looks = samples * (color_lookup(config.color_lookup) + 1) + taps * ways * config.refinements
        main = Cost(samples, looks, samples * WEIGHTS, passes=1)
        return with_background(motion_cost(config) + main, config)

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
    motions = TileDirections(*tile_planes(seen.color, tiles, pixels, values))
    first_channel, texture = color_from(seen, spread), texture_of(seen, spread)
    spread = Spread(*(pixels.pack(plane) for plane in spread))
    inputs = tap_inputs(here, texture, spread, pixels, local, _TAP_PARAMETERS)
    inputs |= pixels.lists(
        revealed_inputs(frame, values, lambda f, v: _layers(f, v, engine)["color"])
    )
    ways = _ways(motions, spread, values)
    longest = spread.length
    for name, way in ways.items():
        inputs |= components(f"{name}_vector", way)
        longest = torch.maximum(longest, length(way))
    options = _options(values, tuple(ways))
    totals = by_length(
        lambda taps, lists, some: gather_lists(
            time_tap, options, taps, lists, some, engine, color_from=first_channel
        ),
        local,
        longest,
        inputs,
        pixels,
        values.num_samples,
    )
    moving = length(motions.primary) > local.early_out
    image = _resolve(here, totals, moving, local).images(frame, pixels)
    layers = image._asdict() | tiles._asdict()
    del layers["influence"]
    return layers


def _ways(tiles: TileDirections, spread: Spread, values: Values) -> dict[str, Tensor]:
    """Return the half spreads that samples must have, by name; the pixel's own if none is asked."""
    ways = {
        "first": tiles.primary,
        "own": spread.half,
        "second": tiles.secondary,
        "reversed": -tiles.primary,
    }
    wanted = [name for name in ways if getattr(values, f"{name}_direction")]
    return {name: ways[name] for name in wanted or ["own"]}


def _options(values: Values, directions: tuple[str, ...]) -> TimeOptions:
    return TimeOptions(
        directions=directions,
        center=Shutter(1, values.shutter_position).center,
        refinements=values.refinements,
        one_color=values.arrivals == "winner",
        fill_hidden=values.hidden_times == "fill",
        relative_depth=values.depth_compare == "relative",
        shares=values.depth_classes == "shares",
        softness=values.softness,
        color_lookup=values.color_lookup,
    )


def _resolve(frame: Frame, totals: tuple[Tensor, ...], moving: Tensor, values: Values) -> Blurred:
    """Return the front over the back, from the sums over the taps."""
    if values.hidden_times == "fill":
        totals = (*fill_hidden(totals[0], totals[1], values.background_gain), *totals[2:])
    *means, alpha = (total / values.num_samples for total in totals)
    alpha = saturate(values.alpha_gain * alpha, values.softness)
    used = moving.to(alpha.dtype)
    sums = [Sums(*(plane * used for plane in (*means, alpha, torch.zeros_like(alpha))))]
    changed: dict[str, object] = {"center_weight": values.center_taps}
    if values.missing_background == "foreground":
        sums = over_nothing(sums, values)
        changed["background_fade"] = 0.0
    return compose(frame, sums, moving, Values(**(vars(values) | _ONE_LINE | changed)))
