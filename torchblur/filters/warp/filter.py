"""A forward warp: every pixel is splatted to where it is at each of many moments."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.filters.parts.base import BlurFilter, Values
from torchblur.filters.parts.cost import TWO_SUMS, Cost
from torchblur.filters.parts.revealed import layer_behind
from torchblur.filters.warp.config import WarpConfig
from torchblur.frame import Frame, Shutter
from torchblur.ops.gather import pixel_grid
from torchblur.ops.splat import Marks, composite, footprints
from torchblur.ops.surfaces import (
    Hidden,
    clean_planes,
    depth_step,
    gradients,
    guess_behind,
    local_range,
    second_differences,
)
from torchblur.ops.taps import Inputs, sum_taps

__all__ = ["WarpBlur", "WarpConfig", "warp"]

_STILL_PX = 1e-3
_LEAST_STEP = 1e-4  # as a share of the depth: a layer that is nearer than this hides nothing
_STRETCH = (0.25, 16.0)  # range of the factor by which a splat may shrink or grow, in area
_COLOR, _MOTION, _INVERSE = slice(0, 3), slice(3, 7), slice(7, 8)


class _Options(NamedTuple):
    height: int
    width: int
    center: int
    supersampling: int


class _Field(NamedTuple):
    """Which pixels the motion can change, over a batch laid flat, (B · H · W,)."""

    pixels: Tensor
    """Their numbers, (T,)."""
    slot: Tensor
    """Number of each pixel among them; T for the others, (B · H · W + 1,)."""
    shape: torch.Size


def warp(frame: Frame, config: WarpConfig | None = None, **params: Any) -> Tensor:
    """Blur by moving each pixel of the sharp frame along its path, moment by moment.

    At the time t of each of k moments in the middles of k equal parts of the open shutter, the
    pixel p goes to ``p + v t + a t² / 2`` as a square of one pixel, which shares itself out to the
    four pixels that it touches. There the nearest surface lies over the next one:

    ``f_i = exp(−max(z_i − σ ∂z_i − z_min, 0) / (ε z_min))``, ``α = min(γ Σ b_i J_i f_i, 1)``

    with the share b of the splat, z_min the least depth at the pixel, the change ∂z of the
    surface's own depth per px, and ``J = 1 + t div v + t² det ∇v``, by which the surface has
    grown. The second layer has the same form with 1 − f. What lies behind, and comes out while
    the shutter is open, are splats too: `guessed` continues the surfaces beside an edge behind
    what hides them, with their motion, and takes its color beside the pixels that mix two;
    `revealed` takes the revealed layer where it is valid. What neither reaches is filled with
    the pixel's mean over the moments that something reached, and `own_weight` times its sharp
    color. The blur of a bilinear splat, ``½ d (1 − d) ∂²C`` at a fraction d, is taken off the
    color, within the range of the pixel and its neighbors.

    It answers what one frame with its vectors can give at best; it costs several times a gather.

    Args:
        frame: Color, depth and velocity, (B, ·, H, W); `acceleration` bends the paths.
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W).

    Differentiable: in color; in depth, velocity, acceleration and every smooth parameter through
        the weights. Which surface is behind which edge is a choice (`depth_gap`), without a
        gradient. The gradient in velocity is that of a bilinear splat: it sees one pixel far, has
        a kink where a splat lies on whole pixels, and what does not move at all (less than 1/1000
        px, and nothing that moves near it) has none. Memory does not grow with the number of
        moments: the backward pass computes each again.
    Border: what comes in from outside is not known; a pixel shows the mean over the moments at
        which something is known.
    Energy: a splat that moves as a whole keeps its sum; where splats cover each other, or a pixel
        is filled, the pixel is a weighted mean of colors, so that a constant color stays and no
        result lies outside the colors of the frame.
    Reference: ours; soft depth tests of splats are common (softmax splatting, Niklaus 2020).
        Limits: with fewer moments than the path has px, copies show instead of a blur. Only two
        layers count at a pixel and moment. Edge pixels whose color mixes front and back move
        with one of them; surfaces seen through others are not known.
    Raises: ConfigError for a bad parameter, FrameError if the frame has no depth, or no revealed
        layer with depth when that is asked for.
    """
    result: Tensor = WarpBlur(config, **params)(frame)
    return result


class WarpBlur(BlurFilter):
    """The forward warp: what one frame with its vectors can give at best.

    See `warp` for the formula. `layers` adds "coverage" (share of the moments at which something
    reached the pixel, (B, 1, H, W)), "behind" (color of what lies behind the pixel, 0 where
    nothing is known, (B, 3, H, W)) and "behind_known" (1 or 0, (B, 1, H, W)). The lists of splats
    have another length in each frame, so that nothing is compiled: every engine is the eager one.
    """

    name = "warp"
    published = False
    config_class = WarpConfig

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        # The marks of all splats at all moments, four each, and what is made ready for them.
        marks = 4 * config.num_samples * config.supersampling**2
        ready = Cost(passes=4 if config.background == "none" else 10)
        return ready + Cost(marks, marks, marks * TWO_SUMS, passes=1)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return "color", "coverage" and what lies behind."""
        return _layers(frame, values)


