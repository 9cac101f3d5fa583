"""Front and back: how samples are told apart by depth, and what is made of a sum of each."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.places import num_pairs, tap_shift
from torchblur.filters.reconstruction import TEXTURE_COLOR
from torchblur.filters.spreads import Spread
from torchblur.frame import Frame
from torchblur.ops.cubic import second_differences
from torchblur.ops.gather import Inputs, Planes, components
from torchblur.ops.pixels import PixelList
from torchblur.ops.weights import DepthWeights, depth_weights, saturate

__all__ = [
    "Added",
    "Blurred",
    "Sums",
    "compose",
    "over_nothing",
    "sample_classes",
    "sum_planes",
    "tap_inputs",
]

_LEAST_SUM = 1e-30  # of weights: the gradient of a division by less is not finite
_TRACE = 1e-6  # weight per tap

Added = tuple[Planes, Tensor, Planes, Tensor, Tensor]
"""Color and weight of the back, color and weight of the front, and the front's alpha."""


class Sums(NamedTuple):
    """Means over the taps of one line (the colors by their weights; the last a maximum)."""

    background_color: Tensor
    background: Tensor
    foreground_color: Tensor
    foreground: Tensor
    alpha: Tensor
    """Foreground's alpha in [0, 1], (B, 1, H, W)."""
    influence: Tensor
    """Longest half spread of the taps with a weight, px, (B, 1, H, W)."""


class Blurred(NamedTuple):
    """What the main pass leaves: images or lists."""

    color: Tensor
    alpha: Tensor
    """Foreground's alpha, (B, 1, H, W)."""
    output_alpha: Tensor
    """How much of the color must replace the sharp one: 1 over a blurred background."""
    weight: Tensor
    """Mean weight of the taps, in [0, 1], (B, 1, H, W)."""
    influence: Tensor

    def images(self, frame: Frame, pixels: PixelList) -> Blurred:
        """Return images of the lists: all other pixels have their own color, and 0."""
        color, *planes = self
        return Blurred(pixels.unpack(color, over=frame.color), *(pixels.unpack(p) for p in planes))


class _ByDepth(Protocol):
    """Options that say how depths are compared."""

    @property
    def relative_depth(self) -> bool: ...

    @property
    def shares(self) -> bool: ...

    @property
    def softness(self) -> float: ...


def tap_inputs(
    frame: Frame,
    texture: Tensor,
    spread: Spread,
    pixels: PixelList,
    values: Values,
    parameters: Sequence[str],
) -> Inputs:
    """Return what taps look at, as lists of some pixels.

    Args:
        frame: Those pixels of the frame.
        texture: From `texture_of`, all pixels.
        spread: Half spreads of those pixels.
        pixels: The list.
        values: The parameters, those per pixel as lists.
        parameters: Names of those that the taps take as they are.
    """
    x, y = pixels.grid(frame.color)
    relative = values.depth_compare == "relative"
    inputs = {
        "texture": texture,
        "x": x,
        "y": y,
        "shift": tap_shift(frame.color, values, pixels),
        "depth": frame.finite_depth(),
        "extent": values.relative_depth_extent if relative else values.soft_depth_extent,
        **components("half", spread.half),
        "length": spread.length,
    }
    if values.color_lookup == "cubic":
        inputs["texture_detail"] = second_differences(texture[:, TEXTURE_COLOR:])
    return inputs | {key: getattr(values, key) for key in parameters}


def sample_classes(pixel: Tensor, other: Tensor, inputs: Inputs, options: _ByDepth) -> DepthWeights:
    """Return how far a sample is in front of a pixel, and behind it."""
    classes = depth_weights(
        pixel,
        other,
        inputs["extent"],
        relative=options.relative_depth,
        level=inputs["depth_level"],
        softness=options.softness,
    )
    return classes._replace(foreground=1 - classes.background) if options.shares else classes


