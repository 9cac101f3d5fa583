"""Sousa 2013: the motion blur of CryENGINE 3, McGuire's filter made cheaper, in two passes."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import Cost, gather, tiles
from torchblur.filters.parts.reach import ReachingBlur, by_length, longest_spread, tap_counts
from torchblur.filters.parts.reconstruction import (
    WEIGHT_PARAMETERS,
    ReconstructionConfig,
    color_from,
    is_one,
    resolve,
    sample,
    texture_of,
)
from torchblur.filters.parts.spreads import Spread, Tiles, around_tiles, spread_of
from torchblur.frame import Frame, Shutter
from torchblur.ops.gather import (
    Engine,
    Inputs,
    Lookup,
    Planes,
    components,
    gather_lists,
    pixel_grid,
    vector,
    weighted,
)
from torchblur.ops.noise import NoiseKind, noise_plane
from torchblur.ops.pixels import PixelList
from torchblur.ops.tiles import tile_lookup, tile_max
from torchblur.ops.velocity import (
    clamp_length,
    direction,
    half_velocity,
    length,
    quantize_gamma2,
    quantize_linear,
)
from torchblur.ops.weights import cone, depth_weights, saturate
from torchblur.params import Param

__all__ = ["Sousa2013Blur", "Sousa2013Config", "sousa2013"]

_SLIDES = "Sousa 2013, slides on motion blur"


# fmt: off
class Sousa2013Config(ReconstructionConfig):
    """Parameters of Sousa 2013."""

    num_samples: Annotated[
        int,
        Param(symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete",
              source="6 + 6 taps are said of CryENGINE 3; not in the slides' transcript",
              meaning="taps of the gather, in each pass"),
    ] = 6
    passes: Annotated[
        int,
        Param(low=1, high=4, grad="discrete", source=_SLIDES,
              meaning="passes; each after the first fills the gaps between the taps before"),
    ] = 2
    pass_spread: Annotated[
        float,
        Param(low=0.0, high=4.0, grad="weak", source="1 closes the gaps (torchblur)",
              active_when="passes > 1",
              meaning="half spread of a further pass, times N over that of the pass before"),
    ] = 1.0
    cylinder_outer: Annotated[
        float,
        Param(low=1.0, high=4.0, grad="smooth", source=_SLIDES,
              meaning="distance / length where the cylinder weight reaches 0, falling linearly"),
    ] = 1.95
    soft_depth_extent: Annotated[
        float,
        Param(unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
              source=_SLIDES, meaning="depth difference over which front and back are told apart"),
    ] = 1.0
    center_gain: Annotated[
        float,
        Param(low=0.01, high=100.0, scale="log", grad="smooth", source="McGuire 2012, section 3.3",
              meaning="gain of the pixel's own weight, 1 / half spread"),
    ] = 1.0
    noise: Annotated[
        NoiseKind,
        Param(grad="discrete", source="torchblur",
              meaning="jitter per pixel; none, as the second pass closes the gaps"),
    ] = "none"
    jitter: Annotated[
        float,
        Param(symbol="j", unit="taps", low=0.0, high=2.0, grad="weak",
              source="McGuire 2012, section 3.3",
              active_when="noise != none",
              meaning="peak to peak amplitude of the shift of a pixel's taps"),
    ] = 1.0
    encoding: Annotated[
        Literal["float", "packed"],
        Param(grad="discrete", source=_SLIDES,
              meaning="velocity (gamma 2), its length and depth as floats, or in 8 bits each"),
    ] = "float"
    depth_range: Annotated[
        float,
        Param(unit="scene units", low=0.01, high=1e5, scale="log", grad="weak",
              source="torchblur; the slides do not say",
              active_when="encoding == packed",
              meaning="depth that the greatest of the 256 packed depths stands for"),
    ] = 100.0
# fmt: on


class _Options(NamedTuple):
    center: int
    linear_cone: bool
    softness: float
    color_lookup: Lookup


def sousa2013(frame: Frame, config: Sousa2013Config | None = None, **params: Any) -> Tensor:
    """Blur with the filter of Sousa 2013.

    Taps lie on the dominant velocity of the neighborhood of tiles. The weight of one is
    ``f · cone(T, ℓ_S) + b · cone(T, ℓ_p) + 2 · cyl(T, ℓ_S) · cyl(T, ℓ_p)``, as in McGuire 2012 but
    with ``cyl(T, ℓ) = sat(1.95 − T / ℓ)``. A second pass takes N taps over 1 / N of the spread
    from the result of the first, so that the taps multiply.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity through the weights (not through the
        positions of nearest lookups), and in every parameter that `torchblur params` calls
        smooth; straight through the 8-bit encodings.
    Border: replicated.
    Reference: Sousa, "CryENGINE 3 Graphics Gems", 2013. We differ: the cylinder takes both its
        ends as parameters, ``sat((1.95 − T / ℓ) / (1.95 − 0.95))``; the center weight is McGuire's;
        the spread of the second pass is not in the slides, ours closes the gaps; shutters that
        are not centered shift the taps of the first pass only.
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = Sousa2013Blur(config, **params)(frame)
    return result


class Sousa2013Blur(ReachingBlur):
    """The filter of Sousa 2013: McGuire's with a wider, linear cylinder, in two passes.

    See `sousa2013` for the formula. `layers` adds "first_pass" (the color after one pass,
    (B, 3, H, W)), "weight" (the sum of the weights of the first pass, (B, 1, H, W)), "tile_max"
    and "neighbor_max" (half spread in px, (B, 2, Ty, Tx)).
    """

    name = "sousa2013"
    config_class = Sousa2013Config

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        one = gather(config.num_samples, config.color_lookup)
        return tiles(config.tile_size) + one * int(config.passes)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", "first_pass", "weight" and the tiles."""
        return _layers(frame, values, self.engine)


