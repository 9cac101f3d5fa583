"""Parameters of torchblur's own filter."""

from __future__ import annotations

from typing import Annotated, Literal

from torchblur.filters.front_back_config import FrontBackConfig
from torchblur.params import Param

__all__ = ["TorchblurConfig"]

_OURS = "torchblur"


# fmt: off
class TorchblurConfig(FrontBackConfig):
    """Parameters of torchblur's own filter."""

    num_samples: Annotated[int, Param(
        symbol="N", unit="taps", low=1, high=512, scale="log", grad="discrete", source=_OURS,
        meaning="times, at each of which all directions compete",
    )] = 16
    reversed_direction: Annotated[bool, Param(
        grad="discrete", source=_OURS,
        meaning="taps on the other side too: they find what moves against the dominant "
                "motion",
    )] = True
    refinements: Annotated[int, Param(
        low=0, high=4, grad="discrete", source=f"{_OURS}, after Bowles 2012",
        meaning="how often a tap follows the motion that it found instead of the tile's",
    )] = 2
    match_tolerance: Annotated[float, Param(
        unit="px", low=0.05, high=64.0, scale="log", grad="smooth", source=_OURS,
        meaning="by how much a sample may miss the pixel at the tap's time",
    )] = 1.0
    match_slope: Annotated[float, Param(
        low=0.0, high=1.0, grad="smooth", source=_OURS,
        meaning="the same, over the distance between sample and pixel",
    )] = 0.0
    arrivals: Annotated[Literal["winner", "blend"], Param(
        grad="discrete", source=_OURS,
        meaning="color of the sample with the largest weight, or of all that arrive, at "
                "one lookup each",
    )] = "winner"
    hidden_times: Annotated[Literal["fill", "drop"], Param(
        grad="discrete", source=_OURS,
        meaning="times at which nothing arrives and the pixel's own line lies behind something "
                "nearer: filled with what passes the pixel at other times, or left out",
    )] = "fill"
    color_lookup: Annotated[Literal["nearest", "bilinear", "cubic"], Param(
        grad="discrete", source=f"cubic: {_OURS}",
        meaning="lookup of the color; velocity and depth are always nearest",
    )] = "cubic"  # type: ignore[assignment]  # more than the base has
    background_gain: Annotated[float, Param(
        low=0.0, high=8.0, grad="smooth", source=_OURS,
        meaning="gain of the back, against what it must have to count as one (background_fade) "
                "and against center_taps",
    )] = 1.0
# fmt: on
