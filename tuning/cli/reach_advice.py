"""How far a frame's motion blurs at the usual shutter, and which settings reach as far."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from torchblur.filters import list_filters
from torchblur.filters.parts.reach import Cut, ReachingBlur
from torchblur.frame import Frame
from torchblur.presets import DEFAULT_FILTER

__all__ = ["SHUTTER", "reach_advice"]

SHUTTER = 0.5
"""The shutter, in frames, that the advice is for."""

_LEAST = 0.015  # share that percentiles tell from that of the fastest pixel alone


def reach_advice(speeds: Sequence[float]) -> str:
    """Return how long the longest blurs are, and which settings they need.

    Args:
        speeds: Speeds in px/frame: percentiles 0 to 100 of all pixels.
    """
    longest, most = (speeds[percent] * SHUTTER / 2 for percent in (100, 99))
    lengths = f"longest blur {longest:.0f} px to each side (99 % of the pixels: {most:.0f} px)"
    cuts = _cuts(speeds)
    if not cuts:
        return f"{lengths}; all filters follow it"
    default = cuts.pop(DEFAULT_FILTER, None)
    if default is not None:
        return (
            f"{lengths}; the default follows it up to {default.reach:g} px; all of it needs "
            f"reach=frame and a max_reach of {math.ceil(longest)}"
        )
    name = max(cuts, key=lambda name: cuts[name].reach)
    cut = cuts[name]
    share = f"{100 * cut.share:.0f} %" if cut.share > _LEAST else "less than 1 %"
    return (
        f"{lengths}; the default follows it; filters of papers need reach=frame or a tile_size "
        f"of {math.ceil(longest)} ({name} has {cut.reach:g}: {share} of the pixels would be cut)"
    )


def _cuts(speeds: Sequence[float]) -> dict[str, Cut]:
    """Return what filters with their default values would cut; those that cut nothing are left out.

    A frame of one row with these speeds stands for the whole one.
    """
    velocity = torch.zeros(1, 2, 1, len(speeds))
    velocity[0, 0, 0] = torch.tensor(speeds)
    row = Frame(color=torch.zeros(1, 3, 1, len(speeds)), velocity=velocity)
    found = {
        name: kind().cut(row, shutter=SHUTTER)
        for name, kind in list_filters().items()
        if issubclass(kind, ReachingBlur)
    }
    return {name: cut for name, cut in found.items() if cut.share > 0}
