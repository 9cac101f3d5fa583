"""Tan 2022: hybrid motion blur, a gather over the raster and over a ray-traced background."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.parts.base import Values
from torchblur.filters.parts.cost import TWO_SUMS, Cost, gather, tiles
from torchblur.filters.parts.reach import ReachingBlur, by_length
from torchblur.filters.parts.reconstruction import (
    WEIGHT_PARAMETERS,
    Tap,
    color_from,
    is_one,
    resolve,
    sample,
    texture_of,
)
from torchblur.filters.parts.revealed import behind_slope, layer_behind, share_behind
from torchblur.filters.parts.spreads import Spread, Tiles, spread_of
from torchblur.filters.tan2022.config import Tan2022Config
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
from torchblur.ops.noise import noise_plane
from torchblur.ops.pixels import PixelList
from torchblur.ops.raymask import RayMask, edge_strength, ray_mask, uncovered
from torchblur.ops.tiles import tile_lookup
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import cone, cylinder, saturate, threshold

__all__ = ["Tan2022Blur", "Tan2022Config", "tan2022"]


class _Options(NamedTuple):
    side: int
    linear_cone: bool
    softness: float
    threshold_softness: float
    color_lookup: Lookup


class _Sums(NamedTuple):
    """Sums over the taps of one layer, and the weight of the pixel itself."""

    front_color: Tensor
    front: Tensor
    back_color: Tensor
    back: Tensor
    center: Tensor
    moving: Tensor


def tan2022(frame: Frame, config: Tan2022Config | None = None, **params: Any) -> Tensor:
    """Blur with the hybrid filter of Tan 2022.

    Taps lie on the dominant velocity of the tiles, on one side of the pixel, at T of the whole
    displacement. The weight of one is ``w_f + w_b + w_s`` (eq. 5 to 10):

    ``f · cone(T, ℓ_S) + b · cone(T, ℓ_p) + 2 · cyl(T, ℓ_S) · cyl(T, ℓ_p)``

    with w_f times 30 for samples that are nearer by the depth extent. In the ray mask, where the
    pixel's object moves away from what lies behind it, the weights of taps behind the pixel go to
    the revealed layer, which is blurred by its own motion, times 3; all others are divided by 3.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W); normals and object numbers for the mask;
            `revealed` with color, depth and velocity, and `valid` where it was traced. Without
            a revealed layer, and where it is not valid, the background stays the raster's.
        config: Parameters; the paper's if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in the colors and depths of both layers, in the velocity through the weights
        (not through the positions of nearest lookups), and in every parameter that `torchblur
        params` calls smooth. Thresholds have gradients with `threshold_softness` only.
    Border: replicated; in the mask positions outside the image are rejected.
    Reference: Tan, Cui, Bhojan 2022. We differ where the paper leaves a gap: what an exposure
        after the frame uncovers lies behind the motion, so the mask looks where the taps go (a
        pixel's next position, as in the paper, belongs to `trailing`); a centered shutter
        samples both sides, and the mask looks both ways, half as far; how the two layers are
        weighted (a tap's weight goes to the revealed layer by how far it lies on the way from
        the pixel to that layer, see `background_depth`); depth is positive; taps lie at
        ``(i + ½ + j) / N`` of the dominant displacement, with a jitter j; none is skipped in the
        middle of a centered shutter; the center weight is McGuire's; a still pixel keeps the
        velocity 0, and the floor `min_length` holds for the whole displacement.
    Raises: ConfigError for a bad parameter, FrameError if a layer has no depth.
    Warns: UserWarning, if the frame has no revealed layer, object numbers or normals.
    """
    result: Tensor = Tan2022Blur(config, **params)(frame)
    return result


class Tan2022Blur(ReachingBlur):
    """The hybrid filter of Tan 2022. See `tan2022` for the formula.

    It warns once of each layer that it does without. `layers` adds "ray_mask" (where a renderer
    should trace), "edge_mask", "candidates", "hybrid" (where the revealed layer was used; 0
    without one, and where it hides nothing), "foreground_weight" and "background_weight" (sums
    over the raster's taps, of use where the tile moves, all (B, 1, H, W)), "background" (the
    revealed layer's blurred color, (B, 3, H, W), if there is one), and "tile_max" and
    "neighbor_max" (half displacement in px, (B, 2, Ty, Tx)).
    """

    name = "tan2022"
    config_class = Tan2022Config
    _told: frozenset[str] = frozenset()

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        ways = 2 if config.shutter_position == "centered" else 1
        mask = Cost(config.mask_samples, config.mask_samples, passes=1) * ways
        edges = Cost(lookups=9, passes=1)
        layer = gather(config.num_samples, config.color_lookup, TWO_SUMS)
        return edges + mask + (tiles(config.tile_size) + layer) * 2

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", the masks, the weights and the tiles."""
        for name, consequence in (
            ("object_id", "the ray mask compares depths alone"),
            ("normal", "the ray mask sees edges of depth alone"),
            ("revealed", "the background is taken from the raster"),
        ):
            if getattr(frame, name) is None and name not in self._told:
                self._told |= {name}
                warnings.warn(f"{self.name}: no layer `{name}`; {consequence}", stacklevel=2)
        return _layers(frame, values, self.engine)


def _layers(frame: Frame, values: Values, engine: Engine) -> dict[str, Tensor]:
    spread, tiles = spread_of(frame, values)
    mask = _mask(frame, spread, values, engine)
    layers = {
        "ray_mask": mask.mask,
        "edge_mask": mask.edges,
        "candidates": mask.candidates,
        "tile_max": tiles.own,
        "neighbor_max": tiles.neighborhood,
    }
    if frame.revealed is None:
        sums = _gather(frame, spread, tiles, values, engine)
        layers |= {"color": _raster(frame, sums), "hybrid": torch.zeros_like(mask.mask)}
    else:
        layer, _ = layer_behind(frame)
        color = _raster(layer, _gather(layer, *spread_of(layer, values), values, engine))
        slope = behind_slope(frame, values.background_depth)
        sums = _gather(frame, spread, tiles, values, engine, slope)
        layers |= {"hybrid": mask.mask * (slope > 0), "background": color}
        layers["color"] = _composite(frame, sums, color, layers["hybrid"], values)
    layers["foreground_weight"], layers["background_weight"] = sums.front, sums.back
    return layers


def _mask(frame: Frame, spread: Spread, values: Values, engine: Engine) -> RayMask:
    """Return the ray mask; with a centered shutter that of both sides."""
    depth = frame.finite_depth()
    strength = edge_strength(depth, frame.normal, values.depth_edge_gain, values.normal_edge_gain)
    softness = values.threshold_softness
    masks = []
    for way in _ways(values):
        displacement = way * spread.half
        candidates = uncovered(
            displacement, depth, frame.object_id, values.soft_depth_extent, softness
        )
        masks.append(
            ray_mask(
                displacement,
                strength,
                candidates,
                values.edge_threshold,
                values.mask_samples,
                softness,
                engine,
            )
        )
    return RayMask(*(torch.stack(planes).amax(0) for planes in zip(*masks, strict=True)))


def _ways(values: Values) -> tuple[int, ...]:
    """Return where a pixel looks, in half displacements: against the motion, with it, or both."""
    center = Shutter(1, values.shutter_position).center
    return (-2 * center,) if center else (-1, 1)


def _gather(
    frame: Frame,
    spread: Spread,
    tiles: Tiles,
    values: Values,
    engine: Engine,
    slope: Tensor | None = None,
) -> _Sums:
    """Return the sums over one layer; `slope` tells its background, see `behind_slope`."""
    sides = len(_ways(values))
    dominant = tile_lookup(tiles.neighborhood, frame.color, values.tile_size)
    reach = length(dominant) * (2 / sides)
    noise = noise_plane(values.noise, frame.color, seed=values.seed)
    x, y = pixel_grid(frame.color)
    scaled = spread._replace(length=spread.length * (2 / sides))
    inputs = {
        "texture": texture_of(frame, scaled),
        "x": x,
        "y": y,
        "jitter": (noise - 0.5) * values.jitter,
        **components("direction", direction(dominant)),
        "reach": reach,
        "depth": frame.finite_depth(),
        "length": torch.maximum(scaled.length, values.min_length),
        "extent": values.soft_depth_extent,
        "magnifier": values.foreground_magnifier,
    }
    for key in WEIGHT_PARAMETERS:
        inputs[key] = getattr(values, key)
    if slope is not None:
        inputs["behind"] = slope
    options = _Options(
        Shutter(1, values.shutter_position).center,
        is_one(values.cone_exponent),
        values.softness,
        values.threshold_softness,
        values.color_lookup,
    )
    moving = length(dominant) > values.early_out
    active = PixelList.where(moving)
    least = color_from(frame, scaled)
    totals = by_length(
        lambda count, lists, pixels: gather_lists(
            _tap, options, count, lists, pixels, engine, color_from=least
        ),
        values,
        active.pack(length(dominant)),
        active.lists(inputs),
        active,
        values.num_samples,
    )
    front_color, front, back_color, back = (active.unpack(total) for total in totals)
    center = values.center_gain / inputs["length"]
    return _Sums(front_color, front, back_color, back, center, moving)


def _raster(frame: Frame, sums: _Sums) -> Tensor:
    """Return the blur of one layer alone: the paper's adapted post-process."""
    totals = sums.front_color + sums.back_color, sums.front + sums.back
    return resolve(frame, totals, sums.center, sums.moving)[0]


def _composite(
    frame: Frame, sums: _Sums, background: Tensor, hybrid: Tensor, values: Values
) -> Tensor:
    """Return the raster's blur, and in the mask the foreground over the revealed layer."""
    gain = values.mask_magnifier
    weight = gain * sums.back
    totals = sums.front_color / gain + weight * background, sums.front / gain + weight
    mixed = resolve(frame, totals, sums.center / gain, sums.moving)[0]
    plain = _raster(frame, sums)
    return torch.where(hybrid == 1, mixed, plain + hybrid * (mixed - plain))


def _tap(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Planes, Tensor, Planes, Tensor]:
    t = ((index + 0.5 + inputs["jitter"]) / count).clamp(0, 1)
    if options.side == 0:
        t = 2 * t - 1
    along = t * inputs["reach"]
    dx, dy = ((options.side or 1) * part for part in vector(inputs, "direction"))
    tap = sample(inputs, inputs["x"] - along * dx, inputs["y"] - along * dy, options.color_lookup)
    front, back = _weights(along.abs(), tap, inputs, options)
    valid = 1.0 if tap.valid is None else tap.valid
    colors = weighted(front, tap.color), weighted(back, tap.color)
    return colors[0], front * valid, colors[1], back * valid


def _weights(
    distance: Tensor, tap: Tap, inputs: Inputs, options: _Options
) -> tuple[Tensor, Tensor]:
    """Return the weight of a tap as foreground and as background of the pixel."""
    deeper = (inputs["depth"] - tap.depth) / inputs["extent"]
    level, soft = inputs["depth_level"], options.softness
    front, behind = saturate(level + deeper, soft), saturate(level - deeper, soft)
    length_s, length_p = torch.maximum(tap.length, inputs["min_length"]), inputs["length"]
    covers = inputs["foreground_gain"] * front * _cone(distance, length_s, inputs, options)
    magnified = threshold(deeper - 1, options.threshold_softness)
    covers = covers * (1 + (inputs["magnifier"] - 1) * magnified)
    shows = inputs["background_gain"] * behind * _cone(distance, length_p, inputs, options)
    both = inputs["third_gain"] * _cylinders(distance, length_s, inputs)
    total = covers + shows + both
    if "behind" not in inputs:
        return total, torch.zeros_like(total)
    share = share_behind(inputs["behind"], inputs["depth"], tap.depth)
    return (1 - share) * total, share * total


def _cone(distance: Tensor, size: Tensor, inputs: Inputs, options: _Options) -> Tensor:
    exponent = None if options.linear_cone else inputs["cone_exponent"]
    return cone(distance, size, inputs["cone_slope"], exponent, options.softness)


def _cylinders(distance: Tensor, length_s: Tensor, inputs: Inputs) -> Tensor:
    ends = inputs["cylinder_inner"], inputs["cylinder_outer"]
    theirs = cylinder(distance, length_s, *ends)
    return theirs * cylinder(distance, inputs["length"], *ends)
