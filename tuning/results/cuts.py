"""What filters cut short, over the frames of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["Cuts", "cuts_over"]


class Cuts(NamedTuple):
    """On how many frames, and how much of them, a filter blurs less far than they move."""

    frames: int
    """Number of frames of which something is cut."""
    of: int
    """Number of all frames."""
    share: float
    """Largest share of the pixels of a frame."""
    longest: float
    """Longest half spread of a frame that is cut, px."""

    def text(self, frames: str) -> str:
        """Return it in words.

        Args:
            frames: What they are called: "hold-out frames".
        """
        percent = 100 * self.share
        share = (
            "less than 0.1 %"
            if percent < 0.1
            else f"up to {percent:.{0 if percent >= 10 else 1}f} %"
        )
        return (
            f"on {self.frames} of {self.of} {frames} it cuts short {share} of the pixels, whose "
            f"blur goes up to {self.longest:.0f} px to each side"
        )


def cuts_over(found: Sequence[tuple[float, float]]) -> Cuts | None:
    """Return what is cut of several frames, or None if nothing is.

    Args:
        found: Of each frame the share of the pixels that is cut, and its longest half spread, px.
    """
    cut = [(share, longest) for share, longest in found if share > 0]
    if not cut:
        return None
    return Cuts(len(cut), len(found), max(s for s, _ in cut), max(px for _, px in cut))
