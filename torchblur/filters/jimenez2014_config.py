"""Parameters of Jimenez 2014."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.places import PairNoise
from torchblur.filters.reach import TILE_MEANING, ReachConfig
from torchblur.filters.revealed import RevealedBackgroundConfig
from torchblur.ops.gather import Lookup
from torchblur.ops.spread import Mirror, SpreadForm
from torchblur.params import Param

__all__ = ["Jimenez2014Config"]

_SLIDES = "Jimenez 2014, as in public ports"


# fmt: off
class Jimenez2014Config(RevealedBackgroundConfig, ReachConfig):
    """Parameters of Jimenez 2014; the defaults are those of the ports that agree."""

    num_samples: Annotated[
        int,
        Param(symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete",
              source="CryENGINE 5 and o3de have 6, 14 and 24",
              meaning="taps of the gather; they come in pairs, an odd number gets one more"),
    ] = 14
    tile_size: Annotated[
        int,
        Param(symbol="r", unit="px", low=1, high=512, scale="log", grad="discrete",
              source="McGuire 2012, section 3",
              meaning=TILE_MEANING),
    ] = 20
    depth_scale: Annotated[
        float,
        Param(symbol="κ_d", unit="1/scene unit", low=1e-4, high=1e4, scale="log", grad="smooth",
              source="1 in CryENGINE 5, o3de and Unity HDRP; 16 to 100 in others",
              meaning="how fast a depth difference tells front from back"),
    ] = 1.0
    depth_level: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="smooth", source=f"1/2: {_SLIDES}; 1 in the 2025 notes",
              meaning="share of the background where sample and pixel are at one depth"),
    ] = 0.5
    depth_compare: Annotated[
        Literal["absolute", "relative"],
        Param(grad="discrete", source="absolute: Jimenez 2014; relative: Guertin 2014, section 5",
              meaning="depth differences in scene units, or relative to the nearer depth"),
    ] = "absolute"
    spread_offset: Annotated[
        float,
        Param(unit="taps", low=0.0, high=4.0, grad="smooth", source=_SLIDES,
              meaning="how far beyond its end a blur still counts"),
    ] = 1.0
    spread_slope: Annotated[
        float,
        Param(unit="1/tap", low=0.05, high=20.0, scale="log", grad="smooth", source=_SLIDES,
              meaning="how steeply the weight falls at the end of a blur"),
    ] = 1.0
    spread_compare: Annotated[
        SpreadForm,
        Param(grad="discrete", source="slides: Jimenez 2014; static_zero: Unity HDRP",
              meaning="whether something static counts for the taps next to it (slides)"),
    ] = "slides"
    mirror_filter: Annotated[
        Mirror,
        Param(grad="discrete", source="Jimenez 2014; strict: torchblur",
              meaning="give both taps of a pair the weight of the nearer and faster one"),
    ] = "ports"
    noise: Annotated[
        PairNoise,
        Param(grad="discrete", source="Jimenez 2014; gradient: Unity HDRP, Blender",
              meaning="shift of a pixel's taps: 2x2 dither, interleaved gradient noise, Halton"),
    ] = "checkerboard"
    jitter: Annotated[
        float,
        Param(unit="taps", low=0.0, high=2.0, grad="weak", source=_SLIDES,
              active_when="noise != none",
              meaning="scale of that shift; at 1 the taps of neighbors interleave"),
    ] = 1.0
    tile_jitter: Annotated[
        float,
        Param(symbol="τ", unit="tiles", low=0.0, high=2.0, grad="weak",
              source="a quarter of a tile to each side in o3de, Unity HDRP and Kino",
              active_when="noise != none",
              meaning="how far the tile lookup may stray at the tile's edge, peak to peak"),
    ] = 0.5
    tile_classes: Annotated[
        bool,
        Param(grad="discrete", source="Jimenez 2014",
              meaning="average plainly, without weights, where all tiles move alike"),
    ] = True
    early_out: Annotated[
        float,
        Param(unit="px", low=0.0, high=4.0, grad="weak", source="McGuire 2012, section 3.3",
              meaning="static class: the tile's half spread is not above this"),
    ] = 0.505
    fast_ratio: Annotated[
        float,
        Param(low=0.05, high=1.0, grad="weak", source="1/4 in Unity HDRP, 0.65 in G3D",
              active_when="tile_classes == true",
              meaning="fast class: shortest half spread in reach over the longest, at least; low "
                      "values blur what moves otherwise in the wrong direction"),
    ] = 0.9
    neighbor_culling: Annotated[
        bool,
        Param(grad="discrete", source="Guertin 2014, section 4.4; CryENGINE 5",
              active_when="reach == tile",
              meaning="reach: tile: a diagonal tile counts only if it can reach the middle one"),
    ] = False
    tile_encoding: Annotated[
        Literal["float", "uint8"],
        Param(grad="discrete", source="Jimenez 2014",
              meaning="store the tiles' motion as floats, or in 8 bits"),
    ] = "float"
    softness: Annotated[
        float,
        Param(low=0.0, high=0.5, grad="discrete", source="torchblur",
              meaning="rounds the corners of the clamped weights, so that gradients pass them"),
    ] = 0.0
    color_lookup: Annotated[
        Lookup,
        Param(grad="discrete", source="McGuire 2012",
              meaning="lookup of the color; velocity and depth are always nearest"),
    ] = "nearest"
    seed: Annotated[
        int,
        Param(low=0, high=2**31 - 1, grad="discrete", source="torchblur",
              active_when="noise != none",
              meaning="shifts the noise (not the 2x2 dither); give each frame its own"),
    ] = 0
# fmt: on
