"""A background that is known: what taps behind a pixel show, taken from the revealed layer.

Where a moving object lets through what it hides, the published filters guess it from what lies
beside the object; a frame with a `revealed` layer knows it. This is ours, and any filter whose
taps come from `sample` has it: weights and sums stay as they are, and only the color of a tap
that shows the background is no longer its own, but that of the revealed layer at the pixel, after
the layer's own blur.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import torch
from torch import Tensor

from torchblur.filters.base import FilterConfig, Values
from torchblur.frame import Frame
from torchblur.ops.gather import Inputs, read
from torchblur.params import Param

__all__ = [
    "RevealedBackgroundConfig",
    "background_share",
    "behind_slope",
    "layer_behind",
    "revealed_inputs",
    "share_behind",
]

_LEAST_STEP = 1e-4  # as a share of the depth: a layer that is nearer than this hides nothing


# fmt: off
class RevealedBackgroundConfig(FilterConfig):
    """Parameters of a filter that can take its background from the revealed layer."""

    background: Annotated[
        Literal["guessed", "revealed"],
        Param(grad="discrete", source="guessed: as published; revealed: torchblur, after Tan 2022",
              meaning="what objects let through: their surroundings, or the revealed layer"),
    ] = "guessed"
    background_depth: Annotated[
        float,
        Param(low=0.01, high=2.0, scale="log", grad="smooth", source="torchblur",
              active_when="background == revealed",
              meaning="share of the way from the pixel to the revealed layer behind it, in "
                      "1 / depth, from which a tap shows the background"),
    ] = 1.0
# fmt: on


def layer_behind(frame: Frame) -> tuple[Frame, Tensor]:
    """Return the revealed layer, and where it is known: 1 or 0, (B, 1, H, W).

    Raises: FrameError if the frame has none.
    """
    layer = frame.revealed
    if layer is None:
        frame.require("revealed")
    assert layer is not None
    valid = torch.ones_like(frame.color[:, :1]) if layer.valid is None else layer.valid
    return layer, valid.to(frame.dtype)


def behind_slope(frame: Frame, background_depth: float | Tensor) -> Tensor:
    """Return the share of a tap that shows the revealed layer, over ``1 − Z_p / Z_S``.

    Args:
        frame: The frame, with a `revealed` layer that has depth.
        background_depth: See `RevealedBackgroundConfig`.

    Returns:
        ``1 / (background_depth · (1 − Z_p / Z_R))``, Z_R being the depth of the layer at the
        pixel; 0 where the pixel hides nothing, or the layer is not valid, (B, 1, H, W).

    Differentiable: in both depths and in `background_depth`.
    Raises: FrameError if there is no revealed layer, or it has no depth.
    """
    layer, valid = layer_behind(frame)
    gap = _gap(frame, layer)
    known = (gap > _LEAST_STEP) & (valid > 0)
    slope = 1 / (background_depth * torch.where(known, gap, 1.0))
    return torch.where(known, slope, 0.0)


def _gap(frame: Frame, layer: Frame) -> Tensor:
    return 1 - frame.finite_depth() / layer.finite_depth()


def share_behind(slope: Tensor, pixel: Tensor, sample: Tensor) -> Tensor:
    """Return ``sat((1 − Z_p / Z_S) · slope)``: how far a tap shows what the pixel hides.

    Args:
        slope: From `behind_slope`.
        pixel: Z_p, depth of the pixel, scene units.
        sample: Z_S, depth of the tap, scene units.
    """
    return (slope * (1 - pixel / sample)).clamp(0, 1)


def revealed_inputs(
    frame: Frame, values: Values, blur: Callable[[Frame, Values], Tensor]
) -> Inputs:
    """Return the planes that let `sample` show the revealed layer; none for a guessed background.

    Args:
        frame: The frame, with a `revealed` layer that has depth.
        values: The filter's parameters.
        blur: The filter itself, which blurs the revealed layer: frame and values to color.

    Returns:
        "revealed_r", "revealed_g" and "revealed_b", the layer's blurred color; "open", 1 where the
        frame shows the layer itself and the layer has no holes, also as "texture_open"; "behind",
        the slope of `behind_slope`. Each (B, 1, H, W).

    Differentiable: in color, in the depth of both, and in `background_depth`.
    Raises: FrameError if there is no revealed layer, or it has no depth.
    """
    if values.background == "guessed":
        return {}
    layer, valid = layer_behind(frame)
    # A layer with holes is blurred from what there is of it, which would show beside the object.
    whole = valid.amin((1, 2, 3), keepdim=True)
    shown = torch.where(_gap(frame, layer) > _LEAST_STEP, 0.0, whole.expand_as(valid))
    color = blur(layer, Values(**(vars(values) | {"background": "guessed"})))
    red, green, blue = color.split(1, 1)
    return {
        "revealed_r": red,
        "revealed_g": green,
        "revealed_b": blue,
        "open": shown,
        "texture_open": shown,
        "behind": behind_slope(frame, values.background_depth),
    }


def background_share(inputs: Inputs, x: Tensor, y: Tensor, depth: Tensor) -> Tensor:
    """Return how far a tap shows the revealed layer, in [0, 1], (B, 1, H, W).

    At a pixel that hides the layer that is `share_behind`. At a pixel that shows it, it is 1 for
    all taps that show it too: what is left to the frame is the objects in front.

    Args:
        inputs: "depth", the pixel's, and the planes of `revealed_inputs`.
        x: Column of the tap, px.
        y: Row of the tap, px.
        depth: Z_S, the tap's depth, scene units.
    """
    behind = share_behind(inputs["behind"], inputs["depth"], depth)
    return behind + inputs["open"] * read(inputs, x, y, name="texture_open")[0]
