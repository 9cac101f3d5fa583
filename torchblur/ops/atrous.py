"""Sums over a 5x5 kernel, weighted by the paths of the samples: split, accumulate, à-trous.

All work on lists of pixels (`ops.points`) and look up in whole planes. Memory does not grow with
the taps, as they go through `ops.taps`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.ops.gather import Lookup
from torchblur.ops.points import Points, flat, nearest_index
from torchblur.ops.segments import path_weight
from torchblur.ops.taps import Engine, Inputs, sum_taps

__all__ = [
    "Centers",
    "Footprint",
    "Kernel",
    "Samples",
    "Sums",
    "Widths",
    "footprint",
    "kernel_taps",
    "path_sums",
    "plain_sums",
    "split_sums",
]

Kernel = Literal["b3", "box"]
"""B3 spline, ``[1, 4, 6, 4, 1] / 16`` in each direction, or all weights alike."""

_LEAST_PART = 1e-4  # of W between pixels; less may be rounding of a position on a pixel
_ROWS = {"b3": (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16), "box": (0.2,) * 5}


def kernel_taps(kernel: Kernel, like: Tensor, *, center_only: bool = False) -> Tensor:
    """Return the taps of the kernel: column, row, and weight h; the weights sum to 1.

    Args:
        kernel: Which.
        like: A tensor of the wanted type and device.
        center_only: Only the tap in the middle, of weight 1.

    Returns:
        (25, 3) or (1, 3), row by row.
    """
    if center_only:
        return like.new_tensor([[0.0, 0.0, 1.0]])
    row = _ROWS[kernel]
    taps = [(i - 2, j - 2, row[i] * row[j]) for j in range(5) for i in range(5)]
    return like.new_tensor(taps)


class Samples(NamedTuple):
    """One sample per pixel, as planes."""

    values: Tensor
    """What is filtered: color (any number C of planes), then velocity u (2), then time t (1),
    (B, C + 3, H, W)."""
    displacement: Tensor
    """v, over the shutter, px, (B, 2, H, W)."""
    depth: Tensor
    """Scene units, finite, (B, 1, H, W)."""
    moving: Tensor
    """1 where the sample moves and can be trusted, else 0, (B, 1, H, W)."""
    static: Tensor
    """1 where it is still and can be trusted, else 0, (B, 1, H, W)."""


class Sums(NamedTuple):
    """Sums of both channels for a list of pixels: values times weights, and the weights."""

    moving: Tensor
    """Color, u and t, (C + 3, N)."""
    moving_weight: Tensor
    """(1, N)."""
    static: Tensor
    """Color, (C, N)."""
    static_weight: Tensor
    """(1, N)."""


class Widths(NamedTuple):
    """How far the weights reach."""

    width: Tensor
    """c of each pixel, px, (1, N)."""
    softness: Tensor
    """e of `path_weight`, 0-d or (1, N)."""


class Centers(NamedTuple):
    """What is known of the pixels themselves, (1, N) each."""

    moving: Tensor
    """1 where the pixel's own sample moves, else 0."""
    keep: Tensor
    """1 where the pixel keeps its own static sample unfiltered, else 0."""
    depth: Tensor
    """Z_p, scene units, finite."""
    extent: Tensor
    """Depth difference over which what lies behind fades, scene units."""


class _Split(NamedTuple):
    colors: int


def split_sums(
    samples: Samples,
    points: Points,
    taps: Tensor,
    widths: Widths,
    centers: Centers,
    engine: Engine = "eager",
) -> Sums:
    """Return the sums of moving and of still samples around each pixel: the first stage.

    A moving sample has the weight ``h w(p, q)``, times the depth test
    ``d = sat(1 + (Z_p − Z_q) / E)`` where p is still; a still one ``h``.

    Args:
        samples: Planes of one sample per pixel.
        points: The pixels to filter.
        taps: From `kernel_taps`.
        widths: Reach of the weights.
        centers: The pixels' own data.
        engine: See `ops.taps`.

    Differentiable: in all floating planes and in the widths.
    Border: replicated; a replicated sample is where it is, not where the tap is.
    Reference: Oberberger 2022, section 4.3, First Stage. We differ: the depth test, which the
        paper does not give, is a ramp; and see `path_weight`.
    """
    colors = samples.values.shape[1] - 3
    inputs = {"texture": flat(torch.cat(samples, 1)), "taps": taps}
    inputs |= points.inputs() | widths._asdict() | centers._asdict()
    return Sums(*sum_taps(_split_tap, _Split(colors), taps.shape[0], inputs, engine))