def _layers(frame: Frame, values: Values, engine: Engine) -> dict[str, Tensor]:
    spread, tiles = _spread(frame, values)
    if values.encoding == "packed":
        packed = quantize_linear(frame.finite_depth(), values.depth_range)
        # A depth of 0 is none: the least code stands for a quarter of a step.
        frame = frame.replaced(depth=torch.maximum(packed, values.depth_range / 1020))
    center = Shutter(1, values.shutter_position).center
    layers = {"tile_max": tiles.own, "neighbor_max": tiles.neighborhood}
    scale: float | Tensor = 1.0
    for number in range(values.passes):
        shrunk = Spread(spread.half * scale, spread.length * scale, spread.unit)
        dominant = tile_lookup(tiles.neighborhood, frame.color, values.tile_size) * scale
        color, weight = _pass(frame, shrunk, dominant, center, number, values, engine)
        layers.setdefault("first_pass", color)
        layers.setdefault("weight", weight)
        frame = frame.replaced(color=color)
        taps = tap_counts(values, length(dominant), values.num_samples)
        scale, center = scale * values.pass_spread / taps, 0
    return layers | {"color": color}


def _spread(frame: Frame, values: Values) -> tuple[Spread, Tiles]:
    if values.encoding == "float":
        return spread_of(frame, values)
    longest = longest_spread(values)
    half = clamp_length(half_velocity(frame.velocity, values.shutter), longest)
    half = quantize_gamma2(half, longest)
    tiles = tile_max(half, values.tile_size)
    unit, size = direction(half), quantize_linear(length(half), longest)
    return Spread(unit * size, size, unit), Tiles(tiles, around_tiles(tiles, values))


def _pass(
    frame: Frame,
    spread: Spread,
    dominant: Tensor,
    center: int,
    number: int,
    values: Values,
    engine: Engine,
) -> tuple[Tensor, Tensor]:
    """Return color and weight of one pass."""
    reach = length(dominant)
    noise = noise_plane(values.noise, frame.color, number, values.seed)
    x, y = pixel_grid(frame.color)
    inputs = {
        "texture": texture_of(frame, spread),
        "x": x,
        "y": y,
        "jitter": (noise - 0.5) * values.jitter,
        **components("direction", direction(dominant)),
        "reach": reach,
        "depth": frame.finite_depth(),
        **components("half", spread.half),
        "length_p": torch.maximum(spread.length, values.min_length),
        "extent": values.soft_depth_extent,
    }
    for key in WEIGHT_PARAMETERS:
        inputs[key] = getattr(values, key)
    options = _Options(center, is_one(values.cone_exponent), values.softness, values.color_lookup)
    moving = reach > values.early_out
    active = PixelList.where(moving)
    least = color_from(frame, spread)
    sums = by_length(
        lambda count, lists, pixels: gather_lists(
            _tap, options, count, lists, pixels, engine, color_from=least
        ),
        values,
        active.pack(reach),
        active.lists(inputs),
        active,
        values.num_samples,
    )
    sums = tuple(active.unpack(total) for total in sums)
    center_weight = values.center_gain / inputs["length_p"]
    return resolve(frame, sums, center_weight, moving)


def _tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Options) -> tuple[Planes, Tensor]:
    t = (2 * (index + 1 + inputs["jitter"]) / (count + 1) - 1).clamp(-1, 1)
    along = (t + options.center) * inputs["reach"]
    dx, dy = vector(inputs, "direction")
    tap = sample(inputs, inputs["x"] - along * dx, inputs["y"] - along * dy, options.color_lookup)
    front, behind = depth_weights(
        inputs["depth"],
        tap.depth,
        inputs["extent"],
        relative=False,
        level=inputs["depth_level"],
        softness=options.softness,
    )
    distance_s = distance_p = along.abs()
    if options.center:
        moved_s = tap.length * (tap.unit_x * dx + tap.unit_y * dy)
        half_x, half_y = vector(inputs, "half")
        moved_p = half_x * dx + half_y * dy
        distance_s = (along - options.center * moved_s).abs()
        distance_p = (along - options.center * moved_p).abs()
    length_s, length_p = torch.maximum(tap.length, inputs["min_length"]), inputs["length_p"]
    slope, soft = inputs["cone_slope"], options.softness
    exponent = None if options.linear_cone else inputs["cone_exponent"]
    first = front * cone(distance_s, length_s, slope, exponent, soft)
    second = behind * cone(distance_p, length_p, slope, exponent, soft)
    third = _cylinder(distance_s, length_s, inputs, soft) * _cylinder(
        distance_p, length_p, inputs, soft
    )
    weight = (
        inputs["foreground_gain"] * first
        + inputs["background_gain"] * second
        + inputs["third_gain"] * third
    )
    return weighted(weight, tap.color), weight if tap.valid is None else weight * tap.valid


def _cylinder(distance: Tensor, size: Tensor, inputs: Inputs, softness: float) -> Tensor:
    """Return sat(1.95 − T / ℓ): 1 inside, falling linearly to 0 outside."""
    inner, outer = inputs["cylinder_inner"], inputs["cylinder_outer"]
    return saturate((outer - distance / size) / (outer - inner), softness)
