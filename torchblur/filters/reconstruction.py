"""What the gathers share: parameters, the texture of a tap, and what is made of the sums."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from torchblur.filters.reach import TILE_MEANING, ReachConfig
from torchblur.filters.revealed import background_share
from torchblur.filters.spreads import Spread
from torchblur.frame import Frame
from torchblur.ops.cubic import read_cubic
from torchblur.ops.gather import Inputs, Lookup, Planes, read
from torchblur.ops.noise import NoiseKind
from torchblur.ops.pixels import takes_all_pixels
from torchblur.params import Param

__all__ = [
    "TEXTURE_COLOR",
    "WEIGHT_PARAMETERS",
    "ColorLookup",
    "GatherConfig",
    "ReconstructionConfig",
    "Tap",
    "color_from",
    "is_one",
    "resolve",
    "sample",
    "texture_of",
]

ColorLookup = Literal["nearest", "bilinear", "cubic", "opportunistic"]

TEXTURE_COLOR = 4
"""The channel of a texture at which its color begins."""

_WEIGHTS = "McGuire 2012, section 3.3 (restated by Tan 2022, appendix, eq. 5-10)"


class GatherConfig(ReachConfig):
    """Taps, tiles and lookups of a gather."""

    num_samples: Annotated[
        int,
        Param(
            symbol="N",
            unit="taps",
            low=1,
            high=512,
            scale="log",
            grad="discrete",
            source=_WEIGHTS,
            meaning="taps of the gather",
        ),
    ] = 15
    tile_size: Annotated[
        int,
        Param(
            symbol="r",
            unit="px",
            low=1,
            high=512,
            scale="log",
            grad="discrete",
            source="McGuire 2012, section 3",
            meaning=TILE_MEANING,
        ),
    ] = 20
    early_out: Annotated[
        float,
        Param(
            unit="px",
            low=0.0,
            high=4.0,
            grad="weak",
            source="McGuire 2012, section 3.3",
            meaning="a pixel is left as it is where the tile's half spread is not above this",
        ),
    ] = 0.505
    softness: Annotated[
        float,
        Param(
            low=0.0,
            high=0.5,
            grad="discrete",
            source="torchblur",
            meaning="rounds the corners of the clamped weights, so that gradients pass them",
        ),
    ] = 0.0
    color_lookup: Annotated[
        Lookup,
        Param(
            grad="discrete",
            source="McGuire 2012",
            meaning="lookup of the color; velocity and depth are always nearest",
        ),
    ] = "nearest"
    noise: Annotated[
        NoiseKind,
        Param(
            grad="discrete",
            source="Guertin 2014, section 4.5; Jimenez 2014",
            meaning="jitter per pixel: Halton points, interleaved gradient noise, or none",
        ),
    ] = "halton"
    seed: Annotated[
        int,
        Param(
            low=0,
            high=2**31 - 1,
            grad="discrete",
            source="torchblur",
            active_when="noise != none",
            meaning="shifts the noise; give each frame of a sequence its own",
        ),
    ] = 0


class ReconstructionConfig(GatherConfig):
    """Constants of the cone, cylinder and depth weights."""

    cone_slope: Annotated[
        float,
        Param(
            low=0.1,
            high=10.0,
            scale="log",
            grad="smooth",
            source=_WEIGHTS,
            meaning="slope of the cone weight over distance / length; 1 reaches 0 at the end",
        ),
    ] = 1.0
    cone_exponent: Annotated[
        float,
        Param(
            low=0.1,
            high=4.0,
            scale="log",
            grad="smooth",
            source="1 in McGuire 2012, section 3.3",
            meaning="exponent of the cone weight; below 1 it comes nearer to a box",
        ),
    ] = 1.0
    cylinder_inner: Annotated[
        float,
        Param(
            low=0.0,
            high=0.999,
            grad="smooth",
            source=_WEIGHTS,
            meaning="distance / length where the cylinder weight begins to fall",
        ),
    ] = 0.95
    cylinder_outer: Annotated[
        float,
        Param(
            low=1.0,
            high=4.0,
            grad="smooth",
            source=_WEIGHTS,
            meaning="distance / length where the cylinder weight reaches 0",
        ),
    ] = 1.05
    foreground_gain: Annotated[
        float,
        Param(
            low=0.0,
            high=8.0,
            grad="smooth",
            source=_WEIGHTS,
            meaning="gain of the first weight: what blurs over the pixel from the front",
        ),
    ] = 1.0
    background_gain: Annotated[
        float,
        Param(
            low=0.0,
            high=8.0,
            grad="smooth",
            source=_WEIGHTS,
            meaning="gain of the second weight: what the pixel's own blur lets through",
        ),
    ] = 1.0
    third_gain: Annotated[
        float,
        Param(
            low=0.0,
            high=32.0,
            grad="smooth",
            source=_WEIGHTS,
            meaning="gain of the third weight: both blur over each other",
        ),
    ] = 2.0
    depth_level: Annotated[
        float,
        Param(
            low=0.0,
            high=1.0,
            grad="smooth",
            source="1 in McGuire 2012, section 3.3; 1/2 in Jimenez 2014",
            meaning="both depth weights where sample and pixel are at one depth",
        ),
    ] = 1.0
    min_length: Annotated[
        float,
        Param(
            unit="px",
            low=0.05,
            high=4.0,
            scale="log",
            grad="smooth",
            source=_WEIGHTS,
            meaning="shortest half spread that the weights divide by",
        ),
    ] = 0.5


def color_from(frame: Frame, spread: Spread) -> int:
    """Return the first channel of a texture that may have a gradient: the color's, or 0.

    Args:
        frame: As in `texture_of`.
        spread: Likewise.
    """
    others = (*spread, frame.finite_depth())
    return 0 if any(plane.requires_grad for plane in others) else TEXTURE_COLOR


def texture_of(frame: Frame, spread: Spread) -> Tensor:
    """Return what a tap looks up, in one texture: û, |V|, depth, color, and validity if given.

    Returns:
        Planes, (B, 7 or 8, H, W).
    """
    planes = [spread.unit, spread.length, frame.finite_depth()]
    if frame.valid is None:
        return torch.cat((*planes, frame.color), 1)
    valid = frame.valid.to(frame.dtype)
    return torch.cat((*planes, frame.color * valid, valid), 1)


WEIGHT_PARAMETERS = (
    "cone_slope",
    "cone_exponent",
    "cylinder_inner",
    "cylinder_outer",
    "foreground_gain",
    "background_gain",
    "third_gain",
    "depth_level",
    "min_length",
)
"""Parameters that the taps take as they are."""


def is_one(value: Tensor) -> bool:
    """Whether an exponent is 1 and needs no gradient, so that its power can be left out."""
    if takes_all_pixels() or (value.requires_grad and torch.is_grad_enabled()):
        return False
    return bool((value == 1).all())


class Tap(NamedTuple):
    """What one tap sees; the color is multiplied by the validity, where there is one."""

    color: Planes
    unit_x: Tensor
    unit_y: Tensor
    length: Tensor
    depth: Tensor
    valid: Tensor | None


def sample(inputs: Inputs, x: Tensor, y: Tensor, color_lookup: ColorLookup) -> Tap:
    """Look up a tap.

    Args:
        inputs: "texture" from `texture_of`; "linear" (0 or 1) for an opportunistic lookup; the
            planes of `revealed_inputs`, if any, and "depth"; "texture_detail" for a cubic lookup.
        x: Column, px.
        y: Row, px.
        color_lookup: Lookup of the color (and of its validity): nearest, bilinear, cubic, or
            bilinear where "linear" is 1. All else is nearest.

    Returns:
        The tap; what shows the revealed layer has its color.
    """
    color: Sequence[Tensor]
    if color_lookup == "nearest":
        ux, uy, size, depth, *color = read(inputs, x, y)
    else:
        ux, uy, size, depth = read(inputs, x, y, channels=slice(0, TEXTURE_COLOR))
        channels = slice(TEXTURE_COLOR, None)
        if color_lookup == "cubic":
            color = read_cubic(inputs, x, y, channels)
        else:
            linear = inputs["linear"] > 0 if color_lookup == "opportunistic" else None
            color = read(inputs, x, y, "bilinear", channels, linear=linear)
    tap = Tap(tuple(color[:3]), ux, uy, size, depth, color[3] if color[3:] else None)
    if "revealed_r" not in inputs:
        return tap
    share = background_share(inputs, x, y, depth)
    behind = (inputs[f"revealed_{c}"] for c in "rgb")
    return tap._replace(
        color=tuple(c + share * (b - c) for c, b in zip(tap.color, behind, strict=True)),
        valid=None if tap.valid is None else tap.valid + share * (1 - tap.valid),
    )


def resolve(
    frame: Frame, sums: tuple[Tensor, ...], center_weight: Tensor, moving: Tensor
) -> tuple[Tensor, Tensor]:
    """Return color and total weight: the normalized sum, or the pixel itself where it is still.

    Args:
        frame: The frame, for its color.
        sums: Sums of ``weight · color`` and of ``weight`` over the taps.
        center_weight: The pixel's own weight, broadcasts to (B, 1, H, W).
        moving: Where the tile moves; elsewhere, and where the weights are zero, the color stays.

    Returns:
        Color (B, 3, H, W) and weight (B, 1, H, W).
    """
    if frame.valid is not None:
        center_weight = center_weight * frame.valid.to(frame.dtype)
    weight = sums[1] + center_weight
    used = moving & (weight > 0)
    blurred = (sums[0] + center_weight * frame.color) / torch.where(used, weight, 1.0)
    return torch.where(used, blurred, frame.color), weight.expand(-1, -1, *frame.size)
