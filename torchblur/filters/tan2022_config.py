"""Parameters of Tan 2022: a gather, a mask for rays, and the composite of two layers."""

from __future__ import annotations

from typing import Annotated

from torchblur.filters.reconstruction import ReconstructionConfig
from torchblur.frame import ShutterPosition
from torchblur.params import Param

__all__ = ["Tan2022Config"]

_MASK = "Tan 2022, section 3.2.1"
_SETTINGS = "Tan 2022, section 4"
_UNSTATED = "not stated in the paper"


# fmt: off
class Tan2022Config(ReconstructionConfig):
    """Parameters of Tan 2022; the defaults are the paper's."""

    shutter_position: Annotated[ShutterPosition, Param(
        grad="discrete", source="Tan 2022, section 3.1 (the pixel at the end of the range)",
        meaning="open after the frame (leading), before it (trailing), or around it; the first "
                "two sample one side only",
    )] = "leading"
    tile_size: Annotated[int, Param(
        symbol="m", unit="px", low=1, high=512, scale="log", grad="discrete", source=_SETTINGS,
        meaning="edge of a tile, and the longest blur (reach: tile): the whole of it on one side, "
                "half of it with a centered shutter",
    )] = 40
    soft_depth_extent: Annotated[float, Param(
        symbol="SOFT_Z_EXTENT", unit="scene units", low=1e-4, high=1e4, scale="log",
        grad="smooth", source=f"{_SETTINGS}: 3 cm and 5 mm",
        meaning="depth difference over which front and back are told apart",
    )] = 0.03
    center_gain: Annotated[float, Param(
        low=0.01, high=100.0, scale="log", grad="smooth",
        source=f"McGuire 2012, section 3.3 ({_UNSTATED})",
        meaning="gain of the pixel's own weight, 1 / length of its blur",
    )] = 1.0
    jitter: Annotated[float, Param(
        symbol="j", unit="taps", low=0.0, high=1.0, grad="weak",
        source=f"McGuire 2012, section 3.3 ({_UNSTATED})",
        active_when="noise != none",
        meaning="peak to peak amplitude of the shift of a pixel's taps",
    )] = 1.0
    foreground_magnifier: Annotated[float, Param(
        low=0.1, high=100.0, scale="log", grad="smooth", source=_SETTINGS,
        meaning="gain of the first weight for samples nearer than the pixel by the depth extent",
    )] = 30.0
    mask_magnifier: Annotated[float, Param(
        low=0.1, high=30.0, scale="log", grad="smooth", source=_SETTINGS,
        meaning="in the ray mask background weights times this, foreground weights over this",
    )] = 3.0
    background_depth: Annotated[float, Param(
        low=0.01, high=2.0, scale="log", grad="smooth", source=f"torchblur ({_UNSTATED})",
        meaning="share of the way from the pixel to the revealed layer behind it, in "
                "1 / depth, from which a tap shows the background",
    )] = 1.0
    edge_threshold: Annotated[float, Param(
        symbol="e", low=0.01, high=0.999, grad="weak",
        source=f"{_SETTINGS}: 0.9, 0.96 and 0.98",
        meaning="edge strength above which a pixel is in the edge mask",
    )] = 0.9
    depth_edge_gain: Annotated[float, Param(
        low=0.01, high=100.0, scale="log", grad="weak", source=f"{_MASK}, eq. 3",
        meaning="gain of the Sobel operator on the relative depth",
    )] = 1.0
    normal_edge_gain: Annotated[float, Param(
        low=0.01, high=100.0, scale="log", grad="weak", source=f"{_MASK}, eq. 3",
        meaning="gain of the Sobel operator on the normals",
    )] = 1.0
    mask_samples: Annotated[int, Param(
        unit="taps", low=1, high=512, scale="log", grad="discrete",
        source=f"one a px at the longest blur ({_UNSTATED})",
        meaning="samples of the range check along a pixel's own motion",
    )] = 40
    threshold_softness: Annotated[float, Param(
        low=0.0, high=1.0, grad="discrete", source="torchblur",
        meaning="width of the thresholds (depth, edge, magnifier); above 0 gradients pass them",
    )] = 0.0
# fmt: on