def sum_planes(*parts: Planes) -> Planes:
    """Return the sums of the planes that stand at one place in each part."""
    return tuple(sum(planes[1:], planes[0]) for planes in zip(*parts, strict=True))


def compose(frame: Frame, lines: list[Sums], moving: Tensor, values: Values) -> Blurred:
    """Return the color of the main pass from the sums along one or two lines.

    Args:
        frame: The frame, for its color; all may be lists.
        lines: Sums along the first and, if there is one, the second direction.
        moving: Where the tile moves; elsewhere the color stays, bool, (B, 1, H, W).
        values: The parameters.
    """
    total = Sums(*(sum(planes[1:], planes[0]) for planes in zip(*lines, strict=True)))
    influence = functools.reduce(torch.maximum, (sums.influence for sums in lines))
    weights = (sums.background + sums.foreground for sums in lines)
    weight = functools.reduce(torch.maximum, weights)
    if values.separate_sums:
        alpha = _together([sums.alpha for sums in lines], values)
        color, alpha, output = _separate(frame, total, alpha, values)
    else:
        alpha = _together([sums.background + sums.foreground for sums in lines], values)
        color, alpha, output = _combined(frame, total, alpha)
    color = torch.where(moving, color, frame.color)
    planes = (torch.where(moving, p, 0.0) for p in (alpha, output, weight, influence))
    return Blurred(color, *planes)


def _together(alphas: list[Tensor], values: Values) -> Tensor:
    stacked = torch.stack(alphas)
    return stacked.amax(0) if values.alpha_combination == "max" else stacked.mean(0)


def _separate(
    frame: Frame, total: Sums, alpha: Tensor, values: Values
) -> tuple[Tensor, Tensor, Tensor]:
    """Return color, alpha and output alpha: foreground over background.

    With v for a valid background the whole is ``α fg + (1 − α) (v bg + (1 − v) sharp)``; what
    is not the sharp color leaves here, with its share ``α + v − α v``.
    """
    has_foreground = total.foreground > _LEAST_SUM
    foreground = total.foreground_color / torch.where(has_foreground, total.foreground, 1.0)
    alpha = torch.where(has_foreground, alpha, 0.0)
    center = values.center_weight / (2 * num_pairs(values))
    if frame.valid is not None:
        center = center * frame.valid.to(frame.dtype)
    weight = total.background + center
    background = total.background_color + center * frame.color
    background = background / torch.where(weight > _LEAST_SUM, weight, 1.0)
    blurred = (total.background > _LEAST_SUM).to(frame.dtype)
    if values.background_fade > 0:
        blurred = saturate(total.background / values.background_fade, values.softness)
    output = alpha + blurred * (1 - alpha)
    color = alpha * foreground + (1 - alpha) * blurred * background
    if values.resolution == "full":
        return color + (1 - output) * frame.color, alpha, output
    own = output > 0
    return torch.where(own, color / torch.where(own, output, 1.0), frame.color), alpha, output


def _combined(frame: Frame, total: Sums, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the same from one sum, over the pixel's own color."""
    weight = total.background + total.foreground
    some = weight > _LEAST_SUM
    blurred = (total.background_color + total.foreground_color) / torch.where(some, weight, 1.0)
    alpha = torch.where(some, alpha, 0.0)
    share = alpha
    if frame.valid is not None:  # an invalid pixel has no color of its own
        share = torch.where(frame.valid | ~some, alpha, 1.0)
    color = share * blurred + (1 - share) * frame.color
    return color, alpha, alpha


def over_nothing(sums: list[Sums], values: Values) -> list[Sums]:
    """Return the sums with the front opaque where there is no back."""
    background = torch.stack([one.background for one in sums]).sum(0)
    # Rounding leaves a trace of a back where something arrives at every time.
    shown = (background > _TRACE).to(background.dtype)
    if values.background_fade > 0:
        shown = saturate(background / values.background_fade, values.softness)
    return [one._replace(alpha=1 - (1 - one.alpha) * shown) for one in sums]
