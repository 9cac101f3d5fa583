"""What a filter costs per pixel, counted from its configuration: lookups, arithmetic, passes.

The unit is one nearest lookup of a color. The count is that of a frame in which everything moves,
along paths that `num_samples` taps suffice for (longer ones have more with `tap_spacing`). It knows
nothing of caches: it ranks settings of a filter well, and compares filters roughly.
`Cost.relative` is the total over that of Guertin 2014 with 35 nearest taps, as published.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = [
    "TWO_SUMS",
    "WEIGHTS",
    "Cost",
    "color_lookup",
    "even",
    "gather",
    "post_filter",
    "tiles",
    "with_background",
]

WEIGHTS = 2.0
"""Arithmetic of a tap with weights from depth and motion, in lookups."""
TWO_SUMS = 4.0
"""The same where foreground and background have sums of their own."""

_LOOKUPS = {"nearest": 1.0, "bilinear": 2.0, "opportunistic": 2.0, "cubic": 10.0}
_PASS = 6.0  # a pass over the image: what it reads of the pixel itself, sets up and writes


@dataclass(frozen=True)
class Cost:
    """What a filter does per pixel of the full image.

    Args:
        taps: Places that are looked at.
        lookups: Lookups there, in nearest lookups of a color.
        arithmetic: What weights cost, in the same unit.
        passes: Passes over the image; those over the tiles count by their size.
    """

    taps: float = 0.0
    lookups: float = 0.0
    arithmetic: float = 0.0
    passes: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        """Return the cost of both."""
        return Cost(
            self.taps + other.taps,
            self.lookups + other.lookups,
            self.arithmetic + other.arithmetic,
            self.passes + other.passes,
        )

    def __mul__(self, share: float) -> Cost:
        """Return the cost on a share of the pixels, or of several times the same."""
        return Cost(
            self.taps * share, self.lookups * share, self.arithmetic * share, self.passes * share
        )

    @property
    def total(self) -> float:
        """All of it, in nearest lookups of a color."""
        return self.lookups + self.arithmetic + _PASS * self.passes

    @property
    def relative(self) -> float:
        """The total over that of Guertin 2014 as published, 35 taps."""
        return self.total / _PUBLISHED


def color_lookup(kind: str) -> float:
    """Return what one lookup of a color counts for; a cubic one is that of 16 pixels."""
    return _LOOKUPS[kind]


def gather(taps: float, lookup: str, arithmetic: float = WEIGHTS) -> Cost:
    """Return a gather whose taps look up color and motion with depth.

    Args:
        taps: Their number.
        lookup: How the color is looked up.
        arithmetic: What the weights of a tap cost.
    """
    return Cost(taps, taps * (color_lookup(lookup) + 1), taps * arithmetic, passes=1)


def tiles(tile_size: int, reductions: int = 1) -> Cost:
    """Return reductions to tiles, each followed by one over 3x3 tiles.

    Args:
        tile_size: Edge of a tile, px.
        reductions: Their number.
    """
    share = 1 / tile_size**2
    return Cost(lookups=1 + 9 * share, passes=1 + share) * reductions


def even(taps: int) -> int:
    """Return the number of taps that come in pairs."""
    return 2 * ((taps + 1) // 2)


def post_filter(samples: int, directions: int) -> Cost:
    """Return the second pass of the 2025 notes.

    Args:
        samples: Most samples per direction.
        directions: Their number.
    """
    taps = 2 * max(samples // 2, 1) * directions
    return Cost(taps, taps, taps * WEIGHTS, passes=1)


def with_background(whole: Cost, config: Any) -> Cost:
    """Return the cost with that of a revealed background, which is blurred the same way."""
    return whole * (2 if config.background == "revealed" else 1)


_PUBLISHED = (tiles(40) + gather(35, "nearest")).total  # Guertin 2014
