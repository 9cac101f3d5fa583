"""How far a filter blurs: by its tiles, as papers have it, or as far as the frame moves."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.errors import ReachWarning
from torchblur.filters.base import BlurFilter, FilterConfig, Values
from torchblur.frame import Frame, Shutter
from torchblur.ops.gather import Inputs
from torchblur.ops.pixels import PixelList, takes_all_pixels
from torchblur.params import Param

__all__ = [
    "REACH_MEANING",
    "SPACING_MEANING",
    "TILE_MEANING",
    "Cut",
    "Gather",
    "ReachConfig",
    "ReachingBlur",
    "by_length",
    "code_range",
    "longest_spread",
    "swept_times",
    "tap_counts",
]

TILE_MEANING = "edge of a tile, and the longest half spread that is blurred (reach: tile)"
"""What `tile_size` means in filters that are named after papers."""

REACH_MEANING = (
    "the longest half spread that is blurred: a tile, or as long as the frame's motion up to "
    "max_reach, from whatever tile it comes"
)
"""What `reach` means in all filters."""

SPACING_MEANING = (
    "largest distance between neighboring taps of a path, of all its directions together: where "
    "num_samples would leave more there are more taps, up to max_samples; 0: num_samples everywhere"
)
"""What `tap_spacing` means in all filters."""

_OURS = ("torch", "torchblur")
_WORTH_NAMING = 0.01  # share of the pixels
_LONGER = 1.1  # how much longer than the reach a half spread must be to count as cut

Sums = tuple[Tensor, ...]
Gather = Callable[[int, Inputs, PixelList], Sums]


# fmt: off
class ReachConfig(FilterConfig):
    """The longest blur, and how densely long ones are sampled."""

    reach: Annotated[Literal["tile", "frame"], Param(
        grad="discrete", source="tile: McGuire 2012, section 3; frame: torchblur",
        meaning=REACH_MEANING,
    )] = "tile"
    max_reach: Annotated[float, Param(
        unit="px", low=1.0, high=4096.0, scale="log", grad="discrete", source="torchblur",
        active_when="reach == frame",
        meaning="reach: frame: longest half spread that is blurred; what is longer is cut. Vectors "
                "in 8 bits have steps of max_reach / 127",
    )] = 512.0
    tap_spacing: Annotated[float, Param(
        unit="px", low=0.0, high=64.0, grad="discrete", source="torchblur",
        meaning=SPACING_MEANING,
    )] = 0.0
    max_samples: Annotated[int, Param(
        unit="taps", low=1, high=1024, scale="log", grad="discrete", source="torchblur",
        active_when="tap_spacing > 0",
        meaning="tap_spacing: most taps of a path; longer ones than max_samples * tap_spacing have "
                "them farther apart",
    )] = 512
# fmt: on


class Cut(NamedTuple):
    """How much of a frame moves farther than a filter blurs."""

    share: float
    """Share of the pixels whose half spread is more than a tenth longer than the reach."""
    longest: float
    """Longest half spread in the frame, px."""
    reach: float
    """Longest half spread that is blurred, px."""


class ReachingBlur(BlurFilter):
    """A filter that blurs only so far; where that cuts motion short each Module says so, once."""

    _cut_told = False

    def cut(self, frame: Frame, **overrides: Any) -> Cut:
        """Return how much of a frame moves farther than the filter blurs.

        Args:
            frame: One frame or a batch; only its velocity counts.
            **overrides: Values of parameters, as in a call.
        """
        frame, values = super()._prepared(frame, overrides)
        return _cut(frame, values)

    def keep_quiet(self) -> None:
        """Warn of no cuts: for callers that call often, and tell what `cut` returns."""
        self._cut_told = True

    def _prepared(self, frame: Frame, overrides: dict[str, Any]) -> tuple[Frame, Values]:
        frame, values = super()._prepared(frame, overrides)
        if not self._cut_told and not takes_all_pixels():
            cut = _cut(frame, values)
            if cut.share >= _WORTH_NAMING:
                self._cut_told = True
                warnings.warn(self._advice(cut), ReachWarning, stacklevel=_level_of_caller())
        return frame, values

    def _advice(self, cut: Cut) -> str:
        config = self.config
        assert isinstance(config, ReachConfig)
        if config.reach == "frame":
            advice = f"raise `max_reach`, now {config.max_reach:g} px"
        else:
            tile = getattr(config, "tile_size", None)
            advice = f'give reach="frame", or a larger `tile_size`, now {tile} px'
        return (
            f"{self.name}: {cut.share:.0%} of the pixels move farther than the {cut.reach:g} px to "
            f"each side that it blurs, up to {cut.longest:.0f} px, and are cut there; {advice}"
        )


def _level_of_caller() -> int:
    """Return the stack level, for a warning, of the first caller outside of torch and torchblur."""
    frame, level = inspect.currentframe(), 0
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in _OURS:
        frame, level = frame.f_back, level + 1
    return level


@torch.no_grad()
def _cut(frame: Frame, values: Values) -> Cut:
    reach, half_open = longest_spread(values), values.shutter * 0.5
    # Squares of long vectors overflow, in 16 bits from 256 px on.
    size = torch.hypot(*frame.velocity.float().split(1, 1))
    if half_open.ndim == 4:
        size = size * half_open
    longest = float(size.amax()) * (1.0 if half_open.ndim == 4 else float(half_open))
    if longest <= _LONGER * reach:
        return Cut(0.0, longest, reach)
    least = _LONGER * reach * float(size.amax()) / longest
    return Cut(float((size > least).to(frame.dtype).mean()), longest, reach)


def longest_spread(values: Values) -> float:
    """Return the longest half spread that is blurred, px.

    With tiles as the limit that is a tile; taps of a shutter that is not centered reach twice as
    far from the pixel, so that there it is half of one.

    Args:
        values: `reach`, `max_reach`, `tile_size` and the shutter's position.
    """
    if values.reach == "frame":
        return float(values.max_reach)
    return float(values.tile_size / (1 + abs(Shutter(1, values.shutter_position).center)))


def code_range(values: Values) -> float:
    """Return the component of a vector, px, that the greatest code of eight bits stands for."""
    return float(values.max_reach if values.reach == "frame" else values.tile_size)


def swept_times(values: Values) -> tuple[float, float]:
    """Return when the shutter opens and closes, in half open intervals from the frame's time."""
    center = Shutter(1, values.shutter_position).center
    return center - 1.0, center + 1.0


