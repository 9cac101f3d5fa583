"""Parameters of the composed filter: the published parts by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from torchblur.filters.notes2025.config import PostFilterConfig
from torchblur.filters.parts.front_back_config import FrontBackConfig
from torchblur.filters.parts.reconstruction import ColorLookup, ReconstructionConfig
from torchblur.ops.spread import Mirror, SpreadForm
from torchblur.params import Param, declared

__all__ = ["ComposedConfig"]

_OURS = "torchblur"
_GUERTIN = "Guertin 2014"
_JIMENEZ = "Jimenez 2014"
_NOTES = "2025 notes"
_BASE = declared(ReconstructionConfig)
_POST = declared(PostFilterConfig)


# fmt: off
class ComposedConfig(PostFilterConfig, FrontBackConfig, ReconstructionConfig):
    """Parameters of the composed filter. `special_case` has the sets of the published ones."""

    # -- taps ----------------------------------------------------------------------------------
    sampling: Annotated[Literal["alternate", "pairs"], Param(
        grad="discrete", source=f"alternate: {_GUERTIN}; pairs: {_JIMENEZ}",
        meaning="what a tap is: one direction by turns, or two sides of the pixel in each",
    )] = "pairs"
    num_samples: Annotated[int, Param(
        symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete", source=_OURS,
        meaning="taps: over all directions (alternate), or per direction (pairs, made even)",
    )] = 16
    color_lookup: Annotated[ColorLookup, Param(
        grad="discrete", source=f"opportunistic: {_NOTES}; cubic: {_OURS}",
        meaning="lookup of the color; velocity and depth are always nearest",
    )] = "cubic"  # type: ignore[assignment]  # more than the base has
    bilinear_min: Annotated[float, Param(
        unit="px", low=0.0, high=8.0, grad="weak", source=_NOTES,
        meaning="least half spread of all tiles within reach at which a tile counts as moving",
    )] = 1.0
    double_samples: Annotated[bool, Param(
        grad="discrete", source=_NOTES,
        active_when="sampling == pairs",
        meaning="pairs: twice the taps along the first direction where not the whole tile moves",
    )] = False
    skip_middle_tap: Annotated[bool, Param(
        grad="discrete", source="McGuire 2012, section 3.3",
        active_when="sampling == alternate and shutter_position == centered",
        meaning="alternate: leave out the tap at the pixel itself (centered shutter only)",
    )] = False

    # -- reach and tiles -----------------------------------------------------------------------
    min_angle: Annotated[float, Param(
        unit="degrees", low=0.0, high=90.0, grad="weak", source=_NOTES,
        active_when="sampling == pairs and second_direction == true",
        meaning="pairs: the second direction is skipped where it is closer to the first",
    )] = 5.0
    tile_classes: Annotated[bool, Param(
        grad="discrete", source=_JIMENEZ,
        meaning="average plainly, without weights, where all tiles move alike",
    )] = False
    fast_ratio: Annotated[float, Param(
        low=0.05, high=1.0, grad="weak", source="1/4 in Unity HDRP, 0.65 in G3D",
        active_when="tile_classes == true",
        meaning="tile_classes: shortest half spread in reach over the longest, at least",
    )] = 0.9

    # -- spread and direction ------------------------------------------------------------------
    spread: Annotated[Literal["cone", "ramp"], Param(
        grad="discrete", source=f"cone: McGuire 2012; ramp: {_JIMENEZ}",
        meaning="how far a blur reaches: over its length, or to its end and some taps beyond",
    )] = "cone"
    spread_offset: Annotated[float, Param(
        unit="taps", low=0.0, high=4.0, grad="smooth", source=_JIMENEZ,
        active_when="spread == ramp",
        meaning="ramp: how far beyond its end a blur still counts",
    )] = 1.0
    spread_slope: Annotated[float, Param(
        unit="1/tap", low=0.05, high=20.0, scale="log", grad="smooth", source=_JIMENEZ,
        active_when="spread == ramp",
        meaning="ramp: how steeply the weight falls at the end of a blur",
    )] = 1.0
    spread_compare: Annotated[SpreadForm, Param(
        grad="discrete", source=f"slides: {_JIMENEZ}; static_zero: Unity HDRP, {_NOTES}",
        active_when="spread == ramp",
        meaning="ramp: whether something static counts for the taps next to it (slides)",
    )] = "static_zero"
    cone_slope: Annotated[float, replace(_BASE["cone_slope"], active_when="spread == cone")] = 1.0
    cone_exponent: Annotated[
        float, replace(_BASE["cone_exponent"], active_when="spread == cone")
    ] = 1.0
    third_form: Annotated[Literal["shorter", "product", "none"], Param(
        grad="discrete", source=f"product: McGuire 2012; shorter: {_GUERTIN}; none: {_JIMENEZ}",
        meaning="third weight: cylinder over the shorter of both blurs, both cylinders, or none",
    )] = "shorter"
    third_gain: Annotated[
        float, replace(_BASE["third_gain"], active_when="third_form != none")
    ] = 2.0
    cylinder_inner: Annotated[
        float, replace(_BASE["cylinder_inner"], active_when="third_form != none")
    ] = 0.95
    cylinder_outer: Annotated[
        float, replace(_BASE["cylinder_outer"], active_when="third_form != none")
    ] = 1.05
    direction_weights: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.1; {_NOTES}",
        meaning="weight taps by how well motion and sampling direction agree",
    )] = True
    direction_exponent: Annotated[float, Param(
        low=0.1, high=16.0, scale="log", grad="smooth", source=f"1: {_GUERTIN}; 3: {_NOTES}",
        active_when="direction_weights == true",
        meaning="exponent of the direction weights",
    )] = 1.0
    center_direction: Annotated[Literal["velocity", "blend"], Param(
        grad="discrete", source=f"velocity: {_NOTES}; blend: {_GUERTIN}, eq. 1",
        meaning="the pixel's direction: of its motion, or across the tile's where it is slow",
    )] = "velocity"
    gamma: Annotated[float, Param(
        symbol="γ", unit="px", low=0.05, high=20.0, scale="log", grad="weak", source=_GUERTIN,
        active_when="center_direction == blend",
        meaning="blend: half spread above the least at which that direction is the pixel's",
    )] = 1.5
    own_direction_against: Annotated[Literal["tap", "tile"], Param(
        grad="discrete", source=f"pseudocode (tap) against text (tile) of {_GUERTIN}",
        active_when="direction_weights == true",
        meaning="what the pixel's direction is compared with in the second weight",
    )] = "tap"
    tap_length: Annotated[Literal["tile", "own"], Param(
        grad="discrete", source=f"tile: {_GUERTIN}; own: Blender's EEVEE",
        meaning="reach of the taps along the pixel's direction: the tile's, or its own",
    )] = "tile"
    mirror_filter: Annotated[Mirror, Param(
        grad="discrete", source=f"{_JIMENEZ}; strict: {_OURS}",
        active_when="sampling == pairs",
        meaning="pairs: give both taps of a pair the weights of the nearer and faster one",
    )] = "none"

    # -- sums ----------------------------------------------------------------------------------
    resolve: Annotated[Literal["normalized", "over_center", "separate"], Param(
        grad="discrete", source=f"{_GUERTIN}; {_JIMENEZ}; {_NOTES}",
        meaning="one normalized sum; that over the pixel's color by its alpha; or front over back",
    )] = "separate"
    center_weight: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.3",
        active_when="resolve == normalized",
        meaning="normalized: give the pixel's own color the weight N / (κ · half spread)",
    )] = False
    kappa: Annotated[float, Param(
        symbol="κ", low=1e-3, high=1e5, scale="log", grad="smooth",
        source=f"40: {_GUERTIN}; N: McGuire 2012",
        active_when="center_weight == true",
        meaning="the larger, the less of that weight",
    )] = 40.0
    alpha_combination: Annotated[Literal["max", "mean"], Param(
        grad="discrete", source=f"max: {_NOTES}; mean: {_OURS}",
        active_when="sampling == pairs",
        meaning="pairs: alpha of several directions together",
    )] = "max"
    accurate_alpha: Annotated[bool, Param(
        grad="discrete", source=f"{_NOTES}, More Accurate Alpha Computation",
        active_when="resolve == separate",
        meaning="alpha from the area that each sample spreads over",
    )] = True
    area_slope: Annotated[float, Param(
        unit="1/px", low=0.1, high=16.0, scale="log", grad="smooth", source=_NOTES,
        active_when="accurate_alpha == true",
        meaning="a sample of half spread V covers 1 + area_slope * V px",
    )] = 2.0

    # -- post-filter ---------------------------------------------------------------------------
    post_filter: Annotated[bool, _POST["post_filter"]] = False
# fmt: on
