"""The part of a frame that moves, as lists of pixels: only there a filter has work to do."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.filters.base import Values
from torchblur.filters.places import tile_noise
from torchblur.filters.reach import longest_spread, swept_times
from torchblur.filters.reconstruction import color_from, texture_of
from torchblur.filters.revealed import revealed_inputs
from torchblur.filters.spreads import Spread, pixel_spread
from torchblur.frame import Frame
from torchblur.ops.directions import TileDirections
from torchblur.ops.gather import Inputs
from torchblur.ops.noise import NoiseKind, noise_plane
from torchblur.ops.pixels import PixelList, positions, select, takes_all_pixels
from torchblur.ops.reaching import least_along
from torchblur.ops.tiles import neighbor_min, tile_lookup, tile_min, tile_offset
from torchblur.ops.velocity import length

__all__ = [
    "Filtered",
    "Moving",
    "Stray",
    "Window",
    "least_spread",
    "moving_among",
    "moving_part",
    "moving_pixels",
    "moving_tiles",
    "packed_values",
    "revealed_part",
    "tile_planes",
]


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


class Window(NamedTuple):
    """A rectangle of whole tiles, px; the last of them may end beyond the image."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def around(cls, chosen: Tensor, tile_size: int) -> Window:
        """Return the smallest one that has all chosen tiles of whatever image.

        Args:
            chosen: Tiles, bool, (B, 1, Ty, Tx), at least one of them.
            tile_size: Edge of a tile, px.
        """
        ends = [chosen.any(0)[0].any(axis).nonzero() for axis in (1, 0)]
        rows, columns = ((int(end[0]) * tile_size, int(end[-1] + 1) * tile_size) for end in ends)
        return cls(*rows, *columns)

    def of(self, plane: Tensor, tile_size: int = 1) -> Tensor:
        """Return this part of planes (B, C, H, W), or of tiles."""
        rows = slice(self.top // tile_size, self.bottom // tile_size)
        return plane[..., rows, self.left // tile_size : self.right // tile_size]


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
    """What the taps look up, (B, 7 or 8, h, w): the window; zero where none of them reaches."""
    window: Window | None
    """The part of the images that taps reach; None: all of it."""
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
    chosen = moving_among(dominant, pixels.pack(values.early_out))
    if chosen is not None:
        pixels, dominant = pixels.some(chosen), select(dominant, chosen)
        shift = None if shift is None else select(shift, chosen)
    layers = frame.only("depth", "valid")
    here, local = layers.map(pixels.pack), packed_values(values, pixels)
    spread = pixel_spread(here, local, uint8=uint8)
    window = None
    if pixels.index is None:
        texture = pixels.unpack(texture_of(here, spread))
    else:
        far = math.ceil((_farthest(neighborhood, values) + margin) / values.tile_size)
        reached = _dilated(wanted, far) > 0
        window = Window.around(reached, values.tile_size)
        there = layers.map(window.of)
        tiles = window.of(reached, values.tile_size)
        listed = PixelList.in_tiles(tiles, there.color, values.tile_size)
        there, read = there.map(listed.pack), packed_values(values, listed, window)
        texture = listed.unpack(texture_of(there, pixel_spread(there, read, uint8=uint8)))
        pixels = replace(pixels, origin=(window.top, window.left))
    least = color_from(frame, spread)
    return Moving(pixels, here, local, dominant, shift, spread, texture, window, least)


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


def moving_among(dominant: Tensor, least: Tensor) -> Tensor | None:
    """Return which pixels of a list move, for any set; None: so many that all may be taken."""
    chosen = positions(length(dominant.detach()) > least)
    if chosen is not None and chosen.shape[0] == 0 and torch.is_grad_enabled():
        return None  # so that there is a graph
    return chosen


def moving_pixels(frame: Frame, tiles: TileDirections, values: Values) -> PixelList:
    """Return the pixels whose tiles move, or may look up one that does."""
    if takes_all_pixels():
        return PixelList.all(frame.color)
    wanted = moving_tiles(frame, values, tiles.primary)
    if values.noise != "none" and bool((values.tile_jitter > 0).any()):
        wanted = _dilated(wanted, 1)
    return PixelList.in_tiles(wanted > 0, frame.color, values.tile_size)


def tile_planes(
    color: Tensor, tiles: Sequence[Tensor], pixels: PixelList, values: Values
) -> list[Tensor]:
    """Return planes of tiles for pixels, all from the same tile, which noise may choose.

    Args:
        color: For its size, (B, 3, H, W).
        tiles: The planes, (B, ·, Ty, Tx).
        pixels: Whose.
        values: The parameters.
    """
    edge = values.tile_size
    noise = noise_plane(tile_noise(values), color, 1, values.seed, pixels)
    offset = tile_offset(color, noise, edge, pixels.pack(values.tile_jitter), pixels)
    return [tile_lookup(t, color, edge, offset, pixels=pixels) for t in tiles]


def least_spread(size: Tensor, along: Sequence[Tensor], values: Values) -> Tensor:
    """Return the shortest half spread that the taps of each tile may meet, px, (B, 1, Ty, Tx).

    Args:
        size: Half spread of all pixels, px, (B, 1, H, W).
        along: Half spreads of the tiles along which taps lie, px, (B, 2, Ty, Tx) each.
        values: `reach`, `tile_size`, the shutter's position.
    """
    edge = values.tile_size
    least = tile_min(size.detach(), edge)
    if values.reach == "tile":
        return neighbor_min(least)
    longest, times = longest_spread(values), swept_times(values)
    found = (least_along(least, tiles, edge, longest, times) for tiles in along)
    return functools.reduce(torch.minimum, found)


def _farthest(neighborhood: Tensor, values: Values) -> float:
    """Return how far from its pixel a tap can lie, px."""
    if values.reach == "tile":
        return float(values.tile_size)
    return float(length(neighborhood.detach()).amax()) * max(map(abs, swept_times(values)))


def revealed_part(
    frame: Frame, values: Values, part: Moving, blur: Callable[[Frame, Values], Tensor]
) -> Inputs:
    """Return `revealed_inputs` with lists of the part's pixels; other arguments as there."""
    inputs = revealed_inputs(frame, values, blur)
    if part.window is not None:
        textures = {k: part.window.of(v) for k, v in inputs.items() if k.startswith("texture")}
        inputs = inputs | textures
    return part.pixels.lists(inputs)


def _dilated(mask: Tensor, tiles: int) -> Tensor:
    return F.max_pool2d(mask, 2 * tiles + 1, stride=1, padding=tiles)


def packed_values(values: Values, pixels: PixelList, window: Window | None = None) -> Values:
    """Return the parameters with those that are given per pixel as lists of some pixels.

    Args:
        values: The parameters.
        pixels: The pixels, of the images or of a window of them.
        window: The window.
    """
    packed = {}
    for key, value in vars(values).items():
        here = value
        if isinstance(value, Tensor):
            per_pixel = value.ndim == 4 and value.shape[-2:] != (1, 1)
            here = pixels.pack(window.of(value) if window is not None and per_pixel else value)
        packed[key] = here
    return Values(**packed)
