"""Parameters that torchblur's own filter and the composed one share: motion, reach, depth, sums."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.parts.cost import Cost, tiles
from torchblur.filters.parts.places import PairNoise
from torchblur.filters.parts.reach import REACH_MEANING, SPACING_MEANING
from torchblur.filters.parts.reconstruction import GatherConfig
from torchblur.filters.parts.revealed import RevealedBackgroundConfig
from torchblur.ops.directions import DirectionReduction
from torchblur.params import Param

__all__ = ["FrontBackConfig", "motion_cost", "num_ways"]

_OURS = "torchblur"
_GUERTIN = "Guertin 2014"
_JIMENEZ = "Jimenez 2014"
_NOTES = "2025 notes"


# fmt: off
class FrontBackConfig(RevealedBackgroundConfig, GatherConfig):
    """Where taps lie, how far, and how front and back are told apart and put together."""

    # -- taps --------------------------------------------------------------------------------------
    first_direction: Annotated[bool, Param(
        grad="discrete", source="McGuire 2012, section 3",
        meaning="taps along the tile's dominant motion",
    )] = True
    own_direction: Annotated[bool, Param(
        grad="discrete", source=f"{_GUERTIN}, section 4.1",
        meaning="taps along the pixel's own motion too",
    )] = True
    second_direction: Annotated[bool, Param(
        grad="discrete", source=f"{_NOTES}, Second Blur Direction",
        meaning="taps along the tile's second motion too",
    )] = True
    edge_motion: Annotated[Literal["own", "nearest", "surface"], Param(
        grad="discrete", source=f"nearest: Karis 2014, temporal anti-aliasing; surface: {_OURS}",
        meaning="motion (surface: and depth) of a pixel beside a nearer one: its own, which is "
                "a mixture in anti-aliased frames, or that of the nearest of 3x3",
    )] = "nearest"
    edge_depth: Annotated[float, Param(
        low=0.0, high=1.0, grad="weak", source=_OURS,
        active_when="edge_motion != own",
        meaning="how much nearer, as a share of the depth, a pixel beside must be for that",
    )] = 0.0
    noise: Annotated[PairNoise, Param(
        grad="discrete", source=f"halton: {_GUERTIN}; checkerboard: {_JIMENEZ}",
        meaning="shift of a pixel's taps: 2x2 dither, interleaved gradient noise, Halton",
    )] = "none"  # type: ignore[assignment]  # more than the base has
    jitter: Annotated[float, Param(
        unit="taps", low=0.0, high=32.0, grad="weak",
        source=f"1: McGuire 2012, {_JIMENEZ}; 2 η φ / N: {_GUERTIN}",
        active_when="noise != none",
        meaning="peak to peak amplitude of that shift",
    )] = 1.0
    tile_jitter: Annotated[float, Param(
        symbol="τ", unit="tiles", low=0.0, high=2.0, grad="weak",
        source=f"1: {_GUERTIN}, section 4.2; 1/2: {_JIMENEZ}",
        active_when="noise != none",
        meaning="how far the tile lookup may stray at the tile's edge, peak to peak",
    )] = 0.0

    # -- reach and tiles ---------------------------------------------------------------------------
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
        active_when="reach == tile",
        meaning="reach: tile: a diagonal tile counts only if its motion can reach the middle one",
    )] = False
    direction_reduction: Annotated[DirectionReduction, Param(
        grad="discrete", source=f"hierarchical: {_NOTES}; exact: {_OURS}",
        active_when="second_direction == true and reach == tile",
        meaning="reach: tile: second direction from all pixels, or from cells, tiles, 3x3 tiles",
    )] = "exact"
    secondary_exponent: Annotated[float, Param(
        low=0.25, high=8.0, scale="log", grad="weak", source=_NOTES,
        active_when="second_direction == true",
        meaning="how much the angle counts against the length in the second direction",
    )] = 2.0
    velocity_encoding: Annotated[Literal["float", "uint8", "tiles"], Param(
        grad="discrete", source=f"uint8: {_GUERTIN}, section 5; tiles: {_JIMENEZ}",
        meaning="store velocities and tiles as floats, both in 8 bits, or the tiles alone",
    )] = "float"

    # -- depth -------------------------------------------------------------------------------------
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
        active_when="depth_compare == relative",
        meaning="depth difference, relative to the nearer depth, that tells front from back",
    )] = 0.05
    soft_depth_extent: Annotated[float, Param(
        unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
        source="McGuire 2012, section 3.3",
        active_when="depth_compare == absolute",
        meaning='the same for depth_compare="absolute", as a distance',
    )] = 0.1

    # -- sums --------------------------------------------------------------------------------------
    missing_background: Annotated[Literal["foreground", "center"], Param(
        grad="discrete", source=f"center: {_NOTES}; foreground: {_OURS}",
        meaning="what fills in where no tap shows a back: the front, or the own color",
    )] = "foreground"
    background_fade: Annotated[float, Param(
        low=0.0, high=1.0, grad="discrete", source=f"0: {_NOTES}; above: {_OURS}",
        meaning="share of the taps up to which a blurred back fades in; 0 is all or nothing",
    )] = 0.05
    center_taps: Annotated[float, Param(
        unit="taps", low=0.0, high=8.0, grad="smooth", source="Blender's EEVEE",
        meaning="weight of the pixel's own color in the back, or in the one sum",
    )] = 0.0
    alpha_gain: Annotated[float, Param(
        low=0.1, high=4.0, scale="log", grad="smooth", source=f"1: {_NOTES}",
        meaning="gain of the foreground's alpha, before it is clamped",
    )] = 1.0
# fmt: on


def num_ways(config: FrontBackConfig) -> int:
    """Return along how many directions taps lie; what is reversed counts as the same one."""
    asked = (config.first_direction, config.own_direction, config.second_direction)
    return max(sum(map(int, asked)), 1)


def motion_cost(config: FrontBackConfig) -> Cost:
    """Return what the tiles' motions cost, and what makes the motion at edges clean."""
    found = tiles(config.tile_size, 3 if config.second_direction else 2)
    return found if config.edge_motion == "own" else found + Cost(lookups=9, passes=1)
