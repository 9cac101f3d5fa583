"""Oberberger 2022: motion blur from a stochastic stream of one sample per pixel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchblur.filters.oberberger2022.config import Oberberger2022Config
from torchblur.filters.oberberger2022.stages import (
    Past,
    Scene,
    accumulate,
    compose,
    estimate_of,
    first_stage,
    guide_of,
    mean_of,
    modulated,
    modulated_planes,
    opacity,
    prefiltered,
    remember,
    sample_of,
    second_stage,
    untouched,
)
from torchblur.filters.parts.base import History, TemporalBlur, Values
from torchblur.filters.parts.cost import TWO_SUMS, WEIGHTS, Cost, color_lookup
from torchblur.frame import Frame
from torchblur.ops.points import points_where, put, take

__all__ = ["Oberberger2022Blur", "Oberberger2022Config", "oberberger2022"]


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

    We differ, or choose where the paper leaves a gap: a sample moves if its displacement over the
    shutter reaches `moving_threshold`; pixels around which nothing moves are the input, bit for
    bit. Depth tests are ramps over `depth_extent`. The opacity of the moving channel is the share
    of moving samples in the window, which leaves a rim around what moves. `blend_source` has
    others, ours. "filtered", the best, is the share of moving samples under the kernels of all
    passes of the second stage, weighted by ``h`` alone, with ``s_y = lerp(0, s_x, σ²_θ)``.
    "first_stage" is the moving share of the weights of the first stage: noisy, and too low, as
    ``w`` takes from the moving ones alone. "weights" is the same with the history added; use it
    without one, as the still weight then grows more than the moving one, and what moves fades from
    frame to frame. The kernel is a B3 spline. Steps of the second stage have a floor of
    `min_step`, and its passes filter color, velocity and time together. The weight of the history
    is limited. Sums at the border count the border's pixels where they are, as often as they are
    met. Several samples per pixel (a list of frames) are summed; the first one decides what the
    pixel itself is. With `demodulate` the light (color over albedo) and the albedo are filtered
    with the same weights and multiplied in each channel before the channels are laid over each
    other. Random samples follow from `seed`, the number of frames since the shot began, and the
    number of the sample: `random_candidates` with the stream ``1024 · frame + sample``; all images
    of a batch get the same.

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

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what it costs, counted from its configuration."""
        taps = 5 * 5
        kernel = Cost(taps, 2 * taps, taps * TWO_SUMS, passes=1)
        looks = config.variance_window**2 / config.variance_stride**2
        whole = Cost(looks, looks, looks * WEIGHTS, passes=1)
        if config.prefilter:
            drawn = 9 * config.prefilter_samples
            whole += Cost(drawn, drawn, drawn * WEIGHTS, passes=1)
        whole += kernel if config.first_stage else Cost(1, 2, TWO_SUMS, passes=1)
        if config.temporal:
            steps = 2 * config.reprojection_iterations
            whole += Cost(steps, steps, passes=1) + kernel
        turn = Cost(taps, taps * (color_lookup(config.lookup) + 1), taps * TWO_SUMS, passes=1)
        if config.blend_source == "filtered":
            turn += Cost(taps, taps * color_lookup(config.lookup), passes=1)
        return whole + turn * int(config.second_stage_iterations)

    def advance(
        self, samples: tuple[Frame, ...], history: History | None, values: Values
    ) -> tuple[dict[str, Tensor], History]:
        """Return the layers and the history for the next frame."""
        past = Past.of(history, values)
        shots = [sample_of(frame, values) for frame in samples]
        estimate = estimate_of(shots, values, self.engine)
        points = points_where(estimate.active, samples[0].dtype)
        scene = Scene(shots, points, guide_of(estimate, points, values), values, self.engine)
        input_color = torch.stack([frame.color for frame in samples]).mean(0)
        if points.number == 0:
            return untouched(scene, input_color), remember(scene, None, past.frames)
        richer = [prefiltered(scene, i, past.frames) for i in range(len(shots))]
        scene = scene._replace(samples=richer)
        first = first_stage(scene)
        sums, outcome = accumulate(scene, first, past)
        second, valid = second_stage(scene, sums)
        blend = opacity(scene, first, sums)
        color = compose(sums, second, valid, blend, take(input_color, points))
        planes = {
            "mean_length": scene.guide.length,
            "mean_angle": scene.guide.angle,
            "length_variance": scene.guide.length_variance,
            "angle_variance": scene.guide.angle_variance,
            "blend": blend,
            "moving": modulated(mean_of(sums.moving, sums.moving_weight)[:-3]),
            "moving_weight": sums.moving_weight,
            "static": modulated(mean_of(sums.static, sums.static_weight)),
            "static_weight": sums.static_weight,
            "reprojection": outcome,
            "second_stage": modulated(second[:-3]) * valid,
        }
        layers = {name: put(plane, points) for name, plane in planes.items()}
        layers["prefiltered"] = modulated_planes(richer[0].color)
        layers["color"] = put(color, points, input_color)
        return layers, remember(scene, sums, past.frames)
