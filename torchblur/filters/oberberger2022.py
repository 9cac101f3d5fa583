"""Oberberger 2022: motion blur from a stochastic stream of one sample per pixel."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.base import History, TemporalBlur, Values
from torchblur.filters.oberberger2022_config import Oberberger2022Config
from torchblur.frame import Frame
from torchblur.ops.atrous import (
    Centers,
    Samples,
    Sums,
    Widths,
    footprint,
    kernel_taps,
    path_sums,
    plain_sums,
    split_sums,
)
from torchblur.ops.gather import Engine
from torchblur.ops.motion_variance import MotionEstimate, Motions, estimate_motion
from torchblur.ops.points import Points, per_point, points_where, put, take, total
from torchblur.ops.prefilter import Stream, add_candidates, random_candidates
from torchblur.ops.reproject import Search, reproject
from torchblur.ops.segments import width_of_weights
from torchblur.ops.weights import saturate

__all__ = ["Oberberger2022Blur", "Oberberger2022Config", "oberberger2022"]

_SAMPLES_APART = 1024  # random streams between one frame and the next


def oberberger2022(
    frame: Frame,
    history: History | None = None,
    config: Oberberger2022Config | None = None,
    **params: Any,
) -> tuple[Tensor, History]:
    """Reconstruct motion blur from a stream: each pixel seen once, at a time of its own.

    Mean and variance of the motion around each pixel guide a filter that keeps samples that move
    apart from those that do not. Moving ones count where their path over the shutter comes near:
    ``w = sat(1 − d / (c_a c_l))``. Random samples from along the motion are averaged in first; a
    5x5 kernel splits the two channels; what the frames before have collected is found again by
    iterative reprojection and added; three passes of a kernel that is turned to the motion and
    as long as it smooth the moving channel, which is then laid over the still one.

    Args:
        frame: Color, depth, velocity and time, (B, ·, H, W): color, depth and velocity are those
            of the sample, at the pixel's center and at the time of its own.
        history: What the call for the frame before returned; None begins a shot.
        config: Parameters; the defaults if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, scene-linear, (B, 3, H, W), and the history for the next frame.

    Differentiable: in color, in depth, in the velocity through the weights (not through the
        positions of nearest lookups), in the history, and in every parameter that `torchblur
        params` calls smooth.
    Border: replicated.
    Reference: Oberberger, Chajdas and Westermann 2022, "Spatiotemporal Variance-Guided Filtering
        for Motion Blur". We differ where the text leaves a gap; see `Oberberger2022Blur`.
    Raises: ConfigError for a bad parameter, FrameError if depth or time is missing.
    """
    result: tuple[Tensor, History] = Oberberger2022Blur(config, **params)(frame, history)
    return result


class Oberberger2022Blur(TemporalBlur):
    """Oberberger 2022; every stage is a switch. See `oberberger2022`.

    We differ, or choose where the paper leaves a gap: a sample moves if its displacement over
    the shutter reaches `moving_threshold`; pixels around which nothing moves are the input, bit
    for bit. Depth tests are ramps over `depth_extent`. The opacity of the moving channel is the
    share of moving samples in the window. The kernel is a B3 spline. Steps of the second stage
    have a floor of `min_step`, and its passes filter color, velocity and time together. The
    weight of the history is limited. Sums at the border count the border's pixels where they
    are, as often as they are met. Several samples per pixel (a list of frames) are summed; the
    first one decides what the pixel itself is. With `demodulate` the light (color over albedo)
    and the albedo are filtered with the same weights and multiplied in each channel before the
    channels are laid over each other. Random samples follow from `seed`, the number of frames
    since the shot began, and the number of the sample: `random_candidates` with the stream
    ``1024 · frame + sample``; all images of a batch get the same.

    `layers` adds, (B, 1, H, W) if nothing else is said and 0 where nothing moves nearby:
    "mean_length" (px), "mean_angle" (radians, y down), "length_variance" (px², or relative with
    `length_normalization` "mean"), "angle_variance" (in [0, 1]), "blend" (opacity of the moving
    channel), "prefiltered" (color, (B, 3, H, W); the first sample's), "moving" and "static"
    (color of the two channels before the second stage, history included, (B, 3, H, W)) and
    their "moving_weight" and "static_weight", "reprojection" (0 not tried, k accepted at the k-th
    evaluation, −1 failed), "second_stage" (color of the moving channel after it, (B, 3, H, W)).

    The history's planes are "moving" (color, velocity in px/frame, time), "moving_weight",
    "static" (color), "static_weight", and "frame", the number of frames since the shot began.
    """

    name = "oberberger2022"
    config_class = Oberberger2022Config
    needs = ("time", "depth")

    def advance(
        self, samples: tuple[Frame, ...], history: History | None, values: Values
    ) -> tuple[dict[str, Tensor], History]:
        """Return the layers and the history for the next frame."""
        past = _Past.of(history, samples[0], values)
        shots = [_sample_of(frame, values) for frame in samples]
        estimate = _estimate(shots, values, self.engine)
        points = points_where(estimate.active, samples[0].dtype)
        scene = _Scene(shots, points, _guide(estimate, points, values), values, self.engine)
        input_color = torch.stack([frame.color for frame in samples]).mean(0)
        if points.number == 0:
            return _untouched(scene, input_color), _remember(scene, None, past.frames)
        shots[:] = [_prefiltered(scene, i, past.frames) for i in range(len(shots))]
        first = _first_stage(scene)
        sums, outcome = _accumulate(scene, first, past)
        second, valid = _second_stage(scene, sums)
        blend = _blend(scene, first, sums)
        color = _compose(sums, second, valid, blend, take(input_color, points))
        planes = {
            "mean_length": scene.guide.length,
            "mean_angle": scene.guide.angle,
            "length_variance": scene.guide.length_variance,
            "angle_variance": scene.guide.angle_variance,
            "blend": blend,
            "moving": _modulated(_mean(sums.moving, sums.moving_weight)[:-3]),
            "moving_weight": sums.moving_weight,
            "static": _modulated(_mean(sums.static, sums.static_weight)),
            "static_weight": sums.static_weight,
            "reprojection": outcome,
            "second_stage": _modulated(second[:-3]) * valid,
        }
        layers = {name: put(plane, points) for name, plane in planes.items()}
        layers["prefiltered"] = _modulated_planes(shots[0].color)
        layers["color"] = put(color, points, input_color)
        return layers, _remember(scene, sums, past.frames)


class _Sample(NamedTuple):
    """One sample per pixel: planes (B, ·, H, W)."""

    color: Tensor
    """Three planes, or six: light and albedo."""
    velocity: Tensor
    displacement: Tensor
    time: Tensor
    depth: Tensor
    moving: Tensor
    static: Tensor


class _Guide(NamedTuple):
    """What guides the filter at the listed pixels, (1, N) each."""

    share: Tensor
    length: Tensor
    angle: Tensor
    length_variance: Tensor
    angle_variance: Tensor
    widths: Widths


class _Scene(NamedTuple):
    """What all stages share."""

    samples: list[_Sample]
    points: Points
    guide: _Guide
    values: Values
    engine: Engine


class _Past(NamedTuple):
    """What is left of the frames before."""

    planes: dict[str, Tensor] | None
    frames: int

    @staticmethod
    def of(history: History | None, frame: Frame, values: Values) -> _Past:
        """Read a history; its planes are left out where they are not wanted or do not fit."""
        if history is None:
            return _Past(None, 0)
        planes = dict(history.planes)
        count = int(planes["frame"].flatten()[0])
        fits = planes["static"].shape[1] == (6 if values.demodulate else 3)
        return _Past(planes if fits and values.temporal else None, count)


def _sample_of(frame: Frame, values: Values) -> _Sample:
    color = frame.color
    if values.demodulate:
        albedo = torch.maximum(frame.require("albedo"), values.albedo_floor.to(color.dtype))
        color = torch.cat((color / albedo, albedo), 1)
    displacement = frame.velocity * values.shutter
    length = displacement.detach().square().sum(1, keepdim=True).sqrt()
    moving = length >= values.moving_threshold
    trusted = torch.ones_like(moving) if frame.valid is None else frame.valid.bool()
    return _Sample(
        color,
        frame.velocity,
        displacement,
        frame.require("time"),
        frame.finite_depth(),
        (moving & trusted).to(frame.dtype),
        (~moving & trusted).to(frame.dtype),
    )


def _modulated(color: Tensor) -> Tensor:
    """Return three planes of color: as they are, or light times albedo, (3, ...)."""
    return color if color.shape[0] == 3 else color[:3] * color[3:]


def _modulated_planes(color: Tensor) -> Tensor:
    return _modulated(color.transpose(0, 1)).transpose(0, 1)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """Return values / weight, and 0 where there is no weight."""
    some = weight > 0
    return torch.where(some, values / torch.where(some, weight, 1.0), 0.0)


# -- stages ----------------------------------------------------------------------------------------


def _estimate(samples: list[_Sample], values: Values, engine: Engine) -> MotionEstimate:
    motions = [Motions(s.displacement, s.depth, s.moving, s.moving + s.static) for s in samples]
    return estimate_motion(
        motions,
        values.depth_extent,
        values.variance_window,
        values.variance_stride,
        values.angle_mode,
        engine,
    )


def _guide(estimate: MotionEstimate, points: Points, values: Values) -> _Guide:
    stacked = take(torch.cat(estimate[:5], 1), points)
    share, length, angle, length_variance, angle_variance = stacked.split(1)

    def at(name: str) -> Tensor:
        return per_point(getattr(values, name), points, stacked)

    angle_variance = (angle_variance / at("angle_normalization")).clamp(0, 1)
    if values.length_normalization == "mean":
        length_variance = length_variance / length.square().clamp(min=1e-12)
    width = width_of_weights(length_variance, angle_variance, at("length_gain"), at("angle_gain"))
    widths = Widths(width, at("segment_softness"))
    return _Guide(share, length, angle, length_variance, angle_variance, widths)


def _prefiltered(scene: _Scene, index: int, count: int) -> _Sample:
    sample, values = scene.samples[index], scene.values
    if not values.prefilter:
        return sample
    stream = count * _SAMPLES_APART + index
    color = add_candidates(
        Stream(sample.color, sample.displacement, sample.time, sample.moving),
        random_candidates(sample.color, values.prefilter_samples, values.seed, stream),
        values.prefilter_jitter,
        values.prefilter_distance,
        values.prefilter_min_length,
        scene.engine,
    )
    return sample._replace(color=color)


def _first_stage(scene: _Scene) -> Sums:
    first, points, values = scene.samples[0], scene.points, scene.values
    depth = take(first.depth, points)
    centers = Centers(
        take(first.moving, points),
        _keep(scene),
        depth,
        depth * per_point(values.depth_extent, points, depth),
    )
    taps = kernel_taps(values.kernel, depth, center_only=not values.first_stage)
    parts = [
        split_sums(
            Samples(
                torch.cat((s.color, s.velocity, s.time), 1),
                s.displacement,
                s.depth,
                s.moving,
                s.static,
            ),
            points,
            taps,
            scene.guide.widths,
            centers,
            scene.engine,
        )
        for s in scene.samples
    ]
    return Sums(*total(parts))


def _keep(scene: _Scene) -> Tensor:
    """Return where a pixel keeps its own static sample, (1, N)."""
    static = take(scene.samples[0].static, scene.points)
    return static if scene.values.static_filter == "own" else torch.zeros_like(static)


def _accumulate(scene: _Scene, sums: Sums, past: _Past) -> tuple[Sums, Tensor]:
    """Add the history to the sums; return them and the outcome of the reprojection."""
    points, values, engine = scene.points, scene.values, scene.engine
    outcome = torch.zeros_like(points.x)
    if past.planes is None:
        return sums, outcome
    old, weight = past.planes["moving"], past.planes["moving_weight"]
    some = sums.moving_weight > 0
    moving = points.among(some)
    search = Search(
        values.reprojection_iterations,
        per_point(values.accept_threshold, moving, weight),
        per_point(values.cancel_threshold, moving, weight),
    )
    velocity = _mean(sums.moving, sums.moving_weight)[-3:-1, some[0]]
    found = reproject(moving, velocity, old[:, -3:-1], weight, search)
    taps = kernel_taps(values.kernel, old)
    good = found.outcome > 0
    chosen = torch.zeros_like(some)
    chosen[some] = good[0]
    widths = Widths(
        scene.guide.widths.width[:, chosen[0]], _among(scene.guide.widths.softness, chosen)
    )
    texture = torch.cat((old, old[:, -3:-1] * values.shutter, weight), 1)
    added = path_sums(texture, found.points.among(good), taps, widths, engine=engine)
    place = chosen[0].nonzero()[:, 0]
    outcome = outcome.index_copy(1, some[0].nonzero()[:, 0], found.outcome)
    static = torch.cat((past.planes["static"], past.planes["static_weight"]), 1)
    still = plain_sums(static, points, taps, _keep(scene), engine)
    return (
        Sums(
            sums.moving.index_add(1, place, added[0]),
            sums.moving_weight.index_add(1, place, added[1]),
            sums.static + still[0],
            sums.static_weight + still[1],
        ),
        outcome,
    )


def _among(value: Tensor, chosen: Tensor) -> Tensor:
    return value if value.ndim == 0 else value[:, chosen[0]]


def _second_stage(scene: _Scene, sums: Sums) -> tuple[Tensor, Tensor]:
    """Return the filtered moving channel (C + 3, N) and where it is valid (1, N)."""
    points, guide, values = scene.points, scene.guide, scene.values
    moving = _mean(sums.moving, sums.moving_weight)
    valid = (sums.moving_weight > 0).to(moving.dtype)
    taps = kernel_taps(values.kernel, moving)
    shutter = per_point(values.shutter, points, moving)
    number = values.second_stage_iterations
    for turn in range(1, number + 1):
        if values.kernel_scaling == "fixed":
            one = torch.ones_like(guide.length)
            step = one * 2.0 ** (turn - 1)
            shape = footprint(None, step, one, one, torch.zeros_like(one))
        else:
            shape = footprint(
                guide.angle if values.kernel_rotation else None,
                guide.length,
                guide.angle_variance,
                per_point(values.step_divisor, points, moving) * 2 ** (number - turn),
                per_point(values.min_step, points, moving),
            )
        texture = put(torch.cat((moving, shutter * moving[-3:-1], valid)), points)
        sum_, weight = path_sums(
            texture, points, taps, guide.widths, shape, values.lookup, scene.engine
        )
        moving = torch.where(weight > 0, _mean(sum_, weight), moving)
        valid = torch.where(weight > 0, 1.0, valid)
    return moving, valid


def _blend(scene: _Scene, first: Sums, sums: Sums) -> Tensor:
    """Return the opacity of the moving channel, (1, N)."""
    share, values = scene.guide.share, scene.values
    if values.blend_source == "variance":
        return saturate(per_point(values.blend_gain, scene.points, share) * share)
    chosen = sums if values.blend_source == "weights" else first
    return _mean(chosen.moving_weight, chosen.moving_weight + chosen.static_weight)


def _compose(sums: Sums, second: Tensor, valid: Tensor, blend: Tensor, given: Tensor) -> Tensor:
    """Return the moving channel over the static one; where one is empty, the other."""
    moving = _modulated(second[:-3])
    static = _modulated(_mean(sums.static, sums.static_weight))
    some, still = valid > 0, sums.static_weight > 0
    both = torch.lerp(static, moving, blend.expand_as(moving))
    one = torch.where(some, moving, torch.where(still, static, given))
    return torch.where(some & still, both, one)


# -- memory ----------------------------------------------------------------------------------------


def _remember(scene: _Scene, sums: Sums | None, count: int) -> History:
    """Return what the next frame needs; still pixels that no motion reaches keep their color."""
    first, points, limit = scene.samples[0], scene.points, scene.values.history_limit
    color = torch.stack([sample.color for sample in scene.samples]).mean(0)
    batch, channels, height, width = color.shape
    moving = color.new_zeros(()).expand(batch, channels + 3, height, width)
    nothing = moving[:, :1]
    static_weight = torch.minimum(first.static, limit)
    number = color.new_full((batch, 1, 1, 1), float(count + 1))
    if sums is None:
        planes = (moving, nothing, color, static_weight)
    else:
        bound = per_point(limit, points, color)
        planes = (
            put(_mean(sums.moving, sums.moving_weight), points),
            put(torch.minimum(sums.moving_weight, bound), points),
            put(_mean(sums.static, sums.static_weight), points, color),
            put(torch.minimum(sums.static_weight, bound), points, static_weight),
        )
    names = ("moving", "moving_weight", "static", "static_weight")
    return History(dict(zip(names, planes, strict=True)) | {"frame": number})


def _untouched(scene: _Scene, color: Tensor) -> dict[str, Tensor]:
    """Return the layers of a frame in which nothing moves."""
    nothing = torch.zeros_like(color[:, :1])
    names = ("mean_length", "mean_angle", "length_variance", "angle_variance", "blend")
    weights = ("moving_weight", "static_weight", "reprojection")
    black = nothing.expand_as(color)
    return (
        dict.fromkeys(names + weights, nothing)
        | dict.fromkeys(("moving", "static", "second_stage"), black)
        | {"prefiltered": _modulated_planes(scene.samples[0].color), "color": color}
    )
