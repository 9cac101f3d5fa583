"""What the gathers share: parameters, half spreads, the texture of a tap."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.filters.base import FilterConfig, Values
from torchblur.filters.revealed import background_share, revealed_inputs
from torchblur.frame import Frame, Shutter
from torchblur.ops.cubic import read_cubic
from torchblur.ops.gather import Inputs, Lookup, Planes, read
from torchblur.ops.noise import NoiseKind, noise_plane
from torchblur.ops.pixels import PixelList, select, takes_all_pixels
from torchblur.ops.tiles import neighbor_max, tile_lookup, tile_max, tile_offset
from torchblur.ops.velocity import clamp_length, direction, half_velocity, length, quantize_uint8
from torchblur.params import Param

__all__ = [
    "WEIGHT_PARAMETERS",
    "ColorLookup",
    "Filtered",
    "Moving",
    "ReconstructionConfig",
    "Spread",
    "Stray",
    "Tap",
    "Tiles",
    "is_one",
    "longest_spread",
    "moving_part",
    "moving_tiles",
    "packed_values",
    "pixel_spread",
    "resolve",
    "revealed_part",
    "sample",
    "spread_of",
    "texture_of",
    "tiles_of",
]

ColorLookup = Literal["nearest", "bilinear", "cubic", "opportunistic"]

_COLOR = 4  # where a texture's color begins
_ALMOST_ALL = 0.95  # from here on a choice costs more than it saves
_WEIGHTS = "McGuire 2012, section 3.3 (restated by Tan 2022, appendix, eq. 5-10)"


class ReconstructionConfig(FilterConfig):
    """Constants of the cone, cylinder and depth weights, and of the lookups."""

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
            meaning="edge of a tile, and the longest half spread that is blurred",
        ),
    ] = 20
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
            meaning="shifts the noise; give each frame of a sequence its own",
        ),
    ] = 0


class Spread(NamedTuple):
    """Half spread of each pixel, clamped to what the tiles can reach."""

    half: Tensor
    """V in px, (B, 2, H, W)."""
    length: Tensor
    """|V| in px, (B, 1, H, W)."""
    unit: Tensor
    """V / |V|, or 0 for a still pixel, (B, 2, H, W)."""


class Tiles(NamedTuple):
    """Longest half spreads per tile in px, (B, 2, Ty, Tx): of the tile, and of those around."""

    own: Tensor
    neighborhood: Tensor


def spread_of(
    frame: Frame, values: Values, *, uint8: bool = False, cull: bool = False
) -> tuple[Spread, Tiles]:
    """Return the half spreads of a frame, per pixel and per tile; see `tiles_of`.

    Args:
        frame: The frame.
        values: Shutter and tile size.
        uint8: Store per-pixel vectors in eight bits, and choose among those.
        cull: Leave out diagonal tiles that cannot reach the middle one.
    """
    return pixel_spread(frame, values, uint8=uint8), tiles_of(frame, values, uint8=uint8, cull=cull)


def pixel_spread(frame: Frame, values: Values, *, uint8: bool = False) -> Spread:
    """Return the half spread of each pixel.

    With a shutter that is not centered the taps reach twice as far from the pixel, so that the
    longest half spread is half a tile.

    Args:
        frame: The frame, or a list of its pixels.
        values: Shutter and tile size.
        uint8: Store vectors in eight bits.
    """
    half = half_velocity(frame.velocity, values.shutter, longest_spread(values))
    if uint8:
        half = quantize_uint8(half, values.tile_size)
    return Spread(half, length(half), direction(half))


def longest_spread(values: Values) -> float:
    """Return the longest half spread that the tiles can reach, px."""
    return float(values.tile_size / (1 + abs(Shutter(1, values.shutter_position).center)))


def tiles_of(frame: Frame, values: Values, *, uint8: bool = False, cull: bool = False) -> Tiles:
    """Return the longest half spread of each tile, and of the tiles around it.

    Tiles choose by the length before it is clamped: clamped vectors are all equally long, and
    rounding would choose among them.

    Args:
        frame: The frame.
        values: Shutter and tile size.
        uint8: Choose among vectors stored in eight bits.
        cull: Leave out diagonal tiles that cannot reach the middle one.
    """
    if uint8:
        tiles = tile_max(pixel_spread(frame, values, uint8=True).half, values.tile_size)
        return Tiles(tiles, neighbor_max(tiles, cull=cull))
    if values.shutter.ndim == 4 and values.shutter.shape[-2:] == frame.size:
        tiles = tile_max(half_velocity(frame.velocity, values.shutter), values.tile_size)
    else:  # one factor for all pixels of an image does not change which is the longest
        tiles = half_velocity(tile_max(frame.velocity, values.tile_size), values.shutter)
    longest = longest_spread(values)
    around = neighbor_max(tiles, cull=cull)
    return Tiles(clamp_length(tiles, longest), clamp_length(around, longest))


class Filtered(NamedTuple):
    """What a filter computes: planes of tiles, and lists of the pixels that may change."""

    tiles: dict[str, Tensor]
    pixels: PixelList
    lists: dict[str, Tensor]
    """"color" (P, 3, 1, M), and other planes by name, (P, 1, 1, M)."""

    @classmethod
    def still(cls, frame: Frame, tiles: dict[str, Tensor], *names: str) -> Filtered:
        """Return the result where nothing moves: the color, and 0 for all other planes."""
        nowhere = torch.empty(0, dtype=torch.int64, device=frame.color.device)
        none = frame.color.new_empty(1, 1, 1, 0)
        lists = {"color": none.expand(1, 3, 1, 0)} | dict.fromkeys(names, none)
        return cls(tiles, PixelList(*PixelList.all(frame.color).shape, nowhere), lists)

    def color(self, frame: Frame) -> Tensor:
        """Return the image, (B or P, 3, H, W); the frame's where nothing moves."""
        return self.pixels.unpack(self.lists["color"], over=frame.color)

    def layers(self, frame: Frame) -> dict[str, Tensor]:
        """Return everything as images, the planes beside the color 0 where nothing moves."""
        others = {n: self.pixels.unpack(p) for n, p in self.lists.items() if n != "color"}
        return {"color": self.color(frame)} | others | self.tiles


