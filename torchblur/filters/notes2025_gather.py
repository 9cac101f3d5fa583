"""The gather of the 2025 notes: weights of a pair of taps, and what is made of their sums."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.front_back import Sums
from torchblur.filters.places import SHORTEST_REACH, num_pairs, tap_shift
from torchblur.filters.reach import by_length
from torchblur.filters.reconstruction import ColorLookup, Tap, sample, texture_of
from torchblur.filters.spreads import Spread
from torchblur.frame import Frame, Shutter
from torchblur.ops.gather import Engine, Inputs, Planes, components, gather_some, vector, weighted
from torchblur.ops.pixels import PixelList
from torchblur.ops.spread import Mirror, SpreadForm, TapPair, depth_shares, mirror, spread_weight
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import power, saturate

__all__ = ["SHARED_PARAMETERS", "Line", "gather_line", "shared_inputs"]

SHARED_PARAMETERS = (
    "depth_range",
    "relative_depth_range",
    "depth_level",
    "spread_offset",
    "spread_slope",
    "direction_exponent",
    "area_slope",
    "alpha_gain",
    "center_weight",
)
"""Parameters of the taps and of their sums: sets of them share one frame."""

_PARAMETERS = ("depth_level", "spread_offset", "spread_slope", "direction_exponent", "area_slope")


class Line(NamedTuple):
    """One direction that is sampled, per pixel: images or lists."""

    vector: Tensor
    """Half spread of the tile in px, (B, 2, H, W)."""
    used: Tensor
    """Whether it is sampled at all, bool, (B, 1, H, W)."""
    pairs: Tensor
    """Pairs of taps, (B, 1, H, W)."""
    most_pairs: int
    """The most that any pixel has."""
    plain: Tensor | None = None
    """Whether all that its taps may meet moves alike, bool, (B, 1, H, W); None: nowhere."""

    def image(self, pixels: PixelList) -> Line:
        """Return images of the lists, 0 elsewhere; the pairs stay as they are."""
        return self._replace(vector=pixels.unpack(self.vector), used=pixels.unpack(self.used))


class _Options(NamedTuple):
    center: int
    relative_depth: bool
    spread_form: SpreadForm
    mirror: Mirror
    direction_weights: bool
    accurate_alpha: bool
    softness: float
    color_lookup: ColorLookup


def shared_inputs(
    frame: Frame, spread: Spread, linear: Tensor, pixels: PixelList, values: Values
) -> Inputs:
    """Return what the taps of all lines look at, as lists.

    Args:
        frame: The frame.
        spread: Its half spreads.
        linear: Where the color may be looked up bilinearly, a list.
        pixels: The pixels.
        values: The parameters; what is given per pixel is a list.
    """
    x, y = pixels.grid(frame.color)
    relative = values.depth_compare == "relative"
    inputs = {
        "texture": texture_of(frame, spread),
        "x": x,
        "y": y,
        "shift": tap_shift(frame.color, values, pixels),
        "depth": pixels.pack(frame.finite_depth()),
        **components("half", pixels.pack(spread.half)),
        "unit": pixels.pack(spread.unit),
        "length": pixels.pack(spread.length),
        "linear": linear.to(frame.dtype),
        "depth_scale": 1 / (values.relative_depth_range if relative else values.depth_range),
    }
    return inputs | {key: getattr(values, key) for key in _PARAMETERS}


def gather_line(
    shared: Inputs,
    line: Line,
    values: Values,
    engine: Engine,
    pixels: PixelList,
    color_from: int = 0,
) -> Sums:
    """Sample along one line and return the means, lists; zero where the line is not used.

    Args:
        shared: From `shared_inputs`.
        line: Where to sample.
        values: The parameters, as in `shared_inputs`.
        engine: Of the gather.
        pixels: The pixels.
        color_from: Of the texture's channels before this one no gradient is wanted.
    """
    reach = length(line.vector).clamp_min(SHORTEST_REACH)
    unit = direction(line.vector)
    own = (shared["unit"] * unit).sum(1, keepdim=True).abs()
    inputs = shared | {
        **components("direction", unit),
        "reach": reach,
        "pairs": line.pairs,
        "own": power(own, shared["direction_exponent"]),
    }
    options = _Options(
        Shutter(1, values.shutter_position).center,
        values.depth_compare == "relative",
        values.spread_compare,
        values.mirror_filter,
        values.direction_weights,
        values.accurate_alpha,
        values.softness,
        values.color_lookup,
    )
    kinds = [(_pair, line.used)]
    if line.plain is not None:
        kinds = [(_pair, line.used & ~line.plain), (_plain_pair, line.used & line.plain)]
    least = num_pairs(values)

    def means(count: int, lists: Inputs, some: PixelList) -> tuple[Tensor, ...]:
        """Return means over so many pairs; pixels whose taps are doubled have twice as many."""
        lists = dict(lists)
        wanted = [lists.pop(f"wanted_{number}") > 0 for number in range(len(kinds))]
        found = [
            gather_some(
                tap,
                options,
                count * line.most_pairs // least,
                lists,
                some,
                chosen,
                engine,
                num_maxima=1,
                color_from=color_from,
            )
            for (tap, _), chosen in zip(kinds, wanted, strict=True)
        ]
        *totals, most = (sum(planes[1:], planes[0]) for planes in zip(*found, strict=True))
        return *(total / (2 * lists["pairs"]) for total in totals), most

    masks = {f"wanted_{i}": wanted.to(reach.dtype) for i, (_, wanted) in enumerate(kinds)}
    *sums, alpha, influence = by_length(
        means, values, reach, inputs | masks, pixels, least, means=True
    )
    if values.accurate_alpha:
        alpha = alpha * (1 + values.area_slope * reach)
    alpha = saturate(values.alpha_gain * alpha, values.softness)
    return Sums(*(*sums, alpha, influence))


def _pair(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Planes, Tensor, Planes, Tensor, Tensor, Tensor]:
    taps, weights = zip(*(_tap(t, inputs, options) for t in _times(index, inputs)), strict=True)
    mirrored = mirror(
        weights,
        TapPair(*(tap.depth for tap in taps)),
        TapPair(*(tap.length for tap in taps)),
        options.mirror,
    )
    return _added(index, taps, mirrored, inputs)


def _plain_pair(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Planes, Tensor, Planes, Tensor, Tensor, Tensor]:
    """Return the same of two taps that move as the pixel does, and lie at its depth."""
    reach, level = inputs["reach"], saturate(inputs["depth_level"], options.softness)
    planes = _with_alpha(level, 1 - level, reach, inputs, options)
    weights = tuple(plane.expand_as(reach) for plane in planes)
    times = _times(index, inputs)
    taps = [_look(t, inputs, options)[0]._replace(length=reach) for t in times]
    return _added(index, taps, (weights, weights), inputs)


def _times(index: Tensor, inputs: Inputs) -> TapPair:
    """Return when a pair of taps lies, in units of the reach."""
    step, shift = ((part / inputs["pairs"]) for part in (index + 0.5, inputs["shift"]))
    return TapPair(*((side * step + shift).clamp(-1, 1) for side in (1, -1)))


def _added(
    index: Tensor, taps: Sequence[Tap], weights: Sequence[Planes], inputs: Inputs
) -> tuple[Planes, Tensor, Planes, Tensor, Tensor, Tensor]:
    """Return what two taps add: nothing where the pixel has fewer pairs."""
    taken = (index < inputs["pairs"]).to(inputs["reach"].dtype)
    parts = [_parts(tap, weighted(taken, w)) for tap, w in zip(taps, weights, strict=True)]
    *sums, _ = (ahead + behind for ahead, behind in zip(*parts, strict=True))
    influence = torch.maximum(parts[0][-1], parts[1][-1])
    return tuple(sums[:3]), sums[3], tuple(sums[4:7]), sums[7], sums[8], influence


def _parts(tap: Tap, weights: Planes) -> Planes:
    background, foreground, alpha = weights
    influence = torch.where(background + foreground > 0, tap.length, 0.0)
    colors = weighted(background, tap.color), weighted(foreground, tap.color)
    if tap.valid is not None:
        background, foreground = background * tap.valid, foreground * tap.valid
    return *colors[0], background, *colors[1], foreground, alpha, influence


def _look(t: Tensor, inputs: Inputs, options: _Options) -> tuple[Tap, Tensor]:
    """Return what lies at a time t in [-1, 1], and how far along the line that is, px."""
    along = (t + options.center) * inputs["reach"]
    dx, dy = vector(inputs, "direction")
    x, y = inputs["x"] - along * dx, inputs["y"] - along * dy
    return sample(inputs, x, y, options.color_lookup), along


def _tap(t: Tensor, inputs: Inputs, options: _Options) -> tuple[Tap, Planes]:
    """Return what lies at a time t in [-1, 1]; weights as background, foreground, and its alpha."""
    tap, along = _look(t, inputs, options)
    dx, dy = vector(inputs, "direction")
    toward = tap.unit_x * dx + tap.unit_y * dy
    distance_s = distance_p = along.abs()
    if options.center:
        half_x, half_y = vector(inputs, "half")
        moved_p = half_x * dx + half_y * dy
        distance_p = (along - options.center * moved_p).abs()
        distance_s = (along - options.center * tap.length * toward).abs()
    share = depth_shares(
        inputs["depth"],
        tap.depth,
        inputs["depth_scale"],
        level=inputs["depth_level"],
        relative=options.relative_depth,
        softness=options.softness,
    )
    background = share.background * _spread(distance_p, inputs["length"], inputs, options)
    foreground = share.foreground * _spread(distance_s, tap.length, inputs, options)
    if options.direction_weights:
        background = background * inputs["own"]
        foreground = foreground * power(toward.abs(), inputs["direction_exponent"])
    return tap, _with_alpha(background, foreground, tap.length, inputs, options)


def _with_alpha(
    background: Tensor, foreground: Tensor, size: Tensor, inputs: Inputs, options: _Options
) -> Planes:
    """Return both weights, and the alpha of a foreground of some half spread."""
    if not options.accurate_alpha:
        return background, foreground, foreground
    alpha = saturate(foreground / (1 + inputs["area_slope"] * size), options.softness)
    return background, foreground, alpha


def _spread(distance: Tensor, size: Tensor, inputs: Inputs, options: _Options) -> Tensor:
    per_px = inputs["pairs"] / inputs["reach"]
    return spread_weight(
        distance * per_px,
        size * per_px,
        offset=inputs["spread_offset"],
        slope=inputs["spread_slope"],
        form=options.spread_form,
        softness=options.softness,
    )
