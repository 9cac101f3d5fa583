"""Parameters of Guertin 2014."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.reach import TILE_MEANING
from torchblur.filters.reconstruction import ReconstructionConfig
from torchblur.filters.revealed import RevealedBackgroundConfig
from torchblur.params import Param

__all__ = ["Guertin2014Config"]

_SETTINGS = "Guertin 2014, section 5"


# fmt: off
class Guertin2014Config(RevealedBackgroundConfig, ReconstructionConfig):
    """Parameters of Guertin 2014; the defaults are the paper's."""

    num_samples: Annotated[
        int,
        Param(symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete",
              source=_SETTINGS, meaning="taps of the gather, over both directions"),
    ] = 35
    tile_size: Annotated[
        int,
        Param(symbol="r", unit="px", low=1, high=512, scale="log", grad="discrete",
              source=_SETTINGS,
              meaning=TILE_MEANING),
    ] = 40
    tau: Annotated[
        float,
        Param(symbol="τ", low=0.0, high=2.0, grad="weak", source="Guertin 2014, section 4.2",
              active_when="stochastic_tiles == true",
              meaning="how far the tile lookup may stray over the tile's edge"),
    ] = 1.0
    kappa: Annotated[
        float,
        Param(symbol="κ", low=1.0, high=1000.0, scale="log", grad="smooth",
              source="Guertin 2014, section 4.3",
              active_when="center_weight == true",
              meaning="the pixel's own weight is N / (κ · half spread): larger blurs more"),
    ] = 40.0
    eta: Annotated[
        float,
        Param(symbol="η", unit="taps", low=0.0, high=2.0, grad="weak",
              source="Guertin 2014, section 4.5",
              active_when="noise != none",
              meaning="largest jitter of a pixel's taps"),
    ] = 0.95
    gamma: Annotated[
        float,
        Param(symbol="γ", unit="px", low=0.05, high=20.0, scale="log", grad="weak",
              source="Guertin 2014, section 4.1, eq. 1",
              meaning="half spread above the least at which the center direction is the pixel's"),
    ] = 1.5
    phi: Annotated[
        float,
        Param(symbol="φ", unit="taps", low=0.0, high=200.0, grad="weak",
              source="Guertin 2014, section 4.5",
              active_when="noise != none",
              meaning="the jitter is scaled by φ / N"),
    ] = 27.0
    direction_exponent: Annotated[
        float,
        Param(low=0.1, high=16.0, scale="log", grad="smooth",
              source="1 in Guertin 2014, section 4.1; 3 in the 2025 notes",
              active_when="direction_weights == true",
              meaning="exponent of the direction weights"),
    ] = 1.0
    relative_depth_extent: Annotated[
        float,
        Param(symbol="λ", low=1e-3, high=10.0, scale="log", grad="smooth",
              source="Guertin 2014, section 5 (zCompare); 1 is the paper's",
              active_when="depth_compare == relative",
              meaning="depth difference, relative to the nearer depth, that tells front from back"),
    ] = 1.0
    soft_depth_extent: Annotated[
        float,
        Param(unit="scene units", low=1e-4, high=1e4, scale="log", grad="smooth",
              source="McGuire 2012, section 3.3",
              active_when="depth_compare == absolute",
              meaning='the same for depth_compare="absolute", as a distance'),
    ] = 0.1
    directions: Annotated[
        Literal["one", "two"],
        Param(grad="discrete", source="Guertin 2014, section 4.1",
              meaning="taps along the tile's direction only, or along the pixel's too"),
    ] = "two"
    sample_assignment: Annotated[
        Literal["even", "variance"],
        Param(grad="discrete", source="Guertin 2014, section 4.1, eq. 2",
              active_when="directions == two",
              meaning="split of the taps: half and half, or by the variance of the tiles"),
    ] = "even"
    direction_weights: Annotated[
        bool,
        Param(grad="discrete", source="Guertin 2014, section 4.1",
              meaning="weight taps by how well velocity and sampling direction agree"),
    ] = True
    own_direction_against: Annotated[
        Literal["tap", "tile"],
        Param(grad="discrete", source="pseudocode (tap) against text (tile) of Guertin 2014",
              active_when="direction_weights == true",
              meaning="what the pixel's direction is compared with in the second weight"),
    ] = "tap"
    tap_length: Annotated[
        Literal["tile", "own"],
        Param(grad="discrete", source="tile: Guertin 2014; own: Blender's EEVEE",
              active_when="directions == two",
              meaning="reach of the taps along the pixel's direction: the tile's, or its own"),
    ] = "tile"
    stochastic_tiles: Annotated[
        bool,
        Param(grad="discrete", source="Guertin 2014, section 4.2",
              meaning="jitter the tile lookup near the edges of tiles"),
    ] = True
    neighbor_culling: Annotated[
        bool,
        Param(grad="discrete", source="Guertin 2014, section 4.4",
              active_when="reach == tile",
              meaning="reach: tile: a diagonal tile counts only if it can reach the middle one"),
    ] = True
    center_weight: Annotated[
        bool,
        Param(grad="discrete", source="Guertin 2014, section 4.3",
              meaning="give the pixel's own color the weight N / (κ · half spread)"),
    ] = True
    depth_compare: Annotated[
        Literal["relative", "absolute"],
        Param(grad="discrete", source="Guertin 2014, section 5; McGuire 2012",
              meaning="depth differences relative to the nearer depth, or in scene units"),
    ] = "relative"
    velocity_encoding: Annotated[
        Literal["float", "uint8"],
        Param(grad="discrete", source="Guertin 2014, section 5",
              meaning="store velocities and tiles as floats, or in 8 bits as in the paper"),
    ] = "float"
    luma: Annotated[
        Literal["true", "checkerboard"],
        Param(grad="discrete", source="Guertin 2014, section 4.5",
              meaning="luma for the anti-aliasing that follows, where there is blur"),
    ] = "checkerboard"
# fmt: on