class Stray(NamedTuple):
    """How pixels near the edge of a tile look up the motion of the tile beside theirs."""

    noise: NoiseKind
    amplitude: Tensor
    """See `tile_offset`."""


class Moving(NamedTuple):
    """The part of a frame that a blur may change, as lists of pixels."""

    pixels: PixelList
    frame: Frame
    """Its layers color, velocity, depth and validity, (1, C, 1, M) each."""
    values: Values
    """The parameters; what is given per pixel is a list, (P, 1, 1, M)."""
    dominant: Tensor
    """Longest half spread around the pixel's tile, px, (P, 2, 1, M)."""
    tile_shift: Tensor | None
    """How far the lookup of the tile strays, in tiles, (P, 2, 1, M)."""
    spread: Spread
    texture: Tensor
    """What the taps look up, (B, 7 or 8, H, W); zero where none of them reaches."""
    color_from: int
    """First channel of the texture that may have a gradient: that of the color, or 0."""

    def grid(self) -> tuple[Tensor, Tensor]:
        """Return column and row of each pixel, (1, 1, 1, M) each."""
        return self.pixels.grid(self.frame.color)


def moving_part(
    frame: Frame,
    values: Values,
    neighborhood: Tensor,
    *,
    stray: Stray | None = None,
    uint8: bool = False,
    margin: int = 0,
) -> Moving | None:
    """Return the pixels whose tiles move, and what their taps can read.

    Args:
        frame: The frame.
        values: The parameters: `early_out`, shutter, tile size, seed.
        neighborhood: Longest half spread around each tile, px, (B, 2, Ty, Tx).
        stray: Whether a pixel's tile lookup may stray to a tile beside its own, and how.
        uint8: Store vectors in eight bits.
        margin: Pixels beyond the end of a blur that lookups read.

    Returns:
        The part; None if nothing moves and no gradient may be wanted.
    """
    tiles = moving_tiles(frame, values, neighborhood)
    wanted = tiles if stray is None else _dilated(tiles, 1)
    pixels = PixelList.in_tiles(wanted > 0, frame.color, values.tile_size)
    if pixels.count == 0:
        return None
    color, shift = frame.color, None
    if stray is not None:
        noise = noise_plane(stray.noise, color, 1, values.seed, pixels)
        amplitude = pixels.pack(stray.amplitude)
        shift = tile_offset(color, noise, values.tile_size, amplitude, pixels)
    dominant = tile_lookup(neighborhood, color, values.tile_size, shift, pixels=pixels)
    chosen = _moving_pixels(dominant, pixels.pack(values.early_out))
    if chosen is not None:
        pixels, dominant = pixels.some(chosen), select(dominant, chosen)
        shift = None if shift is None else select(shift, chosen)
    layers = frame.only("depth", "valid")
    here, local = layers.map(pixels.pack), packed_values(values, pixels)
    spread = pixel_spread(here, local, uint8=uint8)
    if pixels.index is None:
        texture = pixels.unpack(texture_of(here, spread))
    else:
        far = -(-(values.tile_size + margin) // values.tile_size)
        reached = PixelList.in_tiles(_dilated(wanted, far) > 0, color, values.tile_size)
        there = layers.map(reached.pack)
        read = pixel_spread(there, packed_values(values, reached), uint8=uint8)
        texture = reached.unpack(texture_of(there, read))
    motion = (frame.velocity, values.shutter, frame.finite_depth())
    color_from = 0 if any(plane.requires_grad for plane in motion) else _COLOR
    return Moving(pixels, here, local, dominant, shift, spread, texture, color_from)


def moving_tiles(frame: Frame, values: Values, neighborhood: Tensor) -> Tensor:
    """Return 1 for tiles that move, for any set of parameters, else 0, (B, 1, Ty, Tx)."""
    least = values.early_out
    if least.ndim == 4 and least.shape[0] > 1 and frame.batch_size == 1:
        least = least.amin(0, keepdim=True)
    if least.ndim == 4:
        least = least.amin((2, 3), keepdim=True)
    moving: Tensor = (length(neighborhood.detach()) > least).to(frame.dtype)
    if torch.is_grad_enabled() and not takes_all_pixels() and not bool(moving.any()):
        moving[..., 0, 0] = 1  # so that there is a graph
    return moving


def _moving_pixels(dominant: Tensor, least: Tensor) -> Tensor | None:
    """Return which pixels of a list move, for any set; None: so many that all may be taken."""
    if takes_all_pixels():
        return None
    moving = (length(dominant.detach()) > least).any(0).flatten()
    count = int(moving.sum())
    if count > _ALMOST_ALL * moving.shape[0] or (count == 0 and torch.is_grad_enabled()):
        return None
    return moving.nonzero()[:, 0]


def revealed_part(
    frame: Frame, values: Values, pixels: PixelList, blur: Callable[[Frame, Values], Tensor]
) -> Inputs:
    """Return `revealed_inputs` with lists of some pixels; arguments as there."""
    return pixels.lists(revealed_inputs(frame, values, blur))


def _dilated(mask: Tensor, tiles: int) -> Tensor:
    return F.max_pool2d(mask, 2 * tiles + 1, stride=1, padding=tiles)


def packed_values(values: Values, pixels: PixelList) -> Values:
    """Return the parameters with those that are given per pixel as lists of some pixels."""
    packed = {
        key: pixels.pack(value) if isinstance(value, Tensor) else value
        for key, value in vars(values).items()
    }
    return Values(**packed)


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
"""Parameters that the taps of both filters take as they are."""


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
    ux, uy, size, depth, *near = read(inputs, x, y)
    if color_lookup == "cubic":
        near = list(read_cubic(inputs, x, y, slice(_COLOR, None)))
    elif color_lookup != "nearest":
        fine = read(inputs, x, y, "bilinear", slice(_COLOR, None))
        if color_lookup == "opportunistic":
            linear = inputs["linear"] > 0
            fine = tuple(torch.where(linear, f, n) for f, n in zip(fine, near, strict=True))
        near = list(fine)
    tap = Tap(tuple(near[:3]), ux, uy, size, depth, near[3] if near[3:] else None)
    if "revealed" not in inputs:
        return tap
    share = background_share(inputs, x, y, depth)
    behind = inputs["revealed"].split(1, 1)
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
