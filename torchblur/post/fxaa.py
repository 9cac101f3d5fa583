"""FXAA 3.11, quality path: anti-aliasing after the fact, steered by a plane of luma."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from pydantic import field_validator
from torch import Tensor

from torchblur.ops.color import REC_601, luma
from torchblur.ops.gather import lookup, pixel_grid
from torchblur.ops.weights import saturate
from torchblur.params import Config, Param
from torchblur.post.base import Effect, Values, check_plane

__all__ = ["SEARCH_STEPS", "Fxaa", "FxaaConfig", "fxaa", "perceptual_luma"]

_SOURCE = "Lottes, FXAA 3.11"
_TINY = 1e-8
_TIE = 1e-5  # the two sums are often equal by algebra: rounding must not decide

SEARCH_STEPS: dict[int, tuple[float, ...]] = {
    10: (1.5, 3, 12),
    11: (1, 1.5, 3, 12),
    12: (1, 1.5, 2, 4, 12),
    13: (1, 1.5, 2, 2, 4, 12),
    14: (1, 1.5, 2, 2, 2, 4, 12),
    15: (1, 1.5, 2, 2, 2, 2, 4, 12),
    20: (1.5, 2, 8),
    21: (1, 1.5, 2, 8),
    22: (1, 1.5, 2, 2, 8),
    23: (1, 1.5, 2, 2, 2, 8),
    24: (1, 1.5, 2, 2, 2, 3, 8),
    25: (1, 1.5, 2, 2, 2, 2, 4, 8),
    26: (1, 1.5, 2, 2, 2, 2, 2, 4, 8),
    27: (1, 1.5, 2, 2, 2, 2, 2, 2, 4, 8),
    28: (1, 1.5, 2, 2, 2, 2, 2, 2, 2, 4, 8),
    29: (1, 1.5, 2, 2, 2, 2, 2, 2, 2, 2, 4, 8),
    39: (1, 1, 1, 1, 1, 1.5, 2, 2, 2, 2, 4, 8),
}
"""Steps of the search along an edge, px, by the number of the quality preset."""


# fmt: off
class FxaaConfig(Config):
    """Parameters of FXAA; the defaults are those of version 3.11."""

    threshold: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="weak", source=_SOURCE,
              meaning="least contrast that is an edge, as a share of the brightest luma nearby"),
    ] = 0.166
    threshold_min: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="weak", source=_SOURCE,
              meaning="least contrast that is an edge, in the dark"),
    ] = 0.0833
    subpix: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="smooth", source=_SOURCE,
              meaning="largest shift for details below a pixel: 0 leaves them, 1 is softest"),
    ] = 0.75
    span_end: Annotated[
        float,
        Param(low=0.01, high=1.0, grad="weak", source=_SOURCE,
              meaning="an edge ends where luma is off its mean by this share of its contrast"),
    ] = 0.25
    quality: Annotated[
        Literal[10, 11, 12, 13, 14, 15, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 39],
        Param(grad="discrete", source=_SOURCE,
              meaning="preset of the search steps: tens digit the style, units the length"),
    ] = 12
    search_steps: Annotated[
        tuple[float, ...] | None,
        Param(unit="px", grad="discrete", source=_SOURCE,
              meaning="steps of the search along an edge, in place of the preset's"),
    ] = None
    softness: Annotated[
        float,
        Param(low=0.0, high=1.0, grad="weak", source="torchblur",
              meaning="contrast over which the effect fades in above the threshold; 0: at once"),
    ] = 0.0

    @field_validator("search_steps")
    @classmethod
    def _check_steps(cls, steps: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if steps is not None and not (1 <= len(steps) <= 64 and all(0 < s <= 64 for s in steps)):
            raise ValueError("must hold 1 to 64 steps, each in (0, 64] px")
        return steps
# fmt: on


class _Neighborhood(NamedTuple):
    """Luma of a pixel and its eight neighbors, (B, 1, H, W) each; north is up."""

    northwest: Tensor
    north: Tensor
    northeast: Tensor
    west: Tensor
    middle: Tensor
    east: Tensor
    southwest: Tensor
    south: Tensor
    southeast: Tensor


class _Edge(NamedTuple):
    """The edge at each pixel: which way it runs, and across which side of the pixel."""

    horizontal: Tensor  # bool
    first: Tensor  # bool: the contrast is greater to the north (or west)
    contrast: Tensor
    mean: Tensor  # of the two lumas that the edge parts


def perceptual_luma(color: Tensor) -> Tensor:
    """Return the luma that FXAA expects: the square root of Rec. 601 luma in [0, 1].

    Args:
        color: Scene-linear, (B, 3, H, W); what is above 1 counts as white.

    Returns:
        (B, 1, H, W) in [0, 1].

    Differentiable: yes, but for color outside [0, 1].
    Reference: Lottes, FXAA 3.11 (its square-root variant for linear color).
    """
    return luma(color.clamp(0, 1), REC_601).clamp_min(_TINY).sqrt()


def fxaa(
    color: Tensor, luma: Tensor | None = None, config: FxaaConfig | None = None, **params: Any
) -> Tensor:
    """Smooth edges and isolated pixels: move each pixel's lookup across the edge beside it.

    Everything is decided on luma: whether there is an edge (its range over the cross of
    neighbors), whether it runs along a row or a column, where it ends to both sides, and how
    far the pixel is an isolated one. Color is read once, at the shifted position:
    ``out = (1 − s) · C(p) + s · C(p + n)``, with n the neighbor across the edge.

    Args:
        color: Linear or encoded, (B, 3, H, W).
        luma: What steers it, in [0, 1], perceptual, (B, 1, H, W): a blur's "luma" layer (true,
            or with the checkerboard of Guertin 2014); `perceptual_luma` of the color if left out.
        config: Parameters; those of version 3.11 if left out.
        **params: Single parameters over those of `config`.

    Returns:
        Color, (B, 3, H, W). Pixels without an edge are bit for bit those of `color`.

    Differentiable: in the color; in the luma and in `subpix` where the term for isolated pixels
        leads; with `softness` above 0 also in luma and both thresholds through the gate. The
        search along the edge has no gradient.
    Border: replicated.
    Reference: Lottes, FXAA 3.11, quality path, from its description. We differ: the test for an
        edge can be soft; an edge runs along the row also where the sums for row and column are
        equal but for rounding, as they always are for a pixel amid a checker-like pattern.
    Raises: ConfigError for a bad parameter, FrameError for a bad shape.
    """
    result: Tensor = Fxaa(config, **params)(color, luma)
    return result


class Fxaa(Effect):
    """FXAA 3.11 as a Module. See `fxaa`.

    `layers` returns "color" and "shift", how far the lookup moved, px, (B, 1, H, W).
    """

    name = "fxaa"
    config_class = FxaaConfig

    def layers(
        self, color: Tensor, luma: Tensor | None = None, **overrides: Any
    ) -> dict[str, Tensor]:
        """Return "color" and "shift"; arguments as for `fxaa`."""
        check_plane("color", color, 3)
        if luma is not None:
            check_plane("luma", luma, 1, color)
        else:
            luma = perceptual_luma(color)
        values, (color, luma) = self.prepare(overrides, color=color, luma=luma)
        return _layers(color, luma, values)

    def forward(self, color: Tensor, luma: Tensor | None = None, **overrides: Any) -> Tensor:
        """Return the smoothed color, (B, 3, H, W); arguments as for `fxaa`."""
        return self.layers(color, luma, **overrides)["color"]


def _layers(color: Tensor, luma: Tensor, values: Values) -> dict[str, Tensor]:
    around = _Neighborhood(*_shifted(luma))
    cross = torch.stack((around.middle, around.north, around.south, around.east, around.west))
    brightest = cross.amax(0)
    contrast = brightest - cross.amin(0)
    least = torch.maximum(values.threshold * brightest, values.threshold_min)
    edge = _edge(around)
    shift = torch.maximum(_span_shift(luma, edge, values), _pixel_shift(around, contrast, values))
    shift = torch.where(contrast < least, 0.0, shift * _gate(contrast - least, values.softness))
    return {"color": torch.lerp(color, _across(color, edge), shift), "shift": shift}


def _gate(above: Tensor, softness: Tensor) -> Tensor:
    """Return how open the effect is, by the contrast above the threshold."""
    soft = above / softness.clamp_min(_TINY)
    return torch.where(softness > 0, saturate(soft), torch.ones_like(soft))


def _shifted(plane: Tensor) -> list[Tensor]:
    """Return the 3x3 neighbors of each pixel, row by row, border replicated."""
    height, width = plane.shape[-2:]
    padded = F.pad(plane, (1, 1, 1, 1), mode="replicate")
    return [padded[..., y : y + height, x : x + width] for y in range(3) for x in range(3)]


def _edge(a: _Neighborhood) -> _Edge:
    """Return the direction of the edge, by second differences over the 3x3 neighbors."""
    along_row = (
        (a.northwest + a.southwest - 2 * a.west).abs()
        + 2 * (a.north + a.south - 2 * a.middle).abs()
        + (a.northeast + a.southeast - 2 * a.east).abs()
    )
    along_column = (
        (a.northwest + a.northeast - 2 * a.north).abs()
        + 2 * (a.west + a.east - 2 * a.middle).abs()
        + (a.southwest + a.southeast - 2 * a.south).abs()
    )
    horizontal = along_row + _TIE >= along_column
    before = torch.where(horizontal, a.north, a.west)
    after = torch.where(horizontal, a.south, a.east)
    first = (before - a.middle).abs() >= (after - a.middle).abs()
    other = torch.where(first, before, after)
    return _Edge(horizontal, first, (other - a.middle).abs(), (other + a.middle) / 2)


def _pixel_shift(a: _Neighborhood, contrast: Tensor, values: Values) -> Tensor:
    """Return the shift of a pixel that stands out from its neighbors, px."""
    sides = a.north + a.south + a.east + a.west
    corners = a.northwest + a.northeast + a.southwest + a.southeast
    lowpass = (2 * sides + corners) / 12
    share = saturate((lowpass - a.middle).abs() / contrast.clamp_min(_TINY))
    shift: Tensor = values.subpix * (share * share * (3 - 2 * share)) ** 2
    return shift


@torch.no_grad()
def _span_shift(luma: Tensor, edge: _Edge, values: Values) -> Tensor:
    """Return the shift of a pixel by its place along the edge, px: one half at a step's end."""
    ahead, ahead_luma = _search(luma, edge, values, 1.0)
    back, back_luma = _search(luma, edge, values, -1.0)
    nearest_end = torch.where(back < ahead, back_luma, ahead_luma)
    crosses = (nearest_end < 0) != (luma < edge.mean)
    shift = 0.5 - torch.minimum(back, ahead) / (back + ahead)
    return torch.where(crosses, shift, 0.0)


