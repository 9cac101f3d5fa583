"""Parameters of torchblur's own filter: the published parts by name, and ours."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.places import PairNoise
from torchblur.filters.reach import REACH_MEANING, SPACING_MEANING
from torchblur.filters.reconstruction import ColorLookup, ReconstructionConfig
from torchblur.filters.revealed import RevealedBackgroundConfig
from torchblur.ops.directions import DirectionReduction
from torchblur.ops.spread import Mirror, SpreadForm
from torchblur.params import Param

__all__ = ["ComposedConfig"]

_OURS = "torchblur"
_GUERTIN = "Guertin 2014"
_JIMENEZ = "Jimenez 2014"
_NOTES = "2025 notes"


# fmt: off
class ComposedConfig(RevealedBackgroundConfig, ReconstructionConfig):
    """Parameters of the composed filter. `special_case` has the sets of the published ones."""

    # -- taps ----------------------------------------------------------------------------------
    sampling: Annotated[Literal["times", "alternate", "pairs"], Param(
        grad="discrete", source=f"alternate: {_GUERTIN}; pairs: {_JIMENEZ}; times: {_OURS}",
        meaning="what a tap is: a time at which all directions compete, one direction by turns, "
                "or two sides of the pixel in each direction",
    )] = "times"
    num_samples: Annotated[int, Param(
        symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete", source=_OURS,
        meaning="taps: times; over all directions (alternate); per direction (pairs, made even)",
    )] = 16
    first_direction: Annotated[bool, Param(
        grad="discrete", source="McGuire 2012, section 3",
        meaning="taps along the tile's dominant motion",
    )] = True
    own_direction: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.1",
        meaning="taps along the pixel's own motion too (alternate, pairs: center_direction)",
    )] = True
    second_direction: Annotated[bool, Param(
        grad="discrete", source=f"{_NOTES}, Second Blur Direction",
        meaning="taps along the tile's second motion too",
    )] = True
    reversed_direction: Annotated[bool, Param(
        grad="discrete", source=_OURS,
        meaning="times: taps on the other side too: they find what moves against the dominant "
                "motion",
    )] = True
    refinements: Annotated[int, Param(
        low=0, high=4, grad="discrete", source=f"{_OURS}, after Bowles 2012",
        meaning="times: how often a tap follows the motion that it found instead of the tile's",
    )] = 2
    match_tolerance: Annotated[float, Param(
        unit="px", low=0.05, high=64.0, scale="log", grad="smooth", source=_OURS,
        meaning="times: by how much a sample may miss the pixel at the tap's time",
    )] = 1.0
    match_slope: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source=_OURS,
        meaning="times: the same, over the distance between sample and pixel",
    )] = 0.0
    arrivals: Annotated[Literal["winner", "blend"], Param(
        grad="discrete", source=_OURS,
        meaning="times: color of the sample with the largest weight, or of all that arrive, at "
                "one lookup each",
    )] = "winner"
    hidden_times: Annotated[Literal["fill", "drop"], Param(
        grad="discrete", source=_OURS,
        meaning="times at which nothing arrives and the pixel's own line lies behind something "
                "nearer: filled with what passes the pixel at other times, or left out",
    )] = "fill"
    edge_motion: Annotated[Literal["own", "nearest", "surface"], Param(
        grad="discrete", source=f"nearest: Karis 2014, temporal anti-aliasing; surface: {_OURS}",
        meaning="motion (surface: and depth) of a pixel beside a nearer one: its own, which is "
                "a mixture in anti-aliased frames, or that of the nearest of 3x3",
    )] = "nearest"
    edge_depth: Annotated[float, Param(
        low=0.0, high=1.0, grad="weak", source=_OURS,
        meaning="how much nearer, as a share of the depth, a pixel beside must be for that",
    )] = 0.0
    noise: Annotated[PairNoise, Param(
        grad="discrete", source=f"halton: {_GUERTIN}; checkerboard: {_JIMENEZ}",
        meaning="shift of a pixel's taps: 2x2 dither, interleaved gradient noise, Halton",
    )] = "none"  # type: ignore[assignment]  # more than the base has
    jitter: Annotated[float, Param(
        unit="taps", low=0.0, high=32.0, grad="weak",
        source=f"1: McGuire 2012, {_JIMENEZ}; 2 η φ / N: {_GUERTIN}",
        meaning="peak to peak amplitude of that shift",
    )] = 1.0
    tile_jitter: Annotated[float, Param(
        symbol="τ", unit="tiles", low=0.0, high=2.0, grad="weak",
        source=f"1: {_GUERTIN}, section 4.2; 1/2: {_JIMENEZ}",
        meaning="how far the tile lookup may stray at the tile's edge, peak to peak",
    )] = 0.0
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
        meaning="pairs: twice the taps along the first direction where not the whole tile moves",
    )] = False
    skip_middle_tap: Annotated[bool, Param(
        grad="discrete", source="McGuire 2012, section 3.3",
        meaning="alternate: leave out the tap at the pixel itself (centered shutter only)",
    )] = False

    # -- reach and tiles -----------------------------------------------------------------------
    reach: Annotated[Literal["tile", "frame"], Param(
        grad="discrete", source=f"tile: McGuire 2012, section 3; frame: {_OURS}",
        meaning=REACH_MEANING,
    )] = "frame"
    tile_size: Annotated[int, Param(
        symbol="r", unit="px", low=1, high=512, scale="log", grad="discrete", source=_OURS,
        meaning="edge of a tile: small ones keep motions apart, whatever the reach",
    )] = 8
    early_out: Annotated[float, Param(
        unit="px", low=0.0, high=4.0, grad="weak", source=f"1/2: McGuire 2012; 1/4: {_OURS}",
        meaning="a pixel is left as it is where the tile's half spread is not above this",
    )] = 0.25
    tap_spacing: Annotated[float, Param(
        unit="px", low=0.0, high=64.0, grad="discrete", source=_OURS,
        meaning=SPACING_MEANING,
    )] = 3.0
    neighbor_culling: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.4",
        meaning="reach: tile: a diagonal tile counts only if its motion can reach the middle one",
    )] = False
    direction_reduction: Annotated[DirectionReduction, Param(
        grad="discrete", source=f"hierarchical: {_NOTES}; exact: {_OURS}",
        meaning="reach: tile: second direction from all pixels, or from cells, tiles, 3x3 tiles",
    )] = "exact"
    secondary_exponent: Annotated[float, Param(
        low=0.25, high=8.0, scale="log", grad="weak", source=_NOTES,
        meaning="how much the angle counts against the length in the second direction",
    )] = 2.0
    min_angle: Annotated[float, Param(
        unit="degrees", low=0.0, high=90.0, grad="weak", source=_NOTES,
        meaning="pairs: the second direction is skipped where it is closer to the first",
    )] = 5.0
    velocity_encoding: Annotated[Literal["float", "uint8", "tiles"], Param(
        grad="discrete", source=f"uint8: {_GUERTIN}, section 5; tiles: {_JIMENEZ}",
        meaning="store velocities and tiles as floats, both in 8 bits, or the tiles alone",
    )] = "float"
    tile_classes: Annotated[bool, Param(
        grad="discrete", source=_JIMENEZ,
        meaning="average plainly, without weights, where all tiles move alike",
    )] = False
    fast_ratio: Annotated[float, Param(
        low=0.05, high=1.0, grad="weak", source="1/4 in Unity HDRP, 0.65 in G3D",
        meaning="tile_classes: shortest half spread in reach over the longest, at least",
    )] = 0.9

    # -- depth ---------------------------------------------------------------------------------
    depth_classes: Annotated[Literal["shares", "independent"], Param(
        grad="discrete", source=f"shares: {_JIMENEZ}; independent: McGuire 2012",
        meaning="weights of front and back: add up to 1, or both 1 at one depth",
    )] = "shares"
    depth_level: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source=f"1/2: {_JIMENEZ}; 1: McGuire 2012, {_NOTES}",
        meaning="weight of the back (independent: of both) where sample and pixel are level",
    )] = 0.5
    depth_compare: Annotated[Literal["relative", "absolute"], Param(
        grad="discrete", source=f"relative: {_GUERTIN}, section 5; absolute: McGuire 2012",
        meaning="depth differences relative to the nearer depth, or in scene units",
    )] = "relative"
    relative_depth_extent: Annotated[float, Param(
        symbol="λ", low=1e-4, high=1e4, scale="log", grad="smooth", source=_GUERTIN,
        meaning="depth difference, relative to the nearer depth, that tells front from back",
    )] = 0.05
    soft_depth_extent: Annotated[float, Param(
        unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
        source="McGuire 2012, section 3.3",
        meaning='the same for depth_compare="absolute", as a distance',
    )] = 0.1

    # -- spread and direction (alternate, pairs) -----------------------------------------------
    spread: Annotated[Literal["cone", "ramp"], Param(
        grad="discrete", source=f"cone: McGuire 2012; ramp: {_JIMENEZ}",
        meaning="how far a blur reaches: over its length, or to its end and some taps beyond",
    )] = "cone"
    spread_offset: Annotated[float, Param(
        unit="taps", low=0.0, high=4.0, grad="smooth", source=_JIMENEZ,
        meaning="ramp: how far beyond its end a blur still counts",
    )] = 1.0
    spread_slope: Annotated[float, Param(
        unit="1/tap", low=0.05, high=20.0, scale="log", grad="smooth", source=_JIMENEZ,
        meaning="ramp: how steeply the weight falls at the end of a blur",
    )] = 1.0
    spread_compare: Annotated[SpreadForm, Param(
        grad="discrete", source=f"slides: {_JIMENEZ}; static_zero: Unity HDRP, {_NOTES}",
        meaning="ramp: whether something static counts for the taps next to it (slides)",
    )] = "static_zero"
    third_form: Annotated[Literal["shorter", "product", "none"], Param(
        grad="discrete", source=f"product: McGuire 2012; shorter: {_GUERTIN}; none: {_JIMENEZ}",
        meaning="third weight: cylinder over the shorter of both blurs, both cylinders, or none",
    )] = "shorter"
    direction_weights: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.1; {_NOTES}",
        meaning="weight taps by how well motion and sampling direction agree",
    )] = True
    direction_exponent: Annotated[float, Param(
        low=0.1, high=16.0, scale="log", grad="smooth", source=f"1: {_GUERTIN}; 3: {_NOTES}",
        meaning="exponent of the direction weights",
    )] = 1.0
    center_direction: Annotated[Literal["velocity", "blend"], Param(
        grad="discrete", source=f"velocity: {_NOTES}; blend: {_GUERTIN}, eq. 1",
        meaning="the pixel's direction: of its motion, or across the tile's where it is slow",
    )] = "velocity"
    gamma: Annotated[float, Param(
        symbol="γ", unit="px", low=0.05, high=20.0, scale="log", grad="weak", source=_GUERTIN,
        meaning="blend: half spread above the least at which that direction is the pixel's",
    )] = 1.5
    own_direction_against: Annotated[Literal["tap", "tile"], Param(
        grad="discrete", source=f"pseudocode (tap) against text (tile) of {_GUERTIN}",
        meaning="what the pixel's direction is compared with in the second weight",
    )] = "tap"
    tap_length: Annotated[Literal["tile", "own"], Param(
        grad="discrete", source=f"tile: {_GUERTIN}; own: Blender's EEVEE",
        meaning="reach of the taps along the pixel's direction: the tile's, or its own",
    )] = "tile"
    mirror_filter: Annotated[Mirror, Param(
        grad="discrete", source=f"{_JIMENEZ}; strict: {_OURS}",
        meaning="pairs: give both taps of a pair the weights of the nearer and faster one",
    )] = "none"

    # -- sums ----------------------------------------------------------------------------------
    resolve: Annotated[Literal["normalized", "over_center", "separate"], Param(
        grad="discrete", source=f"{_GUERTIN}; {_JIMENEZ}; {_NOTES}",
        meaning="one normalized sum; that over the pixel's color by its alpha; or front over back",
    )] = "separate"
    missing_background: Annotated[Literal["foreground", "center"], Param(
        grad="discrete", source=f"center: {_NOTES}; foreground: {_OURS}",
        meaning="separate: what fills in where no tap shows a back: the front, or the own color",
    )] = "foreground"
    background_fade: Annotated[float, Param(
        low=0.0, high=1.0, grad="discrete", source=f"0: {_NOTES}; above: {_OURS}",
        meaning="share of the taps up to which a blurred back fades in; 0 is all or nothing",
    )] = 0.05
    center_weight: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.3",
        meaning="normalized: give the pixel's own color the weight N / (κ · half spread)",
    )] = False
    kappa: Annotated[float, Param(
        symbol="κ", low=1e-3, high=1e5, scale="log", grad="smooth",
        source=f"40: {_GUERTIN}; N: McGuire 2012", meaning="the larger, the less of that weight",
    )] = 40.0
    center_taps: Annotated[float, Param(
        unit="taps", low=0.0, high=8.0, grad="smooth", source="Blender's EEVEE",
        meaning="weight of the pixel's own color in the one sum, or in the back (separate)",
    )] = 0.0
    alpha_combination: Annotated[Literal["max", "mean"], Param(
        grad="discrete", source=f"max: {_NOTES}; mean: {_OURS}",
        meaning="pairs: alpha of several directions together",
    )] = "max"
    accurate_alpha: Annotated[bool, Param(
        grad="discrete", source=f"{_NOTES}, More Accurate Alpha Computation",
        meaning="alternate, pairs: alpha from the area that each sample spreads over",
    )] = True
    area_slope: Annotated[float, Param(
        unit="1/px", low=0.1, high=16.0, scale="log", grad="smooth", source=_NOTES,
        meaning="a sample of half spread V covers 1 + area_slope * V px",
    )] = 2.0
    alpha_gain: Annotated[float, Param(
        low=0.1, high=4.0, scale="log", grad="smooth", source=f"1: {_NOTES}",
        meaning="separate: gain of the foreground's alpha, before it is clamped",
    )] = 1.0

    # -- post-filter ---------------------------------------------------------------------------
    post_filter: Annotated[bool, Param(
        grad="discrete", source=_NOTES, meaning="second pass that fills the gaps between the taps",
    )] = False
    post_samples: Annotated[int, Param(
        unit="taps", low=1, high=64, scale="log", grad="discrete", source=_NOTES,
        meaning="most taps of the post-filter per direction, both sides",
    )] = 6
    post_radius: Annotated[float, Param(
        low=0.05, high=2.0, grad="weak", source=_NOTES,
        meaning="radius of the post-filter over the gap between two taps",
    )] = 0.5
    post_alpha: Annotated[Literal["foreground", "output"], Param(
        grad="discrete", source=_NOTES,
        meaning="alpha that the post-filter compares: the foreground's, or 1 where there is blur",
    )] = "foreground"
    post_acceptance: Annotated[Literal["hard", "soft"], Param(
        grad="discrete", source=f"hard: {_NOTES}; soft: {_OURS}",
        meaning="threshold on the difference of alphas, or a bell that has gradients",
    )] = "hard"
    post_threshold: Annotated[float, Param(
        low=0.05, high=4.0, grad="weak", source=_NOTES,
        meaning="threshold on the difference of alphas, in steps of one tap per side (hard)",
    )] = 1.0
    post_tau: Annotated[float, Param(
        low=0.05, high=4.0, grad="smooth", source=_OURS,
        meaning="width of the bell over the difference of alphas, in the same steps (soft)",
    )] = 1.0
    post_zero_alpha: Annotated[float, Param(
        low=1e-6, high=0.5, grad="weak", source=f"0: {_NOTES}",
        meaning="alpha up to which a pixel counts as neither moving nor blurred over",
    )] = 1e-4
    post_edges: Annotated[bool, Param(
        grad="discrete", source=_NOTES,
        meaning="at the outer edge of a blur take samples without alpha, too",
    )] = True
    post_center_weight: Annotated[float, Param(
        low=0.01, high=8.0, scale="log", grad="smooth", source=_OURS,
        meaning="weight of the pixel itself in the post-filter, in taps",
    )] = 1.0
# fmt: on