def _split_tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Split) -> tuple[Tensor, ...]:
    ox, oy, share = inputs["taps"].index_select(0, index.long().reshape(1))[0]
    row, x, y = nearest_index(inputs["x"] + ox, inputs["y"] + oy, inputs)
    values, vx, vy, depth, moving, static = _parts(inputs["texture"].index_select(1, row))
    offset = (inputs["x"] - x, inputs["y"] - y)
    weight = path_weight(offset, (vx, vy), values[-1:], inputs["width"], inputs["softness"])
    shown = (1 + (inputs["depth"] - depth) / inputs["extent"]).clamp(0, 1)
    shown = torch.where(inputs["moving"] > 0, 1.0, shown)
    moving = share * moving * weight * shown
    middle = ((ox == 0) & (oy == 0)).to(static.dtype)
    static = torch.where(inputs["keep"] > 0, middle, share) * static
    return moving * values, moving, static * values[: options.colors], static


def _parts(planes: Tensor) -> tuple[Tensor, ...]:
    """Split planes (K + 5, N) into the values (K) and the last five."""
    last = planes.shape[0] - 5
    return planes[:last], *(planes[last + i : last + i + 1] for i in range(5))


class Footprint(NamedTuple):
    """How the kernel is turned and stretched at each pixel, (1, N) each."""

    cos: Tensor
    sin: Tensor
    step_x: Tensor
    """Distance of taps along the motion, px."""
    step_y: Tensor
    """Across it, px."""


def footprint(
    angle: Tensor | None,
    length: Tensor,
    angle_variance: Tensor,
    divisor: Tensor,
    least: Tensor,
    across: float = 1.0,
) -> Footprint:
    """Return the kernel of one pass of the second stage: along the motion, as long as it.

    ``s_x = max(least, l / divisor)``, ``s_y = lerp(across, s_x, σ²_θ)``.

    Args:
        angle: Mean angle of the motion, radians, (1, N); None does not turn the kernel.
        length: l, mean length of the motion over the shutter, px, (1, N).
        angle_variance: σ²_θ in [0, 1], (1, N).
        divisor: 5 · 2^(n−i) for pass i of n.
        least: Least step along the motion, px.
        across: Step across a motion of one angle, px; 0 makes a line of the kernel.

    Reference: Oberberger 2022, section 4.3, Second Stage. We differ: the least step, without
        which all taps of slow motion fall on the pixel itself; 0 is the text's way.
    """
    step_x = torch.maximum(length / divisor, torch.as_tensor(least).expand_as(length))
    step_y = across + (step_x - across) * angle_variance
    turn = torch.zeros_like(length) if angle is None else angle
    return Footprint(turn.cos(), turn.sin(), step_x, step_y)


def _unit(points: Points) -> Footprint:
    one, zero = torch.ones_like(points.x), torch.zeros_like(points.x)
    return Footprint(one, zero, one, one)


class _Path(NamedTuple):
    lookup: Lookup


def path_sums(
    texture: Tensor,
    points: Points,
    taps: Tensor,
    widths: Widths,
    shape: Footprint | None = None,
    lookup: Lookup = "nearest",
    engine: Engine = "eager",
) -> tuple[Tensor, Tensor]:
    """Return sums over the kernel with the weights ``h W(q) w(p, q)``.

    One pass of the second stage with a footprint, the accumulation of the history without.

    Args:
        texture: Values as in `Samples.values` (K planes), v over the shutter (2), and the weight
            W of each (1; 0 where there is none), (B, K + 3, H, W).
        points: The pixels to filter; they need not lie on a pixel.
        taps: From `kernel_taps`.
        widths: Reach of the weights.
        shape: How the kernel is turned and stretched; None: not at all.
        lookup: "nearest" rounds the taps' displacements to whole pixels. "bilinear" interpolates
            values times W, and W.
        engine: See `ops.taps`.

    Returns:
        Sums of the values (K, N) and of the weights (1, N).

    Differentiable: in the texture and the widths; in the footprint with "bilinear" only.
    Border: replicated; the weight is that of the position inside the image.
    Reference: Oberberger 2022, sections 4.3 and 4.4.
    """
    if shape is None:
        shape = _unit(points)
    if lookup == "bilinear":
        texture = torch.cat((texture[:, :-1] * texture[:, -1:], texture[:, -1:]), 1)
    inputs = {"texture": flat(texture), "taps": taps}
    inputs |= points.inputs() | widths._asdict() | shape._asdict()
    values, weight = sum_taps(_path_tap, _Path(lookup), taps.shape[0], inputs, engine)
    return values, weight


