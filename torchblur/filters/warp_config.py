"""Parameters of the forward warp. No paper stands behind it: all defaults are torchblur's."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.base import FilterConfig
from torchblur.frame import LONGEST_SHUTTER
from torchblur.params import Param

__all__ = ["WarpConfig"]

_OURS = "torchblur"
_TUNED = "torchblur: Cycles frames (vase, cars, weapon)"


# fmt: off
class WarpConfig(FilterConfig):
    """Parameters of the forward warp."""

    shutter: Annotated[float, Param(
        symbol="E", unit="frame", low=0.0, high=LONGEST_SHUTTER, grad="smooth",
        source="180 degree shutter = 0.5",
        meaning="open time of the shutter in frames; the length of the paths",
    )] = 0.5
    num_samples: Annotated[int, Param(
        symbol="k", unit="moments", low=1, high=512, scale="log", grad="discrete", source=_OURS,
        meaning="moments over the open shutter; fewer than the longest path has px leave copies",
    )] = 32
    curved: Annotated[bool, Param(
        grad="discrete", source=_OURS,
        meaning="follow the path p + v t + a t² / 2 if the frame has the acceleration a",
    )] = True
    supersampling: Annotated[int, Param(
        symbol="s", low=1, high=4, grad="discrete", source=f"{_OURS}: 3 changes less than 1e-4",
        meaning="splats per pixel along each axis, for surfaces that grow to several times their "
                "size",
    )] = 1
    footprint: Annotated[float, Param(
        symbol="w", low=0.25, high=1.0, grad="smooth", source=_OURS,
        meaning="edge of a splat over that of its share of a pixel; below 1 crisper, with cracks",
    )] = 1.0
    depth_extent: Annotated[float, Param(
        symbol="ε", low=1e-3, high=1.0, scale="log", grad="smooth", source=_TUNED,
        meaning="relative depth over which front and back are told apart",
    )] = 0.02
    depth_slope: Annotated[float, Param(
        symbol="σ", unit="px", low=0.0, high=4.0, grad="smooth", source=_OURS,
        meaning="depth by which a slanted surface may lie behind itself: its own step over so "
                "many px",
    )] = 1.0
    depth_gap: Annotated[float, Param(
        symbol="g", low=1e-3, high=4.0, scale="log", grad="weak", source=_TUNED,
        meaning="relative depth step from which two neighbors are two surfaces",
    )] = 0.1
    coverage_gain: Annotated[float, Param(
        symbol="γ", low=0.5, high=4.0, scale="log", grad="smooth", source=_TUNED,
        meaning="gain of the share of a pixel that splats cover; closes cracks, widens edges",
    )] = 1.2
    stretch: Annotated[float, Param(
        symbol="j", low=0.0, high=2.0, grad="smooth", source=f"{_OURS}: 1 is the Jacobian",
        meaning="how far a splat covers more where its surface grows, and less where it shrinks",
    )] = 1.0
    sharpening: Annotated[float, Param(
        low=0.0, high=2.0, grad="smooth", source=f"{_OURS}: 1 undoes the splat's blur to 2nd order",
        meaning="how far the blur of a bilinear splat is taken back",
    )] = 1.0
    background: Annotated[Literal["guessed", "revealed", "none"], Param(
        grad="discrete", source=_OURS,
        meaning="what moving things uncover: what lies beside them, the revealed layer, nothing",
    )] = "guessed"
    background_reach: Annotated[int, Param(
        unit="px", low=1, high=512, scale="log", grad="discrete", source=_OURS,
        active_when="background == guessed",
        meaning="how far behind an edge the background is guessed, at most",
    )] = 64
    edge_radius: Annotated[int, Param(
        unit="px", low=0, high=4, grad="discrete", source=_TUNED,
        active_when="background == guessed",
        meaning="how far from an edge, whose pixels mix colors, the guess takes its color",
    )] = 2
    own_weight: Annotated[float, Param(
        unit="share of the shutter", low=1e-4, high=1.0, scale="log", grad="smooth", source=_OURS,
        meaning="weight of the pixel's sharp color in what fills the moments that nothing reaches",
    )] = 0.01
# fmt: on