def _layers(frame: Frame, values: Values) -> dict[str, Tensor]:
    frame.require("depth")
    path = _path(frame, values)
    longest = _longest(path, values)
    field = _field(longest)
    hidden = _hidden(frame, path, values, longest)
    layers = {
        "color": frame.color,
        "coverage": torch.ones_like(frame.color[:, :1]),
        "behind": _image(hidden.pixels, hidden.values[:, _COLOR], frame.color),
        "behind_known": _image(
            hidden.pixels, torch.ones_like(hidden.values[:, :1]), frame.color[:, :1]
        ),
    }
    if field.pixels.numel() == 0:
        return layers
    inputs = _own_splats(frame, path, field, values)
    inputs = _joined(inputs, _hidden_splats(hidden, field, values, frame))
    inputs |= _targets(field, values, frame)
    options = _Options(
        *frame.size, Shutter(1, values.shutter_position).center, values.supersampling
    )
    color, coverage = sum_taps(_moment, options, values.num_samples, inputs)
    color, coverage = color / values.num_samples, coverage / values.num_samples
    own = _rows(frame.color)[field.pixels].T
    weight = (
        _listed(values.own_weight, field.pixels, frame) * _valid(frame).reshape(-1)[field.pixels]
    )
    total = coverage[:, :-1] + weight
    fill = (color[:, :-1] + weight * own) / torch.where(total > 0, total, 1.0)
    fill = torch.where(total > 0, fill, own)
    filled = color[:, :-1] + (1 - coverage[:, :-1]) * fill
    moved = _image(field.pixels, torch.cat((filled, coverage[:, :-1])).T, frame.color)
    touched = (field.slot[:-1] < field.pixels.numel()).view_as(layers["coverage"])
    layers["color"] = torch.where(touched, moved[:, :3], frame.color)
    layers["coverage"] = torch.where(touched, moved[:, 3:], layers["coverage"])
    return layers


# -- one moment --------------------------------------------------------------------------------


def _moment(
    index: Tensor, count: Tensor, inputs: Inputs, options: _Options
) -> tuple[Tensor, Tensor]:
    """Return color times coverage, and coverage, of all targets at one moment."""
    time = inputs["shutter"] * ((index + 0.5) / count + (options.center - 1) / 2)
    vx, vy, ax, ay = inputs["motion"]
    half = time * time / 2
    x = inputs["place"][0] + vx * time + ax * half
    y = inputs["place"][1] + vy * time + ay * half
    shares = inputs["mass"] * _growth(inputs, time)
    marks = _marks(x, y, time, inputs, options)
    mapped = torch.where(marks.target < 0, inputs["slot"].numel() - 1, marks.target + inputs["row"])
    target = inputs["slot"].index_select(0, mapped.flatten()).view_as(mapped)
    return tuple(  # type: ignore[return-value]
        composite(
            Marks(target, marks.share * shares),
            _sharpened(x, y, inputs),
            (inputs["depth"], inputs["near"]),
            inputs["empty"],
            inputs["extent"],
            inputs["gain"],
        )
    )


def _growth(inputs: Inputs, time: Tensor) -> Tensor:
    """Return by how much a surface has grown in area: det(1 + t ∇v)."""
    xx, yx, xy, yy = inputs["gradient"]
    change = time * (xx + yy) + time * time * (xx * yy - xy * yx)
    grown: Tensor = (1 + inputs["stretch"] * change).clamp(*_STRETCH)
    return grown


