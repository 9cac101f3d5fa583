"""The post-filter of the 2025 notes: a second pass that fills the gaps between the taps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.front_back import Blurred
from torchblur.filters.notes2025_gather import Line
from torchblur.filters.places import num_pairs
from torchblur.filters.reach import tap_counts
from torchblur.frame import Frame
from torchblur.ops.gather import (
    Engine,
    Inputs,
    Planes,
    components,
    gather,
    pixel_grid,
    read,
    vector,
    weighted,
)
from torchblur.ops.pixels import PixelList
from torchblur.ops.velocity import direction, length
from torchblur.ops.weights import saturate

__all__ = ["post_filter"]

_ROUNDING = 1e-6  # counted alphas differ by exactly the threshold: rounding must not decide


class _Options(NamedTuple):
    soft: bool


def post_filter(
    frame: Frame, image: Blurred, lines: list[Line], values: Values, engine: Engine
) -> Blurred:
    """Blur color and output alpha over the gap between two taps, without mixing alphas.

    A sample counts if its alpha is within a threshold of the pixel's, unless neither has any;
    at the outer edge of a blur, where the largest alpha is above 0 but below the threshold, also
    then. The samples of all lines go into one mean.

    Args:
        frame: The frame, for its validity.
        image: What the main pass left.
        lines: The directions that the main pass sampled.
        values: The parameters.
        engine: Of the gather.

    Returns:
        The image with another color and output alpha.

    Differentiable: in color; in alphas and thresholds with `post_acceptance` "soft".
    Border: replicated.
    Reference: 2025 notes, Post-Filter. We differ: taps lie in the middle of equal parts of the
        radius (the text starts at an unsaid place), and the pixel itself has a weight, so that
        the weights are never all zero.
    """
    inputs = _inputs(frame, image, lines[0], values)
    options = _Options(values.post_acceptance == "soft")
    along = [_along(line, inputs, options, values, engine) for line in lines]
    sums = [sum(planes[1:], planes[0]) for planes in zip(*along, strict=True)]
    own = values.post_center_weight * inputs["texture"][:, 5:6]
    center = torch.cat((inputs["texture"][:, :3], inputs["texture"][:, 4:5]), 1)
    peak = torch.stack([planes[4] for planes in along]).amax(0).maximum(inputs["alpha"])
    inner, outer = (_mean(sums[i], sums[i + 1], center, own) for i in (0, 2))
    color, output = inner.split((3, 1), 1)
    if values.post_edges:
        edge = _is_edge(peak, inputs, options)
        color, output = torch.lerp(inner, outer, edge.expand_as(inner)).split((3, 1), 1)
    moving = torch.stack([line.used for line in lines]).any(0)
    return image._replace(
        color=torch.where(moving, color, image.color),
        output_alpha=torch.where(moving, output, image.output_alpha),
    )


def _inputs(frame: Frame, image: Blurred, first: Line, values: Values) -> Inputs:
    x, y = pixel_grid(frame.color)
    alpha = image.alpha if values.post_alpha == "foreground" else image.output_alpha
    usable = torch.ones_like(alpha)
    if frame.valid is not None:
        usable = (frame.valid | (image.weight > 0)).to(frame.dtype)
    pairs = _pairs(first, values)
    return {
        "texture": torch.cat(_alike(image.color, alpha, image.output_alpha, usable), 1),
        "x": x,
        "y": y,
        "alpha": alpha,
        "threshold": values.post_threshold / pairs,
        "tau": values.post_tau / pairs,
        "zero": values.post_zero_alpha,
    }


def _pairs(line: Line, values: Values) -> Tensor:
    """Return how many pairs of taps lie along a line, those that are doubled counted once."""
    return tap_counts(values, length(line.vector), num_pairs(values))


def _alike(*planes: Tensor) -> Planes:
    """Return the planes with one batch: what no set of parameters changes is there once."""
    batch_size = max(plane.shape[0] for plane in planes)
    return tuple(plane.expand(batch_size, -1, -1, -1) for plane in planes)


def _along(
    line: Line, shared: Inputs, options: _Options, values: Values, engine: Engine
) -> tuple[Tensor, ...]:
    """Return color and weight of the samples along a line, inside and at an edge, and the peak."""
    gap = length(line.vector) / _pairs(line, values)
    most = max(values.post_samples // 2, 1)
    inputs = shared | {
        **components("unit", direction(line.vector)),
        "radius": values.post_radius * gap,
        "per_side": gap.detach().ceil().clamp(1, most),
        "used": line.used.to(gap.dtype),
    }
    active = PixelList.where(line.used.expand(inputs["texture"].shape[0], -1, -1, -1))
    return gather(_post_tap, options, 2 * most, inputs, engine, num_maxima=1, active=active)


def _mean(colors: Tensor, weight: Tensor, center: Tensor, own: Tensor) -> Tensor:
    total = weight + own
    some = total > 0
    return torch.where(some, (colors + own * center) / torch.where(some, total, 1.0), center)


def _is_edge(peak: Tensor, inputs: Inputs, options: _Options) -> Tensor:
    if options.soft:
        return saturate(peak / inputs["zero"]) * torch.exp(-((peak / inputs["tau"]) ** 2))
    return ((peak > inputs["zero"]) & (peak <= inputs["threshold"] + _ROUNDING)).to(peak.dtype)


def _post_tap(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Planes, Tensor, Planes, Tensor, Tensor]:
    """Return color and weight of a sample, twice, and its alpha; even ones lie ahead."""
    place = torch.floor(index / 2)
    side = 1 - 2 * torch.remainder(index, 2)
    step = side * inputs["radius"] * (place + 0.5) / inputs["per_side"]
    dx, dy = (part * step for part in vector(inputs, "unit"))
    red, green, blue, alpha, output, usable = read(inputs, inputs["x"] + dx, inputs["y"] + dy)
    accepted, alive = _accept(alpha, inputs, options)
    taken = inputs["used"] * (place < inputs["per_side"])
    outer = taken * usable * accepted
    inner = outer * alive
    rgba = red, green, blue, output
    return weighted(inner, rgba), inner, weighted(outer, rgba), outer, alpha * taken


def _accept(alpha: Tensor, inputs: Inputs, options: _Options) -> tuple[Tensor, Tensor]:
    """Return how well a sample's alpha fits the pixel's, and whether one of the two has any."""
    difference = alpha - inputs["alpha"]
    larger = torch.maximum(alpha, inputs["alpha"])
    if options.soft:
        bell = torch.exp(-((difference / inputs["tau"]) ** 2))
        return bell, saturate(larger / inputs["zero"])
    accepted = difference.abs() <= inputs["threshold"] + _ROUNDING
    return accepted.to(alpha.dtype), (larger > inputs["zero"]).to(alpha.dtype)
