"""What a filter costs per pixel, counted from its configuration: lookups, arithmetic, passes.

The unit is one nearest lookup of a color. The count is that of a frame in which everything moves,
along paths that `num_samples` taps suffice for (longer ones have more with `tap_spacing`). It knows
nothing of caches: it ranks settings of a filter well, and compares filters roughly.
`Cost.relative` is the total over that of Guertin 2014 with 35 nearest taps, as published.

A filter outside this table has a class method ``cost(config) -> Cost`` instead.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter, get_filter
from torchblur.filters.parts.base import FilterConfig
from torchblur.params import build

__all__ = ["Cost", "cost_at", "cost_of"]

_LOOKUPS = {"nearest": 1.0, "bilinear": 2.0, "opportunistic": 2.0, "cubic": 10.0}
_WEIGHTS = 2.0  # arithmetic of a tap with weights from depth and motion, in lookups
_TWO_SUMS = 4.0  # the same where foreground and background have sums of their own
_PASS = 6.0  # a pass over the image: what it reads of the pixel itself, sets up and writes
_KERNEL = 25  # taps of the 5x5 kernels of Oberberger 2022


@dataclass(frozen=True)
class Cost:
    """What a filter does per pixel of the full image.

    Args:
        taps: Places that are looked at.
        lookups: Lookups there, in nearest lookups of a color.
        arithmetic: What weights cost, in the same unit.
        passes: Passes over the image; those over the tiles count by their size.
    """

    taps: float = 0.0
    lookups: float = 0.0
    arithmetic: float = 0.0
    passes: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        """Return the cost of both."""
        return Cost(
            self.taps + other.taps,
            self.lookups + other.lookups,
            self.arithmetic + other.arithmetic,
            self.passes + other.passes,
        )

    def __mul__(self, share: float) -> Cost:
        """Return the cost on a share of the pixels, or of several times the same."""
        return Cost(
            self.taps * share, self.lookups * share, self.arithmetic * share, self.passes * share
        )

    @property
    def total(self) -> float:
        """All of it, in nearest lookups of a color."""
        return self.lookups + self.arithmetic + _PASS * self.passes

    @property
    def relative(self) -> float:
        """The total over that of Guertin 2014 as published, 35 taps."""
        return self.total / _reference()


def cost_of(name: str, params: FilterConfig | Mapping[str, Any] | None = None) -> Cost:
    """Return what a filter costs.

    Args:
        name: Registered name of the filter.
        params: Its configuration, or the parameters that differ from its defaults.

    Raises:
        ConfigError: unknown filter or parameter, or a filter whose cost is not known.
    """
    kind = get_filter(name)
    given = params if isinstance(params, FilterConfig) else None
    config = given or build(kind.config_class, dict(params or {}), name)
    own: Callable[[FilterConfig], Cost] | None = getattr(kind, "cost", None)
    count = own or _TABLE.get(name)
    if count is None:
        raise ConfigError(
            f"the cost of `{name}` is not known; give its class a method cost(config) -> Cost"
        )
    return count(config)


def cost_at(blur: BlurFilter, values: Mapping[str, Any]) -> Cost:
    """Return what a filter costs with other values of its parameters.

    Args:
        blur: The filter; its config has all other values.
        values: By name. Tensors are numbers of continuous parameters, which change no cost.
    """
    plain = {name: value for name, value in values.items() if not isinstance(value, Tensor)}
    return cost_of(blur.name, blur.config.model_dump() | plain)


@functools.cache
def _reference() -> float:
    return cost_of("guertin2014").total


# -- parts -----------------------------------------------------------------------------------------


def _color(lookup: str) -> float:
    """Return what one lookup of a color counts for; a cubic one is that of 16 pixels."""
    return _LOOKUPS[lookup]


def _gather(taps: float, lookup: str, arithmetic: float = _WEIGHTS) -> Cost:
    """Return a gather whose taps look up color and motion with depth."""
    return Cost(taps, taps * (_color(lookup) + 1), taps * arithmetic, passes=1)


def _tiles(tile_size: int, reductions: int = 1) -> Cost:
    """Return reductions to tiles, each followed by one over 3x3 tiles."""
    tiles = 1 / tile_size**2
    return Cost(lookups=1 + 9 * tiles, passes=1 + tiles) * reductions


def _pairs(taps: int) -> int:
    return 2 * ((taps + 1) // 2)


# -- filters ---------------------------------------------------------------------------------------


def _line(config: Any) -> Cost:
    taps = config.num_samples
    return Cost(taps, taps * _color(config.lookup), passes=1)


def _reconstruction(config: Any) -> Cost:
    """Return McGuire 2012 and Guertin 2014; a revealed background is blurred the same way."""
    whole = _tiles(config.tile_size) + _gather(config.num_samples, config.color_lookup)
    if getattr(config, "sample_assignment", "even") == "variance":
        whole += Cost(lookups=9 / config.tile_size**2, passes=1 / config.tile_size**2)
    return whole * _layers(config)


def _jimenez(config: Any) -> Cost:
    taps = _pairs(config.num_samples)
    whole = _tiles(config.tile_size, 2) + _gather(taps, config.color_lookup)
    return whole * _layers(config)


def _sousa(config: Any) -> Cost:
    gathers = _gather(config.num_samples, config.color_lookup) * int(config.passes)
    return _tiles(config.tile_size) + gathers


def _notes(config: Any) -> Cost:
    size = config.tile_size if config.resolution == "full" else (config.tile_size + 1) // 2
    main = _notes_lines(config) + _tiles(size, 2 if config.directions == "one" else 3)
    whole = main * _layers(config)
    if config.post_filter:
        whole += _post_filter(config, 1 if config.directions == "one" else 2)
    if config.resolution == "full":
        return whole
    # Down: 2x2 pixels of color, motion and depth, once for four. Up: four small ones and their
    # depth around each pixel.
    return whole * 0.25 + Cost(lookups=2, passes=0.25) + Cost(4, 8, 4 * _WEIGHTS, passes=1)


def _notes_lines(config: Any) -> Cost:
    taps = _pairs(config.num_samples)
    first = _gather(taps * (2 if config.double_samples else 1), config.color_lookup, _TWO_SUMS)
    if config.directions == "one":
        return first
    return first + _gather(taps, config.color_lookup, _TWO_SUMS)


def _post_filter(config: Any, directions: int) -> Cost:
    taps = 2 * max(config.post_samples // 2, 1) * directions
    return Cost(taps, taps, taps * _WEIGHTS, passes=1)


def _layers(config: Any) -> int:
    return 2 if config.background == "revealed" else 1


def _tan(config: Any) -> Cost:
    """Return the blur of both layers and the ray mask, with a revealed layer."""
    ways = 2 if config.shutter_position == "centered" else 1
    mask = Cost(config.mask_samples, config.mask_samples, passes=1) * ways
    edges = Cost(lookups=9, passes=1)
    layer = _tiles(config.tile_size) + _gather(config.num_samples, config.color_lookup, _TWO_SUMS)
    return edges + mask + layer * 2


def _oberberger(config: Any) -> Cost:
    """Return all stages, with one sample per pixel."""
    kernel = Cost(_KERNEL, 2 * _KERNEL, _KERNEL * _TWO_SUMS, passes=1)
    looks = config.variance_window**2 / config.variance_stride**2
    whole = Cost(looks, looks, looks * _WEIGHTS, passes=1)
    if config.prefilter:
        drawn = 9 * config.prefilter_samples
        whole += Cost(drawn, drawn, drawn * _WEIGHTS, passes=1)
    whole += kernel if config.first_stage else Cost(1, 2, _TWO_SUMS, passes=1)
    if config.temporal:
        steps = 2 * config.reprojection_iterations
        whole += Cost(steps, steps, passes=1) + kernel
    turn = Cost(_KERNEL, _KERNEL * (_color(config.lookup) + 1), _KERNEL * _TWO_SUMS, passes=1)
    if config.blend_source == "filtered":
        turn += Cost(_KERNEL, _KERNEL * _color(config.lookup), passes=1)
    return whole + turn * int(config.second_stage_iterations)


def _torchblur(config: Any) -> Cost:
    """Return the gather: at each time a sample of each direction, and one on the pixel's line."""
    ways, taps, color = _ways(config), config.num_samples, _color(config.color_lookup)
    samples = taps * (ways + 1)
    followed = Cost(lookups=taps * ways * config.refinements)
    main = Cost(samples, samples * (color + 1), samples * _WEIGHTS, passes=1) + followed
    return (_two_tiles(config) + main) * _layers(config)