def _marks(x: Tensor, y: Tensor, time: Tensor, inputs: Inputs, options: _Options) -> Marks:
    """Return the marks of all parts of all splats, (4 s², M); parts move with the gradient."""
    count, size = options.supersampling, (options.height, options.width)
    width = inputs["footprint"] / count
    if count == 1:
        return footprints(x, y, size, width)
    xx, yx, xy, yy = inputs["gradient"]
    targets, shares = [], []
    for row in range(count):
        for column in range(count):
            dx, dy = (column + 0.5) / count - 0.5, (row + 0.5) / count - 0.5
            at_x = x + dx + time * (dx * xx + dy * xy)
            at_y = y + dy + time * (dx * yx + dy * yy)
            marks = footprints(at_x, at_y, size, width)
            targets.append(marks.target)
            shares.append(marks.share / count**2)
    return Marks(torch.cat(targets), torch.cat(shares))


def _sharpened(x: Tensor, y: Tensor, inputs: Inputs) -> Tensor:
    """Return the colors less the blur that a bilinear splat at x, y adds."""
    dx, dy = x - x.detach().floor(), y - y.detach().floor()
    along_x, along_y = inputs["bend"].split(3)
    blur = (dx * (1 - dx) * along_x + dy * (1 - dy) * along_y) / 2
    color: Tensor = inputs["color"] - inputs["sharpening"] * blur
    return torch.minimum(torch.maximum(color, inputs["low"]), inputs["high"])


# -- what moves, and how far -------------------------------------------------------------------


def _path(frame: Frame, values: Values) -> Tensor:
    """Return velocity and acceleration, (B, 4, H, W), px/frame and px/frame²."""
    bend = frame.acceleration if values.curved else None
    return torch.cat(
        (frame.velocity, torch.zeros_like(frame.velocity) if bend is None else bend), 1
    )


@torch.no_grad()
def _longest(path: Tensor, values: Values) -> Tensor:
    """Return how far a pixel goes from its place, at most, along x or y, px, (B, 1, H, W)."""
    ends = [abs(t) for t in Shutter(1, values.shutter_position).interval]
    time = max(ends) * torch.as_tensor(values.shutter)
    reach = path[:, :2].abs() * time + path[:, 2:].abs() * (time * time / 2)
    return reach.amax(1, keepdim=True)


@torch.no_grad()
def _field(longest: Tensor) -> _Field:
    """Return the pixels that something moving can touch, or uncover."""
    reach = math.ceil(float(longest.max())) + 1
    grown = (longest > _STILL_PX).to(torch.float32)
    for axis in (2, 3):
        side = min(reach, longest.shape[axis] - 1)
        kernel = (2 * side + 1, 1) if axis == 2 else (1, 2 * side + 1)
        grown = F.max_pool2d(F.pad(grown, _padding(side, axis)), kernel, stride=1)
    touched = grown.flatten() > 0
    index = touched.nonzero().flatten()
    slot = torch.full((touched.numel() + 1,), index.numel(), device=index.device)
    slot[index] = torch.arange(index.numel(), device=index.device)
    return _Field(index, slot, longest.shape)


def _padding(side: int, axis: int) -> tuple[int, ...]:
    return (0, 0, side, side) if axis == 2 else (side, side, 0, 0)


# -- what lies behind --------------------------------------------------------------------------


def _hidden(frame: Frame, path: Tensor, values: Values, longest: Tensor) -> Hidden:
    """Return color, motion and inverse depth of what lies behind pixels."""
    if values.background == "none":
        return Hidden(torch.zeros(0, dtype=torch.long, device=path.device), path.new_zeros(0, 8))
    known = _revealed(frame, values) if values.background == "revealed" else None
    if known is not None and (frame.revealed is None or frame.revealed.valid is None):
        return known
    inverse, usable = 1 / frame.finite_depth(), _valid(frame) > 0
    color = clean_planes(frame.color, inverse, usable, values.depth_gap, values.edge_radius)
    # Two things that move apart uncover at most twice the way of the faster one.
    reach = min(values.background_reach, 2 * math.ceil(float(longest.max())) + 2)
    guess = guess_behind(torch.cat((color, path, inverse), 1), usable, values.depth_gap, reach)
    if known is None:
        return guess
    # Where the layer is not valid, its place is taken by the guess.
    assert frame.revealed is not None
    open_ = ~_valid(frame.revealed).bool().reshape(-1)[guess.pixels]
    return Hidden(
        torch.cat((known.pixels, guess.pixels[open_])),
        torch.cat((known.values, guess.values[open_])),
    )


