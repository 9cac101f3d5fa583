"""Depth of field as a post-process: near and far field gathered apart, by their circles."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.frame import FAR_DEPTH
from torchblur.ops.gather import Engine, Inputs, Planes, gather, pixel_grid, read, weighted
from torchblur.ops.noise import NoiseKind, noise_plane
from torchblur.params import Config, Param
from torchblur.post.base import Effect, Values, check_plane

__all__ = ["DepthOfField", "DepthOfFieldConfig", "circle_of_confusion", "depth_of_field"]

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_SHARP_PX = 0.5  # a circle of this radius lies within its pixel
_OWN = 1e-3  # share of a pixel's own color where nothing else is found
_TINY = 1e-9
_OURS = "torchblur"


# fmt: off
class DepthOfFieldConfig(Config):
    """Parameters of the depth of field. Radii are those of the circle of confusion, in px."""

    model: Annotated[
        Literal["lens", "ramps"],
        Param(grad="discrete", source="lens: thin lens; ramps: Gilham, ShaderX5",
              meaning="circle of confusion of a thin lens, or linear in depth on both sides"),
    ] = "lens"
    focus_distance: Annotated[
        float,
        Param(symbol="z_f", unit="scene units", low=1e-3, high=1e6, scale="log", grad="smooth",
              source="thin lens", meaning="depth that is sharp"),
    ] = 10.0
    infinity_radius: Annotated[
        float,
        Param(unit="px", low=0.0, high=64.0, grad="smooth", source="thin lens",
              meaning='lens: radius at infinity, f² / (2 N (z_f − f)) · W / sensor width'),
    ] = 8.0
    focus_range: Annotated[
        float,
        Param(unit="scene units", low=0.0, high=1e6, grad="smooth", source="Gilham, ShaderX5",
              meaning="ramps: depth to either side of the focus that is sharp"),
    ] = 1.0
    near_ramp: Annotated[
        float,
        Param(unit="scene units", low=1e-3, high=1e6, scale="log", grad="smooth",
              source="Gilham, ShaderX5",
              meaning="ramps: depth over which the near radius grows from nothing to its full"),
    ] = 5.0
    far_ramp: Annotated[
        float,
        Param(unit="scene units", low=1e-3, high=1e6, scale="log", grad="smooth",
              source="Gilham, ShaderX5",
              meaning="ramps: depth over which the far radius grows from nothing to its full"),
    ] = 10.0
    near_radius: Annotated[
        float,
        Param(unit="px", low=0.0, high=64.0, grad="smooth", source="Gilham, ShaderX5",
              meaning="ramps: full radius in front of the focus"),
    ] = 8.0
    far_radius: Annotated[
        float,
        Param(unit="px", low=0.0, high=64.0, grad="smooth", source="Gilham, ShaderX5",
              meaning="ramps: full radius behind the focus"),
    ] = 8.0
    max_radius: Annotated[
        int,
        Param(unit="px", low=1, high=64, scale="log", grad="discrete", source=_OURS,
              meaning="longest radius, near or far; also how far a near object is looked for"),
    ] = 16
    near_coverage: Annotated[
        float,
        Param(low=0.0, high=4.0, grad="smooth", source="G3D's depth of field (there 1.5)",
              meaning="gain on the opacity of the near field: above 1 its edges close up"),
    ] = 1.0
    edge: Annotated[
        float,
        Param(unit="px", low=0.1, high=8.0, scale="log", grad="smooth", source=_OURS,
              meaning="width of the soft rim of a circle"),
    ] = 1.0
    taps: Annotated[
        Literal["disc", "all"],
        Param(grad="discrete", source=_OURS,
              meaning="num_samples taps in a spiral, or each pixel within max_radius: exact, slow"),
    ] = "disc"
    num_samples: Annotated[
        int,
        Param(unit="taps", low=4, high=1024, scale="log", grad="discrete", source=_OURS,
              meaning='taps of each of the two gathers, for taps="disc"'),
    ] = 64
    tap_exponent: Annotated[
        float,
        Param(low=0.5, high=1.0, grad="weak", source=_OURS,
              meaning="0.5 spreads the taps evenly over the disc, more draws them to its center"),
    ] = 0.75
    noise: Annotated[
        NoiseKind,
        Param(grad="discrete", source=_OURS, meaning="turns the spiral from pixel to pixel"),
    ] = "gradient"
    seed: Annotated[
        int,
        Param(low=0, high=2**31 - 1, grad="discrete", source=_OURS,
              meaning="of the noise; give each frame of a sequence its own"),
    ] = 0
# fmt: on


class _Options(NamedTuple):
    near: bool
    window: int  # edge of the window in which each pixel is a tap; 0: the spiral


def depth_of_field(
    color: Tensor, depth: Tensor, config: DepthOfFieldConfig | None = None, **params: Any
) -> Tensor:
    """Blur what lies before and behind the focus.

    Each pixel S spreads its color over a disc of radius r_S, its circle of confusion, with the
    weight ``w = cover(r_S, d) / area(r_S)`` at the distance d. A pixel gathers from those whose
    disc reaches it:

    - far field: ``Σ w C / Σ w`` with the circle no larger than the pixel's own, so that what is
      sharp neither takes color from behind nor gives any;
    - near field: opacity ``α = sat(gain · Σ w)`` and color ``Σ w C / Σ w``, laid over the rest
      wherever the discs reach, over sharp pixels too;
    - behind a near pixel stands what its neighbors show of what is farther, the closest most.

    Args:
        color: Scene-linear, (B, 3, H, W).
        depth: Positive distance along the view axis, scene units, +inf allowed, (B, 1, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, (B, 3, H, W). Sharp pixels out of reach of the near field are bit for bit those of
        `color`; a constant color stays.

    Differentiable: in color and depth and the parameters that shape the circles. With
        ``taps="all"`` the gradient is exact; with the spiral it is that of the sum over taps
        held in place.
    Border: replicated.
    Reference: Guertin 2014, section 5, names Gilham (ShaderX5) for the circle by ramps; near
        field with coverage as in G3D. We differ from both: full resolution, one gather by
        scattered discs in place of blurred copies, hence no leak of sharp color into the far
        field, and a background behind near edges.
    Raises: ConfigError for a bad parameter, FrameError for a bad shape.
    """
    result: Tensor = DepthOfField(config, **params)(color, depth)
    return result


class DepthOfField(Effect):
    """Depth of field as a Module. See `depth_of_field`.

    `layers` returns "color", "circle" (signed radius in px, near negative, (B, 1, H, W)) and
    "near_alpha" (opacity of the near field, (B, 1, H, W)).

    Args:
        config: The parameters; the defaults if left out.
        engine: "eager", or "compiled" to compile the tap function (once, on the first call).
        **params: Single parameters by name, over those of `config`.
    """

    name = "depth_of_field"
    config_class = DepthOfFieldConfig

    def __init__(
        self, config: DepthOfFieldConfig | None = None, *, engine: Engine = "eager", **params: Any
    ) -> None:
        super().__init__(config, **params)
        self.engine: Engine = engine

    def layers(self, color: Tensor, depth: Tensor, **overrides: Any) -> dict[str, Tensor]:
        """Return "color", "circle" and "near_alpha"; arguments as for `depth_of_field`."""
        check_plane("color", color, 3)
        check_plane("depth", depth, 1, color)
        values, (color, depth) = self.prepare(overrides, color=color, depth=depth)
        return _layers(color, circle_of_confusion(depth, values), values, self.engine)

    def forward(self, color: Tensor, depth: Tensor, **overrides: Any) -> Tensor:
        """Return the blurred color, (B, 3, H, W); arguments as for `depth_of_field`."""
        return self.layers(color, depth, **overrides)["color"]


def circle_of_confusion(depth: Tensor, values: Values | DepthOfFieldConfig) -> Tensor:
    """Return the signed radius of the circle of confusion, px: near negative, far positive.

    Lens: ``R · (1 − z_f / z)`` with R the radius at infinity. Ramps: nothing within the focus
    range, then linear in depth to the full radius. Both end at ``max_radius``.

    Args:
        depth: Positive distance, scene units, +inf allowed, (B, 1, H, W).
        values: A `DepthOfFieldConfig`, or the values that a Module made of it.

    Returns:
        Radius in px, (B, 1, H, W).

    Differentiable: in depth and all parameters, but where the radius is at its end.
    """
    depth = depth.clamp(max=min(FAR_DEPTH, torch.finfo(depth.dtype).max / 4))
    if values.model == "lens":
        radius = values.infinity_radius * (1 - values.focus_distance / depth)
    else:
        behind = depth - values.focus_distance
        far = ((behind - values.focus_range) / values.far_ramp).clamp(0, 1)
        near = ((-behind - values.focus_range) / values.near_ramp).clamp(0, 1)
        radius = values.far_radius * far - values.near_radius * near
    return radius.clamp(-values.max_radius, values.max_radius)


def _layers(color: Tensor, circle: Tensor, values: Values, engine: Engine) -> dict[str, Tensor]:
    far_circle, near_circle = circle.clamp_min(0), (-circle).clamp_min(0)
    far = _gather(color, None, far_circle, far_circle.detach(), values, engine)
    behind = (far[0] + _OWN * color) / (far[1] + _OWN)
    behind = torch.where(far_circle > _SHARP_PX, behind, color)
    reach = _widest(near_circle.detach(), values.max_radius)
    sums = _gather(color, behind, near_circle, reach, values, engine)
    alpha = torch.where(reach > _SHARP_PX, values.near_coverage * sums[1], 0.0).clamp(0, 1)
    filled = (sums[2] + _OWN * color) / (sums[3] + _OWN)
    behind = torch.where(near_circle > _SHARP_PX, filled, behind)
    near = torch.where(sums[1] > _TINY, sums[0] / sums[1].clamp_min(_TINY), behind)
    return {"color": behind + alpha * (near - behind), "circle": circle, "near_alpha": alpha}


def _widest(radius: Tensor, reach: int) -> Tensor:
    """Return the widest circle within so many pixels to each side, (B, 1, H, W)."""
    rows = F.max_pool2d(radius, (1, 2 * reach + 1), 1, (0, reach))
    return F.max_pool2d(rows, (2 * reach + 1, 1), 1, (reach, 0))


def _gather(
    color: Tensor,
    behind: Tensor | None,
    circle: Tensor,
    reach: Tensor,
    values: Values,
    engine: Engine,
) -> tuple[Tensor, ...]:
    """Return the sums of one field; the near one has `behind`, and its sums beside."""
    x, y = pixel_grid(color)
    inputs = {
        "texture": torch.cat([color, circle] if behind is None else [color, circle, behind], 1),
        "x": x,
        "y": y,
        "circle": circle,
        "reach": reach + values.edge.detach() / 2,
        "turn": 2 * math.pi * noise_plane(values.noise, color, 0, values.seed),
        "edge": values.edge,
        "exponent": values.tap_exponent,
    }
    rim = math.ceil(float(values.edge.detach().max()) / 2)
    window = 2 * (values.max_radius + rim) + 1 if values.taps == "all" else 0
    num_samples = window**2 if window else values.num_samples
    return gather(_tap, _Options(behind is not None, window), num_samples, inputs, engine)


def _tap(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Planes | Tensor, ...]:
    dx, dy, distance, share = _position(index, count, inputs, options)
    planes = read(inputs, inputs["x"] + dx, inputs["y"] + dy)
    color, circle = planes[:3], planes[3]
    edge = inputs["edge"]
    area = (math.pi * (circle * circle + edge * edge / 12)).clamp_min(1)
    seen = circle if options.near else torch.minimum(circle, inputs["circle"])
    weight = share * ((seen - distance) / edge + 0.5).clamp(0, 1) / area
    if not options.near:
        return weighted(weight, color), weight
    weight = torch.where(circle > _SHARP_PX, weight, 0.0)
    # What is half as blurred, or less, lies behind a near pixel.
    farther = 2 * (1 - circle / inputs["circle"].clamp_min(_SHARP_PX))
    shown = share * farther.clamp(0, 1) / (1 + distance * distance)
    return weighted(weight, color), weight, weighted(shown, planes[4:]), shown


def _position(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return a tap's offset and distance, px, and the area that it stands for, px²."""
    if options.window:
        dx = torch.remainder(index, options.window) - options.window // 2
        dy = torch.div(index, options.window, rounding_mode="floor") - options.window // 2
        distance = (dx * dx + dy * dy).sqrt()
        return dx, dy, distance, (distance <= inputs["reach"]).to(distance.dtype)
    place, reach, exponent = (index + 0.5) / count, inputs["reach"], inputs["exponent"]
    distance = reach * place**exponent
    share = 2 * math.pi * reach * reach * exponent * place ** (2 * exponent - 1) / count
    angle = index * _GOLDEN_ANGLE + inputs["turn"]
    return distance * angle.cos(), distance * angle.sin(), distance, share
