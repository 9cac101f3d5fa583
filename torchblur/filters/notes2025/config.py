"""Parameters of the 2025 notes: every section of the text is a switch, every constant a number."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.parts.base import FilterConfig
from torchblur.filters.parts.places import PairNoise
from torchblur.filters.parts.reach import TILE_MEANING, ReachConfig
from torchblur.filters.parts.revealed import RevealedBackgroundConfig
from torchblur.ops.directions import DirectionReduction
from torchblur.ops.spread import Mirror, SpreadForm
from torchblur.params import Param

__all__ = ["Notes2025Config", "PostFilterConfig"]

_BASE = "2025 notes, Baseline"
_SUMS = "2025 notes, Separating Background/Foreground"
_SECOND = "2025 notes, Second Blur Direction"
_POST = "2025 notes, Post-Filter"
_ALPHA = "2025 notes, More Accurate Alpha Computation"
_HALF = "2025 notes, Half Resolution Rendering"
_LINEAR = "2025 notes, Improving Quality Via Opportunistic Bilinear Interpolation"
_UNSTATED = "not stated in the text"
_CORNERS = "rounds the corners of the clamped weights, so that gradients pass them"


# fmt: off
class PostFilterConfig(FilterConfig):
    """Parameters of the second pass, which fills the gaps between the taps."""

    post_filter: Annotated[bool, Param(
        grad="discrete", source=_POST, meaning="second pass that fills the gaps between the taps",
    )] = True
    post_samples: Annotated[int, Param(
        unit="taps", low=1, high=64, scale="log", grad="discrete", source=_POST,
        active_when="post_filter == true",
        meaning="most taps of the post-filter per direction, both sides",
    )] = 6
    post_radius: Annotated[float, Param(
        low=0.05, high=2.0, grad="weak", source=_POST,
        active_when="post_filter == true",
        meaning="radius of the post-filter over the gap between two taps",
    )] = 0.5
    post_alpha: Annotated[Literal["foreground", "output"], Param(
        grad="discrete", source=f"foreground: {_POST}; output: {_HALF}",
        active_when="post_filter == true",
        meaning="alpha that the post-filter compares: the foreground's, or 1 where there is blur",
    )] = "foreground"
    post_acceptance: Annotated[Literal["hard", "soft"], Param(
        grad="discrete", source=f"hard: {_POST}; soft: torchblur",
        active_when="post_filter == true",
        meaning="threshold on the difference of alphas, or a bell that has gradients",
    )] = "hard"
    post_threshold: Annotated[float, Param(
        low=0.05, high=4.0, grad="weak", source=_POST,
        active_when="post_acceptance == hard",
        meaning="threshold on the difference of alphas, in steps of one tap per side (hard)",
    )] = 1.0
    post_tau: Annotated[float, Param(
        low=0.05, high=4.0, grad="smooth", source="torchblur",
        active_when="post_acceptance == soft",
        meaning="width of the bell over the difference of alphas, in the same steps (soft)",
    )] = 1.0
    post_zero_alpha: Annotated[float, Param(
        low=1e-6, high=0.5, grad="weak", source=f"0: {_POST}",
        active_when="post_filter == true",
        meaning="alpha up to which a pixel counts as neither moving nor blurred over",
    )] = 1e-4
    post_edges: Annotated[bool, Param(
        grad="discrete", source=_POST,
        active_when="post_filter == true",
        meaning="at the outer edge of a blur take samples without alpha, too",
    )] = True
    post_center_weight: Annotated[float, Param(
        low=0.01, high=8.0, scale="log", grad="smooth", source=f"torchblur ({_UNSTATED})",
        active_when="post_filter == true",
        meaning="weight of the pixel itself in the post-filter, in taps",
    )] = 1.0
# fmt: on


# fmt: off
class Notes2025Config(PostFilterConfig, RevealedBackgroundConfig, ReachConfig):
    """Parameters of the 2025 notes. The defaults are full resolution with all that it has.

    Where the text builds one direction it goes with ``depth_level=0.5`` and without direction
    weights: see configs/filters/notes2025-full-one.yaml.
    """

    # -- baseline ------------------------------------------------------------------------------
    num_samples: Annotated[int, Param(
        symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete", source=_BASE,
        meaning="taps per direction, both sides; they come in pairs, an odd number gets one more",
    )] = 6
    tile_size: Annotated[int, Param(
        symbol="r", unit="px", low=1, high=512, scale="log", grad="discrete", source=_BASE,
        meaning=f"{TILE_MEANING} (full resolution)",
    )] = 32
    noise: Annotated[PairNoise, Param(
        grad="discrete", source=_BASE,
        meaning="shift of a pixel's taps: 2x2 dither, interleaved gradient noise, Halton",
    )] = "checkerboard"
    jitter: Annotated[float, Param(
        unit="taps", low=0.0, high=2.0, grad="weak", source=_BASE,
        active_when="noise != none",
        meaning="scale of that shift; at 1 the taps of neighbors interleave",
    )] = 1.0
    tile_jitter: Annotated[float, Param(
        unit="tiles", low=0.0, high=2.0, grad="weak", source=f"{_SECOND} (tried and left out)",
        active_when="noise != none",
        meaning="how far the tile lookup may stray at the tile's edge, peak to peak",
    )] = 0.0
    early_out: Annotated[float, Param(
        unit="px", low=0.0, high=4.0, grad="weak", source=f"{_BASE}: half a step of 8 bits",
        meaning="a pixel is left as it is where the tile's half spread is not above this",
    )] = 0.125
    mirror_filter: Annotated[Mirror, Param(
        grad="discrete", source="Jimenez 2014; strict: torchblur",
        meaning="give both taps of a pair the weights of the nearer and faster one",
    )] = "ports"
    spread_compare: Annotated[SpreadForm, Param(
        grad="discrete", source="slides: Jimenez 2014; static_zero: Unity HDRP",
        meaning="whether something static counts for the taps next to it (slides)",
    )] = "static_zero"
    spread_offset: Annotated[float, Param(
        unit="taps", low=0.0, high=4.0, grad="smooth", source="Jimenez 2014",
        meaning="how far beyond its end a blur still counts; 1/2 is a tap's own share of the line",
    )] = 1.0
    spread_slope: Annotated[float, Param(
        unit="1/tap", low=0.05, high=20.0, scale="log", grad="smooth", source="Jimenez 2014",
        meaning="how steeply the weight falls at the end of a blur",
    )] = 1.0
    depth_range: Annotated[float, Param(
        unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
        source=f"{_SECOND} (1 / g_depthMaxDeltaRcp, {_UNSTATED})",
        active_when="depth_compare == absolute",
        meaning="depth difference that tells front from back",
    )] = 1.0
    relative_depth_range: Annotated[float, Param(
        low=1e-3, high=10.0, scale="log", grad="smooth", source="torchblur",
        active_when="depth_compare == relative",
        meaning='the same for depth_compare="relative", as a fraction of the nearer depth',
    )] = 0.1
    depth_compare: Annotated[Literal["absolute", "relative"], Param(
        grad="discrete", source="absolute: the notes; relative: Guertin 2014, section 5",
        meaning="depth differences in scene units, or relative to the nearer depth",
    )] = "absolute"
    velocity_encoding: Annotated[Literal["float", "uint8"], Param(
        grad="discrete", source=_BASE,
        meaning="store velocities and tiles as floats, or in 8 bits",
    )] = "float"
    softness: Annotated[float, Param(
        low=0.0, high=0.5, grad="discrete", source="torchblur", meaning=_CORNERS,
    )] = 0.0
    seed: Annotated[int, Param(
        low=0, high=2**31 - 1, grad="discrete", source="torchblur",
        active_when="noise != none",
        meaning="shifts the noise (not the 2x2 dither); give each frame its own",
    )] = 0

    # -- sums ----------------------------------------------------------------------------------
    separate_sums: Annotated[bool, Param(
        grad="discrete", source=_SUMS,
        meaning="separate sums of foreground and background, or one sum over the pixel's color",
    )] = True
    center_weight: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source="0 in the notes; above it as in Blender's EEVEE",
        active_when="separate_sums == true",
        meaning="weight of the pixel's own color in the background, in taps",
    )] = 0.0
    background_fade: Annotated[float, Param(
        low=0.0, high=1.0, grad="discrete", source=f"0: {_HALF}",
        active_when="separate_sums == true",
        meaning="share of the taps up to which a blurred background fades in; 0 is all or nothing",
    )] = 0.0

    # -- directions ----------------------------------------------------------------------------
    directions: Annotated[Literal["one", "two"], Param(
        grad="discrete", source=_SECOND,
        meaning="taps along the tile's dominant motion only, or along a second direction too",
    )] = "two"
    direction_reduction: Annotated[DirectionReduction, Param(
        grad="discrete", source=f"hierarchical: {_SECOND}; exact: torchblur",
        active_when="directions == two and reach == tile",
        meaning="reach: tile: second direction from all pixels, or from cells, tiles, 3x3 tiles",
    )] = "exact"
    secondary_exponent: Annotated[float, Param(
        low=0.25, high=8.0, scale="log", grad="weak", source=_SECOND,
        active_when="directions == two",
        meaning="how much the angle counts against the length in the second direction",
    )] = 2.0
    neighbor_culling: Annotated[bool, Param(
        grad="discrete", source="Guertin 2014, section 4.4",
        active_when="reach == tile",
        meaning="reach: tile: a diagonal tile counts only if it can reach the middle one",
    )] = False
    min_angle: Annotated[float, Param(
        unit="degrees", low=0.0, high=90.0, grad="weak", source=_SECOND,
        active_when="directions == two",
        meaning="the second direction is skipped where the two are closer than this",
    )] = 5.0
    depth_level: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source=f"1: {_SECOND}; 1/2 with one direction",
        meaning="share of the background where sample and pixel are at one depth",
    )] = 1.0
    direction_weights: Annotated[bool, Param(
        grad="discrete", source=f"{_SECOND}; off with one direction",
        meaning="weight taps by how well motion and sampling direction agree",
    )] = True
    direction_exponent: Annotated[float, Param(
        low=0.1, high=16.0, scale="log", grad="smooth", source=_SECOND,
        active_when="direction_weights == true",
        meaning="exponent of the direction weights",
    )] = 3.0
    tile_classes: Annotated[bool, Param(
        grad="discrete", source=f"{_BASE}; off: torchblur",
        meaning="average plainly, without weights, where all tiles move alike",
    )] = False
    fast_ratio: Annotated[float, Param(
        low=0.05, high=1.0, grad="weak", source="1/4 in Unity HDRP, 0.65 in G3D",
        active_when="tile_classes == true",
        meaning="tile_classes: shortest half spread in reach over the longest, at least",
    )] = 0.9
    alpha_combination: Annotated[Literal["max", "mean"], Param(
        grad="discrete", source=f"max: {_SECOND}; mean: torchblur, for comparison",
        active_when="directions == two",
        meaning="alpha of the two directions together",
    )] = "max"

    # -- alpha ---------------------------------------------------------------------------------
    accurate_alpha: Annotated[bool, Param(
        grad="discrete", source=_ALPHA,
        meaning="alpha from the area that each sample spreads over, not from the count of taps",
    )] = True
    area_slope: Annotated[float, Param(
        unit="1/px", low=0.1, high=16.0, scale="log", grad="smooth", source=_ALPHA,
        active_when="accurate_alpha == true",
        meaning="a sample of half spread V covers 1 + area_slope * V px",
    )] = 2.0
    alpha_gain: Annotated[float, Param(
        low=0.1, high=4.0, scale="log", grad="smooth", source="1 in the notes",
        meaning="gain of the foreground's alpha, before it is clamped",
    )] = 1.0

    # -- bilinear lookups ----------------------------------------------------------------------
    color_lookup: Annotated[Literal["nearest", "bilinear", "opportunistic"], Param(
        grad="discrete", source=_LINEAR,
        meaning="lookup of the color; opportunistic is bilinear where the whole tile moves",
    )] = "opportunistic"
    bilinear_min: Annotated[float, Param(
        unit="px", low=0.0, high=8.0, grad="weak", source=_LINEAR,
        meaning="least half spread of all tiles within reach at which a tile counts as moving",
    )] = 1.0
    double_samples: Annotated[bool, Param(
        grad="discrete", source=_LINEAR,
        meaning="twice the taps along the first direction where not the whole tile moves",
    )] = True

    # -- half resolution -----------------------------------------------------------------------
    resolution: Annotated[Literal["full", "half"], Param(
        grad="discrete", source=_HALF, meaning="resolution of the blur and of the post-filter",
    )] = "full"
    downsample_depth_range: Annotated[float, Param(
        unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
        source=f"{_HALF} (g_downsampleDepthRange, {_UNSTATED})",
        active_when="resolution == half",
        meaning="distance to the nearest of 2x2 pixels at which motion and depth do not count",
    )] = 1.0
    upsample_depth_range: Annotated[float, Param(
        unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
        source=f"{_HALF} (g_upsampleDepthRange, {_UNSTATED})",
        active_when="upsample_depth_weights == true",
        meaning="distance behind a pixel at which a half-resolution sample does not count",
    )] = 1.0
    upsample_depth_weights: Annotated[bool, Param(
        grad="discrete", source=_HALF,
        active_when="resolution == half",
        meaning="weight alphas by depth, so that no background blurs over a sharp foreground",
    )] = True
    alpha_weighted_color: Annotated[bool, Param(
        grad="discrete", source=_HALF,
        active_when="resolution == half",
        meaning="weight colors by alpha, so that no sharp foreground leaks into the background",
    )] = True
    corner_fallback: Annotated[bool, Param(
        grad="discrete", source=_HALF,
        active_when="upsample_depth_weights == true",
        meaning="leave the depth weights out where they leave nothing",
    )] = True
    alpha_fade: Annotated[bool, Param(
        grad="discrete", source=_HALF,
        active_when="resolution == half",
        meaning="fade to full resolution where motion is shorter than a half-resolution pixel",
    )] = True
    fade_start: Annotated[float, Param(
        unit="px", low=0.0, high=1.5, grad="smooth", source=_HALF,
        active_when="alpha_fade == true",
        meaning="half spread up to which the alpha is fade_min_alpha (full-resolution px)",
    )] = 1.0
    fade_end: Annotated[float, Param(
        unit="px", low=1.6, high=16.0, grad="smooth", source=_HALF,
        active_when="alpha_fade == true",
        meaning="half spread from which the alpha is left as it is (full-resolution px)",
    )] = 2.0
    fade_min_alpha: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source=_HALF,
        active_when="alpha_fade == true",
        meaning="factor of the faded alpha",
    )] = 0.5
# fmt: on
