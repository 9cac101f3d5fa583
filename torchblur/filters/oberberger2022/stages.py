"""The stages of Oberberger 2022 on the pixels near which something moves."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.filters.parts.base import History, Values
from torchblur.frame import Frame
from torchblur.ops.atrous import (
    Centers,
    Footprint,
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
from torchblur.ops.points import Points, per_point, put, take, total
from torchblur.ops.prefilter import Stream, add_candidates, random_candidates
from torchblur.ops.reproject import Search, reproject
from torchblur.ops.segments import width_of_weights
from torchblur.ops.weights import saturate

__all__ = [
    "Guide",
    "Past",
    "Scene",
    "StreamSample",
    "accumulate",
    "compose",
    "estimate_of",
    "first_stage",
    "guide_of",
    "mean_of",
    "modulated",
    "modulated_planes",
    "opacity",
    "prefiltered",
    "remember",
    "sample_of",
    "second_stage",
    "untouched",
]

_SAMPLES_APART = 1024  # random streams between one frame and the next


class StreamSample(NamedTuple):
    """One sample per pixel: planes (B, ·, H, W)."""

    color: Tensor
    """Three planes, or six: light and albedo."""
    velocity: Tensor
    displacement: Tensor
    time: Tensor
    depth: Tensor
    moving: Tensor
    static: Tensor


class Guide(NamedTuple):
    """What guides the filter at the listed pixels, (1, N) each."""

    share: Tensor
    length: Tensor
    angle: Tensor
    length_variance: Tensor
    angle_variance: Tensor
    widths: Widths


class Scene(NamedTuple):
    """What all stages share."""

    samples: list[StreamSample]
    points: Points
    guide: Guide
    values: Values
    engine: Engine


class Past(NamedTuple):
    """What is left of the frames before."""

    planes: dict[str, Tensor] | None
    frames: int

    @staticmethod
    def of(history: History | None, values: Values) -> Past:
        """Read a history; its planes are left out where they are not wanted or do not fit."""
        if history is None:
            return Past(None, 0)
        planes = dict(history.planes)
        count = int(planes["frame"].flatten()[0])
        fits = planes["static"].shape[1] == (6 if values.demodulate else 3)
        return Past(planes if fits and values.temporal else None, count)


def sample_of(frame: Frame, values: Values) -> StreamSample:
    """Return what the stages need of a frame; its light and albedo apart if asked for."""
    color = frame.color
    if values.demodulate:
        albedo = torch.maximum(frame.require("albedo"), values.albedo_floor.to(color.dtype))
        color = torch.cat((color / albedo, albedo), 1)
    displacement = frame.velocity * values.shutter
    length = displacement.detach().square().sum(1, keepdim=True).sqrt()
    moving = length >= values.moving_threshold
    trusted = torch.ones_like(moving) if frame.valid is None else frame.valid.bool()
    return StreamSample(
        color,
        frame.velocity,
        displacement,
        frame.require("time"),
        frame.finite_depth(),
        (moving & trusted).to(frame.dtype),
        (~moving & trusted).to(frame.dtype),
    )


def modulated(color: Tensor) -> Tensor:
    """Return three planes of color: as they are, or light times albedo, (3, ...)."""
    return color if color.shape[0] == 3 else color[:3] * color[3:]


def modulated_planes(color: Tensor) -> Tensor:
    """Return the same for planes, (B, 3, H, W)."""
    return modulated(color.transpose(0, 1)).transpose(0, 1)


def mean_of(values: Tensor, weight: Tensor) -> Tensor:
    """Return values / weight, and 0 where there is no weight."""
    some = weight > 0
    return torch.where(some, values / torch.where(some, weight, 1.0), 0.0)


# -- stages ----------------------------------------------------------------------------------------


def estimate_of(samples: list[StreamSample], values: Values, engine: Engine) -> MotionEstimate:
    """Return mean and variance of the motion around each pixel."""
    motions = [Motions(s.displacement, s.depth, s.moving, s.moving + s.static) for s in samples]
    return estimate_motion(
        motions,
        values.depth_extent,
        values.variance_window,
        values.variance_stride,
        values.angle_mode,
        engine,
    )


def guide_of(estimate: MotionEstimate, points: Points, values: Values) -> Guide:
    """Return the estimate at the pixels, normalized, and how far the weights reach there."""
    stacked = take(torch.cat(estimate[:5], 1), points)
    share, length, angle, length_variance, angle_variance = stacked.split(1)

    def at(name: str) -> Tensor:
        return per_point(getattr(values, name), points, stacked)

    angle_variance = (angle_variance / at("angle_normalization")).clamp(0, 1)
    if values.length_normalization == "mean":
        length_variance = length_variance / length.square().clamp(min=1e-12)
    width = width_of_weights(length_variance, angle_variance, at("length_gain"), at("angle_gain"))
    widths = Widths(width, at("segment_softness"))
    return Guide(share, length, angle, length_variance, angle_variance, widths)


def prefiltered(scene: Scene, index: int, count: int) -> StreamSample:
    """Return one of the samples per pixel with random others averaged in."""
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


def first_stage(scene: Scene) -> Sums:
    """Return the sums of both channels over all samples per pixel."""
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


def _keep(scene: Scene) -> Tensor:
    """Return where a pixel keeps its own static sample, (1, N)."""
    static = take(scene.samples[0].static, scene.points)
    return static if scene.values.static_filter == "own" else torch.zeros_like(static)


def accumulate(scene: Scene, sums: Sums, past: Past) -> tuple[Sums, Tensor]:
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
    velocity = mean_of(sums.moving, sums.moving_weight)[-3:-1, some[0]]
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
    still = plain_sums(static, points, taps, _keep(scene), engine=engine)
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


def second_stage(scene: Scene, sums: Sums) -> tuple[Tensor, Tensor]:
    """Return the filtered moving channel (C + 3, N) and where it is valid (1, N)."""
    points, values = scene.points, scene.values
    moving = mean_of(sums.moving, sums.moving_weight)
    valid = (sums.moving_weight > 0).to(moving.dtype)
    taps = kernel_taps(values.kernel, moving)
    shutter = per_point(values.shutter, points, moving)
    for turn in range(1, values.second_stage_iterations + 1):
        texture = put(torch.cat((moving, shutter * moving[-3:-1], valid)), points)
        sum_, weight = path_sums(
            texture,
            points,
            taps,
            scene.guide.widths,
            _footprint_of(scene, turn),
            values.lookup,
            scene.engine,
        )
        moving = torch.where(weight > 0, mean_of(sum_, weight), moving)
        valid = torch.where(weight > 0, 1.0, valid)
    return moving, valid


def _footprint_of(scene: Scene, turn: int, across: float = 1.0) -> Footprint:
    """Return how the kernel lies in pass 1 to n of the second stage."""
    points, guide, values = scene.points, scene.guide, scene.values
    if values.kernel_scaling == "fixed":
        one = torch.ones_like(guide.length)
        return footprint(None, one * 2.0 ** (turn - 1), one, one, torch.zeros_like(one))
    return footprint(
        guide.angle if values.kernel_rotation else None,
        guide.length,
        guide.angle_variance,
        per_point(values.step_divisor, points, guide.length)
        * 2 ** (values.second_stage_iterations - turn),
        per_point(values.min_step, points, guide.length),
        across,
    )


def opacity(scene: Scene, first: Sums, sums: Sums) -> Tensor:
    """Return the opacity of the moving channel, (1, N)."""
    share, values = scene.guide.share, scene.values
    if values.blend_source == "variance":
        return saturate(per_point(values.blend_gain, scene.points, share) * share)
    if values.blend_source == "filtered":
        return _filtered_share(scene)
    chosen = sums if values.blend_source == "weights" else first
    return mean_of(chosen.moving_weight, chosen.moving_weight + chosen.static_weight)


def _filtered_share(scene: Scene) -> Tensor:
    """Return the share of moving samples under the kernels of the second stage, (1, N).

    Nothing here keeps taps beside the way of p out, so where all moves one way they lie on it.
    """
    points, values = scene.points, scene.values
    moving = torch.stack([sample.moving for sample in scene.samples]).sum(0)
    trusted = moving + torch.stack([sample.static for sample in scene.samples]).sum(0)
    mask = torch.cat((mean_of(moving, trusted), (trusted > 0).to(moving.dtype)), 1)
    taps = kernel_taps(values.kernel, moving)
    nowhere = torch.zeros_like(points.x)
    for turn in range(1, values.second_stage_iterations + 1):
        shape = _footprint_of(scene, turn, across=0.0)
        sum_, weight = plain_sums(mask, points, taps, nowhere, shape, values.lookup, scene.engine)
        some = weight > 0
        now = torch.cat((mean_of(sum_, weight), some.to(moving.dtype)))
        mask = put(torch.where(some, now, take(mask, points)), points, mask)
    return take(mask, points)[:1]


def compose(sums: Sums, second: Tensor, valid: Tensor, blend: Tensor, given: Tensor) -> Tensor:
    """Return the moving channel over the static one; where one is empty, the other."""
    moving = modulated(second[:-3])
    static = modulated(mean_of(sums.static, sums.static_weight))
    some, still = valid > 0, sums.static_weight > 0
    both = torch.lerp(static, moving, blend.expand_as(moving))
    one = torch.where(some, moving, torch.where(still, static, given))
    return torch.where(some & still, both, one)


# -- memory ----------------------------------------------------------------------------------------


def remember(scene: Scene, sums: Sums | None, count: int) -> History:
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
            put(mean_of(sums.moving, sums.moving_weight), points),
            put(torch.minimum(sums.moving_weight, bound), points),
            put(mean_of(sums.static, sums.static_weight), points, color),
            put(torch.minimum(sums.static_weight, bound), points, static_weight),
        )
    names = ("moving", "moving_weight", "static", "static_weight")
    return History(dict(zip(names, planes, strict=True)) | {"frame": number})


def untouched(scene: Scene, color: Tensor) -> dict[str, Tensor]:
    """Return the layers of a frame in which nothing moves."""
    nothing = torch.zeros_like(color[:, :1])
    names = ("mean_length", "mean_angle", "length_variance", "angle_variance", "blend")
    weights = ("moving_weight", "static_weight", "reprojection")
    black = nothing.expand_as(color)
    return (
        dict.fromkeys(names + weights, nothing)
        | dict.fromkeys(("moving", "static", "second_stage"), black)
        | {"prefiltered": modulated_planes(scene.samples[0].color), "color": color}
    )
