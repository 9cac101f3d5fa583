"""Line blur: each pixel averages the color along its own velocity."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.parts.base import BlurFilter, FilterConfig, Values
from torchblur.filters.parts.cost import Cost, color_lookup
from torchblur.frame import LONGEST_SHUTTER, Frame, Shutter
from torchblur.ops.gather import (
    Engine,
    Inputs,
    Lookup,
    Planes,
    components,
    gather_lists,
    read,
    vector,
)
from torchblur.ops.pixels import PixelList
from torchblur.params import Param

__all__ = ["LineBlur", "LineConfig", "line"]


class LineConfig(FilterConfig):
    """Parameters of the line blur."""

    shutter: Annotated[
        float,
        Param(
            symbol="E",
            unit="frame",
            low=0.0,
            high=LONGEST_SHUTTER,
            grad="smooth",
            source="180 degree shutter = 0.5",
            meaning="open time of the shutter in frames; the length of the line",
        ),
    ] = 0.5
    num_samples: Annotated[
        int,
        Param(
            symbol="n",
            unit="taps",
            low=1,
            high=512,
            scale="log",
            grad="discrete",
            source="Rosado 2007",
            meaning="taps along the line, all of one weight",
        ),
    ] = 31
    lookup: Annotated[
        Lookup,
        Param(grad="discrete", source="Rosado 2007 (bilinear)", meaning="lookup of the color"),
    ] = "bilinear"


class _Options(NamedTuple):
    lookup: Lookup


def line(frame: Frame, config: LineConfig | None = None, **params: Any) -> Tensor:
    """Blur each pixel along its own velocity, with equal weights and without depth.

    ``out(p) = 1/n Σ_i C(p − s_i v(p))``, the s_i in the middles of n equal parts of the time the
    shutter is open.

    Where only depth and the camera's matrices are known, `ops.velocity.velocity_from_depth` gives
    the velocity of a still world.

    Args:
        frame: Color and velocity, (B, ·, H, W).
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color, velocity and shutter with bilinear lookups; in color only with
        nearest ones.
    Border: replicated.
    Reference: Rosado 2007 (GPU Gems 3, chapter 27). We differ: taps are centered in their parts,
        the line is centered on the pixel unless the shutter is not, and its length is the
        shutter's share of the velocity (the listing steps by the whole of it for each tap).
    Raises: ConfigError for a bad parameter.
    """
    result: Tensor = LineBlur(config, **params)(frame)
    return result


class LineBlur(BlurFilter):
    """Line blur along each pixel's own velocity (Rosado 2007).

    The blur stays inside silhouettes, as nothing is dilated: the baseline that every other
    filter has to beat. See `line` for the formula.
    """

    name = "line"
    published = False
    config_class = LineConfig
    per_frame = ()

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        taps = config.num_samples
        return Cost(taps, taps * color_lookup(config.lookup), passes=1)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return the blurred "color"."""
        return {"color": _blur(frame, values, self.engine)}


def _blur(frame: Frame, values: Values, engine: Engine) -> Tensor:
    pixels = _moving_pixels(frame)
    if pixels.count == 0:
        return frame.color
    x, y = pixels.grid(frame.color)
    center = float(Shutter(1, values.shutter_position).center)
    color = pixels.pack(frame.color)
    inputs = {
        "texture": frame.color,
        **components("half", pixels.pack(frame.velocity) * (pixels.pack(values.shutter) * 0.5)),
        "x": x,
        "y": y,
        "center": frame.color.new_full((), center),
    }
    if frame.valid is not None:
        valid = frame.valid.to(frame.dtype)
        inputs["texture"] = torch.cat((frame.color * valid, valid), 1)
    total, weight = gather_lists(
        _tap, _Options(values.lookup), values.num_samples, inputs, pixels, engine
    )
    blurred = torch.where(weight > 0, total / torch.where(weight > 0, weight, 1.0), color)
    return pixels.unpack(blurred, over=frame.color)


def _moving_pixels(frame: Frame) -> PixelList:
    """Return the pixels that move, and those of no validity; all if a gradient may be wanted."""
    if torch.is_grad_enabled():
        return PixelList.all(frame.color)
    wanted = (frame.velocity != 0).any(1, keepdim=True)
    if frame.valid is not None:
        wanted = wanted | ~frame.valid
    return PixelList.where(wanted)


def _tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Options) -> tuple[Planes, Tensor]:
    # Time in units of half the open interval, measured from the frame: -1 .. 1 if centered.
    time = (2 * index + 1) / count - 1 + inputs["center"]
    dx, dy = vector(inputs, "half")
    planes = read(inputs, inputs["x"] - time * dx, inputs["y"] - time * dy, options.lookup)
    # The fourth plane is the validity, by which the color is multiplied already.
    return planes[:3], planes[3] if len(planes) == 4 else torch.ones_like(planes[0])