# -- taps that follow the length -------------------------------------------------------------------


def by_length(
    gather: Gather,
    values: Values,
    reach: Tensor,
    lists: Inputs,
    pixels: PixelList,
    least: int,
    *,
    means: bool = False,
) -> Sums:
    """Return sums over as many taps as each pixel's path needs, in units of `least` taps.

    Pixels are sorted into classes of least · 2^(k/2) taps, so that a longer path costs more and a
    short one what it always did. Paths that would need more than `max_samples` have those.

    Args:
        gather: Returns the sums, (P, C, 1, m), of a number of taps, lists and their pixels.
        values: `tap_spacing`, `max_samples`, `num_samples`.
        reach: Half of the path of each pixel, px, (P, 1, 1, M).
        lists: The gather's inputs; lists of the pixels, textures, parameters.
        pixels: The pixels.
        least: Number of taps that the gather takes for `num_samples`: as many, or half in pairs.
        means: What it returns are means over the taps, not sums.

    Returns:
        The sums, (P, C, 1, M), scaled as if all pixels had `least` taps; or the means.
    """
    classes = _classes(values, reach, least)
    if len(classes) == 1:
        count = classes[0][0]
        return _scaled(gather(count, lists, pixels), 1 if means else least / count)
    whole: list[Tensor] = []
    for count, chosen in classes:
        assert chosen is not None
        some = pixels.some_of(lists, chosen)
        sums = _scaled(gather(count, some, pixels.some(chosen)), 1 if means else least / count)
        if not whole:
            whole = [s.new_zeros(*s.shape[:3], pixels.count) for s in sums]
        whole = [w.index_copy(3, chosen, s) for w, s in zip(whole, sums, strict=True)]
    return tuple(whole)


def _scaled(sums: Sums, factor: float) -> Sums:
    return sums if factor == 1 else tuple(plane * factor for plane in sums)


def tap_counts(values: Values, reach: Tensor, least: int) -> Tensor:
    """Return how many taps each pixel's path has, at least `least`, of the shape of `reach`.

    A graph that is recorded once has `num_samples` everywhere.

    Args:
        values: `tap_spacing`, `max_samples`, `num_samples`.
        reach: Half of the path of each pixel, px.
        least: What stands for `num_samples`: as many, or half of it in pairs.
    """
    if values.tap_spacing <= 0 or takes_all_pixels():
        return torch.full_like(reach, float(least))
    steps = [least]
    taps_of_one = max(1, round(values.num_samples / least))  # 2 of a pair
    most = max(least, values.max_samples // taps_of_one)
    while steps[-1] < most:
        steps.append(min(most, math.ceil(least * 2 ** (len(steps) / 2))))
    # A path of 2 reach with n taps has them 2 reach / n apart.
    wanted = 2 * reach.detach() / values.tap_spacing / values.num_samples
    number = (2 * wanted.clamp_min(1).log2() - 1e-4).ceil().clamp(0, len(steps) - 1)
    return reach.new_tensor(steps, requires_grad=False)[number.long()]


def _classes(values: Values, reach: Tensor, least: int) -> list[tuple[int, Tensor | None]]:
    """Return numbers of taps, and which pixels take so many; None: all."""
    if values.tap_spacing <= 0 or takes_all_pixels() or reach.numel() == 0:
        return [(least, None)]
    counts = tap_counts(values, reach, least).amax(0).flatten()
    found = counts.unique().int().tolist()
    if len(found) == 1:
        return [(found[0], None)]
    return [(count, (counts == count).nonzero()[:, 0]) for count in found]