def _search(luma: Tensor, edge: _Edge, values: Values, sign: float) -> tuple[Tensor, Tensor]:
    """Walk along the edge until it ends; return the distance, px, and the luma off its mean."""
    steps = values.search_steps or SEARCH_STEPS[values.quality]
    x, y = pixel_grid(luma)
    half = torch.where(edge.first, -0.5, 0.5).to(luma.dtype)
    x = x + torch.where(edge.horizontal, 0.0, half)
    y = y + torch.where(edge.horizontal, half, 0.0)
    distance = torch.full_like(luma, steps[0])
    off = _luma_at(luma, x, y, edge, sign * distance)
    for number, step in enumerate(steps[1:], 2):
        ended = off.abs() >= values.span_end * edge.contrast
        distance = torch.where(ended, distance, distance + step)
        if number < len(steps):  # the last step is a guess: nothing is read there
            off = torch.where(ended, off, _luma_at(luma, x, y, edge, sign * distance))
    return distance, off


def _luma_at(luma: Tensor, x: Tensor, y: Tensor, edge: _Edge, along: Tensor) -> Tensor:
    x = x + torch.where(edge.horizontal, along, 0.0)
    y = y + torch.where(edge.horizontal, 0.0, along)
    return lookup(luma, x, y, "bilinear") - edge.mean


def _across(color: Tensor, edge: _Edge) -> Tensor:
    """Return the color of the neighbor across the edge."""
    _, north, _, west, _, east, _, south, _ = _shifted(color)
    vertical = torch.where(edge.first, west, east)
    return torch.where(edge.horizontal, torch.where(edge.first, north, south), vertical)