def _ways(config: Any) -> int:
    asked = (config.first_direction, config.own_direction, config.second_direction)
    return max(sum(map(int, asked)), 1)


def _two_tiles(config: Any) -> Cost:
    """Return the tiles' motions, and what makes the motion at edges clean."""
    tiles = _tiles(config.tile_size, 3 if config.second_direction else 2)
    return tiles if config.edge_motion == "own" else tiles + Cost(lookups=9, passes=1)


def _composed(config: Any) -> Cost:
    """Return the space of the published filters: turns or pairs."""
    ways, taps = _ways(config), config.num_samples
    if config.sampling == "alternate":
        main = _gather(taps, config.color_lookup, _TWO_SUMS)
    else:
        lines = ways + (1 if config.double_samples else 0)
        main = _gather(_pairs(taps), config.color_lookup, _TWO_SUMS) * lines
    whole = (_two_tiles(config) + main) * _layers(config)
    return whole + _post_filter(config, ways) if config.post_filter else whole


def _warp(config: Any) -> Cost:
    """Return the marks of all splats at all moments, four each, and what is made ready for them."""
    marks = 4 * config.num_samples * config.supersampling**2
    ready = Cost(passes=4 if config.background == "none" else 10)
    return ready + Cost(marks, marks, marks * _TWO_SUMS, passes=1)


_TABLE: dict[str, Callable[[Any], Cost]] = {
    "composed": _composed,
    "guertin2014": _reconstruction,
    "jimenez2014": _jimenez,
    "line": _line,
    "mcguire2012": _reconstruction,
    "notes2025": _notes,
    "oberberger2022": _oberberger,
    "sousa2013": _sousa,
    "tan2022": _tan,
    "torchblur": _torchblur,
    "warp": _warp,
}