def _displaced(i: Tensor, j: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Return how far from the center a tap of a turned and stretched kernel lies, px."""
    along, across = i * inputs["step_x"], j * inputs["step_y"]
    dx = inputs["cos"] * along - inputs["sin"] * across
    return dx, inputs["sin"] * along + inputs["cos"] * across


def _path_tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Path) -> tuple[Tensor, ...]:
    i, j, share = inputs["taps"].index_select(0, index.long().reshape(1))[0]
    dx, dy = _displaced(i, j, inputs)
    if options.lookup == "nearest":
        row, x, y = nearest_index(inputs["x"] + dx.round(), inputs["y"] + dy.round(), inputs)
        planes = inputs["texture"].index_select(1, row)
        values, weight = planes[:-1], planes[-1:]
    else:
        planes, x, y = _bilinear(inputs["x"] + dx, inputs["y"] + dy, inputs)
        weight = torch.where(planes[-1:] > _LEAST_PART, planes[-1:], 0.0)
        values = planes[:-1] / torch.where(weight > 0, weight, 1.0)
    offset = (inputs["x"] - x, inputs["y"] - y)
    values, velocity = values[:-2], (values[-2:-1], values[-1:])
    passed = path_weight(offset, velocity, values[-1:], inputs["width"], inputs["softness"])
    weight = share * weight * passed
    return weight * values, weight


def _bilinear(x: Tensor, y: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor, Tensor]:
    """Return interpolated columns of the texture, and the position inside the image."""
    size = inputs["size"]
    x = torch.minimum(x.clamp(min=0), size[0] - 1)
    y = torch.minimum(y.clamp(min=0), size[1] - 1)
    left, top = x.floor().detach(), y.floor().detach()
    u, v = x - left, y - top
    total = torch.zeros_like(inputs["texture"][:, :1])
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        row, _, _ = nearest_index(left + i, top + j, inputs)
        part = (u if i else 1 - u) * (v if j else 1 - v)
        total = total + inputs["texture"].index_select(1, row) * part
    return total, x, y


def plain_sums(
    texture: Tensor,
    points: Points,
    taps: Tensor,
    keep: Tensor,
    shape: Footprint | None = None,
    lookup: Lookup = "nearest",
    engine: Engine = "eager",
) -> tuple[Tensor, Tensor]:
    """Return sums over the kernel with the weights ``h W(q)``, without any other test.

    Args:
        texture: Values (K planes) and the weight W of each (1), (B, K + 1, H, W).
        points: The pixels to filter.
        taps: From `kernel_taps`.
        keep: 1 where only the pixel itself counts, with ``W``, else 0, (1, N).
        shape: How the kernel is turned and stretched; None: not at all.
        lookup: As in `path_sums`.
        engine: See `ops.taps`.

    Returns:
        Sums of the values (K, N) and of the weights (1, N).

    Differentiable: in the texture; in the footprint with "bilinear" only.
    Border: replicated.
    Reference: Oberberger 2022, section 4.4 (the static channel of the history); with a footprint
        ours, for the opacity.
    """
    if shape is None:
        shape = _unit(points)
    texture = torch.cat((texture[:, :-1] * texture[:, -1:], texture[:, -1:]), 1)
    inputs = {"texture": flat(texture), "taps": taps, "keep": keep}
    inputs |= points.inputs() | shape._asdict()
    values, weight = sum_taps(_plain_tap, _Path(lookup), taps.shape[0], inputs, engine)
    return values, weight


def _plain_tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Path) -> tuple[Tensor, ...]:
    i, j, share = inputs["taps"].index_select(0, index.long().reshape(1))[0]
    dx, dy = _displaced(i, j, inputs)
    if options.lookup == "nearest":
        row, _, _ = nearest_index(inputs["x"] + dx.round(), inputs["y"] + dy.round(), inputs)
        planes = inputs["texture"].index_select(1, row)
    else:
        planes, _, _ = _bilinear(inputs["x"] + dx, inputs["y"] + dy, inputs)
    middle = ((i == 0) & (j == 0)).to(planes.dtype)
    planes = planes * torch.where(inputs["keep"] > 0, middle, share)
    return planes[:-1], planes[-1:]
