"""McGuire 2012: a reconstruction filter for plausible motion blur."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import Cost, gather, tiles, with_background
from torchblur.filters.parts.moving import Filtered, Moving, moving_part, revealed_part
from torchblur.filters.parts.reach import ReachingBlur, by_length
from torchblur.filters.parts.reconstruction import (
    WEIGHT_PARAMETERS,
    ReconstructionConfig,
    is_one,
    resolve,
    sample,
)
from torchblur.filters.parts.revealed import RevealedBackgroundConfig
from torchblur.filters.parts.spreads import tiles_of
from torchblur.frame import Frame, Shutter
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
from torchblur.ops.noise import noise_plane
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import cone, cylinder, depth_weights
from torchblur.params import Param

__all__ = ["McGuire2012Blur", "McGuire2012Config", "mcguire2012"]


# fmt: off
class McGuire2012Config(RevealedBackgroundConfig, ReconstructionConfig):
    """Parameters of McGuire 2012."""

    soft_depth_extent: Annotated[
        float,
        Param(symbol="SOFT_Z_EXTENT", unit="scene units", low=1e-4, high=1e4, scale="log",
              grad="smooth", source="McGuire 2012, section 3.3",
              meaning="depth difference over which front and back are told apart"),
    ] = 0.1
    center_gain: Annotated[
        float,
        Param(low=0.01, high=100.0, scale="log", grad="smooth", source="McGuire 2012, section 3.3",
              meaning="gain of the pixel's own weight, 1 / half spread"),
    ] = 1.0
    jitter: Annotated[
        float,
        Param(symbol="j", unit="taps", low=0.0, high=2.0, grad="weak",
              source="McGuire 2012, section 3.3",
              active_when="noise != none",
              meaning="peak to peak amplitude of the shift of a pixel's taps"),
    ] = 1.0
    skip_middle_tap: Annotated[
        bool,
        Param(grad="discrete", source="McGuire 2012, section 3.3",
              active_when="shutter_position == centered",
              meaning="leave out the tap nearest to the pixel, which has its own weight "
                      "(centered shutter only)"),
    ] = True
# fmt: on


class _Options(NamedTuple):
    center: int
    skip_middle_tap: bool
    linear_cone: bool
    softness: float
    color_lookup: Lookup


def mcguire2012(frame: Frame, config: McGuire2012Config | None = None, **params: Any) -> Tensor:
    """Blur with the reconstruction filter of McGuire 2012.

    Every tap lies on the dominant velocity of the neighborhood of tiles. Its weight is
    ``f · cone(T, ℓ_S) + b · cone(T, ℓ_p) + 2 · cyl(T, ℓ_S) · cyl(T, ℓ_p)``: a sample that blurs
    over the pixel, the pixel that blurs and lets a sample through, and both.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W).
        config: Parameters; the paper's if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, in depth, in the velocity through the weights (not through the
        positions of nearest lookups), and in every parameter that `torchblur params` calls
        smooth.
    Border: replicated.
    Reference: McGuire, Hennessy, Bukowski, Osman 2012. We differ: depth is positive; a still
        pixel keeps the velocity 0 and only its length is floored; jitter is Halton noise instead
        of a hash; the distance T is that before the position is rounded to a pixel; shutters
        that are not centered shift the taps along the velocity.
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth.
    """
    result: Tensor = McGuire2012Blur(config, **params)(frame)
    return result


class McGuire2012Blur(ReachingBlur):
    """The tile-based filter of McGuire 2012: TileMax, NeighborMax, one gather. See `mcguire2012`.

    `layers` adds "tile_max" and "neighbor_max" (half spread in px, (B, 2, Ty, Tx)) and "weight"
    (the sum of all weights, (B, 1, H, W); 0 where nothing moves).
    """

    name = "mcguire2012"
    config_class = McGuire2012Config
    per_frame = ("shutter",)

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        whole = tiles(config.tile_size) + gather(config.num_samples, config.color_lookup)
        return with_background(whole, config)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", "tile_max", "neighbor_max" and "weight"."""
        return _filtered(frame, values, self.engine).layers(frame)

    def color(self, frame: Frame, values: Values) -> Tensor:
        """Return the blurred color alone, (B, 3, H, W)."""
        return _filtered(frame, values, self.engine).color(frame)


def _filtered(frame: Frame, values: Values, engine: Engine) -> Filtered:
    own, around = tiles_of(frame, values)
    tiles = {"tile_max": own, "neighbor_max": around}
    part = moving_part(frame, values, around)
    if part is None:
        return Filtered.still(frame, tiles, "weight")
    inputs = _tap_inputs(part)
    inputs |= revealed_part(frame, values, part, lambda f, v: _filtered(f, v, engine).color(f))
    options = _Options(
        Shutter(1, values.shutter_position).center,
        values.skip_middle_tap and values.shutter_position == "centered",
        is_one(values.cone_exponent),
        values.softness,
        values.color_lookup,
    )
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
    local = part.values
    center_weight = local.center_gain / torch.maximum(part.spread.length, local.min_length)
    moving = inputs["reach"] > local.early_out
    color, weight = resolve(part.frame, sums, center_weight, moving)
    return Filtered(tiles, part.pixels, {"color": color, "weight": weight * moving})


def _tap_inputs(part: Moving) -> Inputs:
    color, values, spread, pixels = part.frame.color, part.values, part.spread, part.pixels
    noise = noise_plane(values.noise, color, seed=values.seed, pixels=pixels)
    x, y = part.grid()
    inputs = {
        "texture": part.texture,
        "x": x,
        "y": y,
        "jitter": (noise - 0.5) * values.jitter,
        **components("direction", direction(part.dominant)),
        "reach": length(part.dominant),
        "depth": part.frame.finite_depth(),
        "length": spread.length,
        **components("unit", spread.unit),
        "extent": values.soft_depth_extent,
    }
    return inputs | {key: getattr(values, key) for key in WEIGHT_PARAMETERS}


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
    length_s = torch.maximum(tap.length, inputs["min_length"])
    length_p = torch.maximum(inputs["length"], inputs["min_length"])
    distance_s = distance_p = along.abs()
    if options.center:
        ux, uy = vector(inputs, "unit")
        moved_s = tap.length * (tap.unit_x * dx + tap.unit_y * dy)
        moved_p = inputs["length"] * (ux * dx + uy * dy)
        distance_s = (along - options.center * moved_s).abs()
        distance_p = (along - options.center * moved_p).abs()
    exponent = None if options.linear_cone else inputs["cone_exponent"]
    slope, ends = inputs["cone_slope"], (inputs["cylinder_inner"], inputs["cylinder_outer"])
    weight = (
        inputs["foreground_gain"]
        * front
        * cone(distance_s, length_s, slope, exponent, options.softness)
        + inputs["background_gain"]
        * behind
        * cone(distance_p, length_p, slope, exponent, options.softness)
        + inputs["third_gain"]
        * cylinder(distance_s, length_s, *ends)
        * cylinder(distance_p, length_p, *ends)
    )
    if options.skip_middle_tap:
        weight = weight * (2 * index != count - 1)
    return weighted(weight, tap.color), weight if tap.valid is None else weight * tap.valid
