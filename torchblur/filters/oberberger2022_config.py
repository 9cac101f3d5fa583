"""Parameters of Oberberger 2022: every stage is a switch, every constant a number."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from torchblur.filters.base import FilterConfig
from torchblur.ops.atrous import Kernel
from torchblur.ops.gather import Lookup
from torchblur.params import Param

__all__ = ["Oberberger2022Config"]

_VARIANCE = "Oberberger 2022, section 4.1"
_PREFILTER = "Oberberger 2022, section 4.2"
_SPATIAL = "Oberberger 2022, section 4.3"
_TEMPORAL = "Oberberger 2022, section 4.4"
_OURS = "torchblur"


def _unstated(section: str) -> str:
    return f"{section} (value not stated)"


# fmt: off
class Oberberger2022Config(FilterConfig):
    """Parameters of Oberberger 2022. The defaults are the paper's, or fill what it leaves open.

    A stream carries the time of each sample, so `shutter_position` changes nothing; `shutter` is
    the open time of the stream, and must be what it was rendered with.
    """

    moving_threshold: Annotated[float, Param(
        unit="px", low=0.01, high=8.0, scale="log", grad="weak", source=_unstated(_VARIANCE),
        meaning="displacement over the shutter from which a sample counts as moving",
    )] = 0.5

    # -- variance estimate ---------------------------------------------------------------------
    variance_window: Annotated[int, Param(
        unit="px", low=1, high=63, grad="discrete", source=_VARIANCE,
        meaning="edge of the window of the estimate; an even one has one more at right and below",
    )] = 15
    variance_stride: Annotated[int, Param(
        unit="px", low=1, high=16, grad="discrete", source=_VARIANCE,
        meaning="the estimate is made once for so many pixels squared, at the top left one",
    )] = 2
    depth_extent: Annotated[float, Param(
        low=1e-3, high=10.0, scale="log", grad="smooth", source=_unstated(_VARIANCE),
        meaning="how far behind a pixel, over its depth, a sample no longer counts",
    )] = 0.1
    angle_mode: Annotated[Literal["relative", "double_angle"], Param(
        grad="discrete", source=f"relative: {_VARIANCE}; double_angle: {_OURS}",
        meaning="mean angle against that of one sample, or from the sum of doubled angles",
    )] = "relative"
    angle_normalization: Annotated[float, Param(
        unit="rad²", low=0.01, high=10.0, scale="log", grad="smooth", source=_unstated(_VARIANCE),
        meaning="variance of the angle that counts as 1",
    )] = (math.pi / 2) ** 2
    length_normalization: Annotated[Literal["px", "mean"], Param(
        grad="discrete", source=f"px: {_VARIANCE}; mean: {_OURS}",
        meaning="variance of the length in px², or over the mean length squared",
    )] = "px"
    blend_source: Annotated[Literal["variance", "weights", "first_stage", "filtered"], Param(
        grad="discrete", source=f"{_unstated(_VARIANCE)}; others: {_OURS}",
        meaning="opacity of moving: its share of the window, of weights, or along the motion",
    )] = "variance"
    blend_gain: Annotated[float, Param(
        low=0.1, high=10.0, scale="log", grad="smooth", source=_unstated(_VARIANCE),
        active_when="blend_source == variance",
        meaning='gain of that share before it is clamped (blend_source="variance")',
    )] = 1.0

    # -- pre-filter ----------------------------------------------------------------------------
    prefilter: Annotated[bool, Param(
        grad="discrete", source=_PREFILTER,
        meaning="add random samples from along the motion to each moving sample",
    )] = True
    prefilter_samples: Annotated[int, Param(
        unit="samples", low=1, high=16, grad="discrete", source=_PREFILTER,
        active_when="prefilter == true",
        meaning="random samples per pixel; all of a 3x3 neighborhood are shared",
    )] = 2
    prefilter_jitter: Annotated[float, Param(
        unit="px", low=0.0, high=8.0, grad="weak", source=_PREFILTER,
        active_when="prefilter == true",
        meaning="how far a random sample may stray from the line, in x and in y",
    )] = 1.5
    prefilter_distance: Annotated[float, Param(
        unit="px", low=0.1, high=16.0, scale="log", grad="weak", source=_PREFILTER,
        active_when="prefilter == true",
        meaning="a sample is taken if its path comes nearer to the pixel than this",
    )] = 2.5
    prefilter_min_length: Annotated[float, Param(
        unit="px", low=0.1, high=64.0, scale="log", grad="weak", source=_PREFILTER,
        active_when="prefilter == true",
        meaning="pixels that move less than this are left as they are",
    )] = 3.0

    # -- weights and first stage ---------------------------------------------------------------
    first_stage: Annotated[bool, Param(
        grad="discrete", source=_SPATIAL,
        meaning="filter both channels over 5x5 pixels, or only split them",
    )] = True
    kernel: Annotated[Kernel, Param(
        grad="discrete", source=_unstated(_SPATIAL),
        meaning="weights of the 5x5 kernel of all stages: B3 spline, or all alike",
    )] = "b3"
    length_gain: Annotated[float, Param(
        symbol="β_l", unit="1/px²", low=0.01, high=1000.0, scale="log", grad="smooth",
        source=_SPATIAL, meaning="how much the variance of the length widens the weights",
    )] = 10.0
    angle_gain: Annotated[float, Param(
        symbol="β_a", low=0.01, high=100.0, scale="log", grad="smooth", source=_SPATIAL,
        meaning="how much the variance of the angle widens the weights",
    )] = 1.0
    segment_softness: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source=f"0: {_SPATIAL}; above it: {_OURS}",
        meaning="over which share of a sample's path its weight falls to 0 beyond the path's ends",
    )] = 0.0
    static_filter: Annotated[Literal["kernel", "own"], Param(
        grad="discrete", source=f"kernel: {_SPATIAL}; own: {_OURS}",
        meaning="blur static samples with the kernel, or keep a static pixel as it is",
    )] = "kernel"

    # -- temporal accumulation -----------------------------------------------------------------
    temporal: Annotated[bool, Param(
        grad="discrete", source=_TEMPORAL, meaning="add what the frames before have collected",
    )] = True
    reprojection_iterations: Annotated[int, Param(
        low=1, high=16, grad="discrete", source=_TEMPORAL,
        active_when="temporal == true",
        meaning="how often a place in the last frame is tried and moved",
    )] = 2
    accept_threshold: Annotated[float, Param(
        unit="px", low=0.05, high=16.0, scale="log", grad="weak", source=_unstated(_TEMPORAL),
        active_when="temporal == true",
        meaning="a place is good if projecting back and forth misses by less than this",
    )] = 1.0
    cancel_threshold: Annotated[float, Param(
        unit="px", low=1.0, high=128.0, scale="log", grad="weak", source=_unstated(_TEMPORAL),
        active_when="temporal == true",
        meaning="the search ends if it misses by more than this (and by more than the motion)",
    )] = 16.0
    history_limit: Annotated[float, Param(
        low=0.01, high=64.0, scale="log", grad="smooth", source=f"{_OURS} (unbounded in the paper)",
        active_when="temporal == true",
        meaning="largest weight that is kept for the next frame; 1 is one frame's samples",
    )] = 8.0

    # -- second stage --------------------------------------------------------------------------
    second_stage_iterations: Annotated[int, Param(
        symbol="n", low=0, high=8, grad="discrete", source=_SPATIAL,
        meaning="passes of the scaled kernel over the moving channel; 0 turns them off",
    )] = 3
    kernel_scaling: Annotated[Literal["motion", "fixed"], Param(
        grad="discrete", source=f"motion: {_SPATIAL}; fixed: Dammertz 2010",
        active_when="second_stage_iterations > 0",
        meaning="steps of the kernel follow the motion, or are 1, 2, 4 … px",
    )] = "motion"
    kernel_rotation: Annotated[bool, Param(
        grad="discrete", source=_SPATIAL,
        active_when="kernel_scaling == motion",
        meaning='turn the kernel to the mean motion (kernel_scaling="motion")',
    )] = True
    step_divisor: Annotated[float, Param(
        low=1.0, high=20.0, scale="log", grad="weak", source=_SPATIAL,
        active_when="kernel_scaling == motion",
        meaning="steps of the last pass are the mean length over this",
    )] = 5.0
    min_step: Annotated[float, Param(
        unit="px", low=0.0, high=4.0, grad="weak", source=f"0: {_SPATIAL}; 1: {_OURS}",
        active_when="kernel_scaling == motion",
        meaning="least step along the motion; below 1/2 all taps may fall on the pixel itself",
    )] = 1.0
    lookup: Annotated[Lookup, Param(
        grad="discrete", source=f"nearest: {_SPATIAL}; bilinear: {_OURS}",
        active_when="second_stage_iterations > 0",
        meaning="round the taps of the second stage to whole pixels, or interpolate",
    )] = "nearest"

    # -- beyond the paper ----------------------------------------------------------------------
    demodulate: Annotated[bool, Param(
        grad="discrete", source="Oberberger 2022, section 6 (named, not built)",
        meaning="filter albedo and the light on it apart; needs the layer `albedo`",
    )] = False
    albedo_floor: Annotated[float, Param(
        low=1e-4, high=0.5, scale="log", grad="smooth", source=_OURS,
        active_when="demodulate == true",
        meaning="least albedo that the color is divided by (demodulate)",
    )] = 0.01
    seed: Annotated[int, Param(
        low=0, high=2**31 - 1, grad="discrete", source=_OURS,
        active_when="prefilter == true",
        meaning="random samples of the pre-filter; each frame of a sequence gets others by itself",
    )] = 0
# fmt: on