def _revealed(frame: Frame, values: Values) -> Hidden:
    layer, valid = layer_behind(frame)
    inverse = 1 / layer.finite_depth()
    hides = (1 - frame.finite_depth() * inverse > _LEAST_STEP) & (valid > 0)
    index = hides.reshape(-1).nonzero().flatten()
    planes = torch.cat((layer.color, _path(layer, values), inverse), 1)
    return Hidden(index, _rows(planes)[index])


# -- lists of splats ---------------------------------------------------------------------------


def _own_splats(frame: Frame, path: Tensor, field: _Field, values: Values) -> Inputs:
    """Return the splats of the frame's own pixels; lists (C, M)."""
    depth, valid = frame.finite_depth(), _valid(frame)
    usable, gap = valid > 0, values.depth_gap
    low, high = local_range(frame.color, usable)
    planes = {
        "color": frame.color,
        "motion": path,
        "depth": depth,
        "near": depth - values.depth_slope * depth_step(depth, usable, gap),
        "gradient": gradients(frame.velocity, 1 / depth, usable, gap),
        "bend": second_differences(frame.color, 1 / depth, usable, gap),
        "low": low,
        "high": high,
        "mass": valid,
    }
    listed = {name: _rows(plane)[field.pixels].T for name, plane in planes.items()}
    return _placed(listed, field.pixels, values, frame)


def _hidden_splats(hidden: Hidden, field: _Field, values: Values, frame: Frame) -> Inputs:
    """Return the splats of what lies behind, where the motion can change anything."""
    inside = (field.slot[hidden.pixels] < field.pixels.numel()).nonzero().flatten()
    planes = hidden.values[inside].T
    nothing = torch.zeros_like(planes[:1])
    color, depth = planes[_COLOR], 1 / planes[_INVERSE]
    listed = {
        "color": color,
        "motion": planes[_MOTION],
        "depth": depth,
        "near": depth,
        "gradient": nothing.expand(4, -1),
        "bend": nothing.expand(6, -1),
        "low": color,
        "high": color,
        "mass": nothing + 1,
    }
    return _placed(listed, hidden.pixels[inside], values, frame)


def _placed(listed: Inputs, index: Tensor, values: Values, frame: Frame) -> Inputs:
    """Add where the splats are, and their parameters."""
    height, width = frame.size
    x, y = (
        axis.expand(frame.batch_size, 1, height, width).reshape(-1)[index]
        for axis in pixel_grid(frame.color)
    )
    listed = {
        name: plane[0] if name in ("depth", "near", "mass") else plane
        for name, plane in listed.items()
    }
    listed |= {"place": torch.stack((x, y)), "row": index // (height * width) * (height * width)}
    for name in ("shutter", "footprint", "stretch", "sharpening"):
        listed[name] = _listed(getattr(values, name), index, frame)
    return listed


def _joined(one: Inputs, other: Inputs) -> Inputs:
    return {
        name: one[name] if one[name].ndim == 0 else torch.cat((one[name], other[name]), -1)
        for name in one
    }


def _targets(field: _Field, values: Values, frame: Frame) -> Inputs:
    """Return what belongs to the targets; the last of them takes what falls outside."""
    inputs = {"slot": field.slot, "empty": frame.color.new_zeros(field.pixels.numel() + 1)}
    for name, key in (("extent", "depth_extent"), ("gain", "coverage_gain")):
        value = _listed(getattr(values, key), field.pixels, frame)
        inputs[name] = value if value.ndim == 0 else torch.cat((value, value[-1:]))
    return inputs


def _listed(value: Tensor, index: Tensor, frame: Frame) -> Tensor:
    """Return a parameter at listed pixels, (M,); a single number stays one."""
    if value.numel() == 1:
        return value.reshape(())
    return value.expand(frame.batch_size, 1, *frame.size).reshape(-1)[index]


def _rows(plane: Tensor) -> Tensor:
    """Return planes (B, C, H, W) as one row for each pixel, (B · H · W, C)."""
    return plane.permute(0, 2, 3, 1).reshape(-1, plane.shape[1])


def _image(index: Tensor, rows: Tensor, like: Tensor) -> Tensor:
    """Return rows of listed pixels as planes, 0 elsewhere, (B, C, H, W)."""
    batch, _, height, width = like.shape
    flat = rows.new_zeros(batch * height * width, rows.shape[1]).index_copy(0, index, rows)
    return flat.view(batch, height, width, -1).permute(0, 3, 1, 2)


def _valid(frame: Frame) -> Tensor:
    if frame.valid is None:
        return torch.ones_like(frame.color[:, :1])
    return frame.valid.to(frame.dtype)
