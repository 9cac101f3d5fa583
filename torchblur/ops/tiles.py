"""Tiles: the longest velocity in a tile and around it, how much tiles disagree, their lookup.

Shapes: Ty and Tx are the numbers of tiles, ``ceil(H / r)`` and ``ceil(W / r)``; the image is
padded by replication at its right and lower edge.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.gather import lookup, pixel_grid
from torchblur.ops.pixels import PixelList
from torchblur.ops.velocity import direction, length

__all__ = [
    "neighbor_max",
    "neighbor_min",
    "tile_lookup",
    "tile_max",
    "tile_min",
    "tile_offset",
    "tile_variance",
]


def tile_max(velocity: Tensor, tile_size: int) -> Tensor:
    """Return the longest velocity in each tile of ``tile_size``² pixels.

    Args:
        velocity: Displacements in px, (B, 2, H, W).
        tile_size: r, the edge of a tile in px, at least 1.

    Returns:
        Displacements in px, (B, 2, Ty, Tx).

    Differentiable: in the selected vector; the selection has no gradient.
    Border: tiles at the right and lower edge see replicated pixels.
    Reference: McGuire 2012, section 3.2 (TileMax), in two passes as there. On a tie the first
        pixel of a row, then the first row, wins.
    """
    height, width = velocity.shape[-2:]
    padding = (0, -width % tile_size, 0, -height % tile_size)
    # Replication adds no vector that is not there already, but for windows inside the padding.
    padded = F.pad(velocity, padding, mode="replicate") if any(padding) else velocity
    rows = _longest_in_window(padded, (1, tile_size), (1, tile_size))
    return _longest_in_window(rows, (tile_size, 1), (tile_size, 1))


def _longest_in_window(
    velocity: Tensor, window: tuple[int, int], stride: tuple[int, int]
) -> Tensor:
    squared = velocity.detach().square().sum(1, keepdim=True)
    _, index = F.max_pool2d(squared, window, stride, return_indices=True)
    flat = velocity.flatten(2)
    picked = flat.gather(2, index.flatten(2).expand(-1, velocity.shape[1], -1))
    return picked.reshape(*velocity.shape[:2], *index.shape[-2:])


def neighbor_max(tile_velocity: Tensor, *, cull: bool = False) -> Tensor:
    """Return, for each tile, the longest velocity among it and its eight neighbors.

    Args:
        tile_velocity: Longest velocity per tile, px, (B, 2, Ty, Tx).
        cull: Leave out a diagonal neighbor whose motion cannot reach the middle tile: one that
            points more than 45° away from the line between the two. The sign does not matter,
            as the blur goes to both sides.

    Returns:
        Displacements in px, (B, 2, Ty, Tx).

    Differentiable: in the selected vector.
    Border: tiles outside the image do not take part.
    Reference: McGuire 2012, section 3.2 (NeighborMax); culling: Guertin 2014, section 4.4. We
        differ: the paper shows its test in a picture only; ours is ``|v̂ · ô| > cos 45°``.
    """
    neighbors = _neighborhood(tile_velocity)
    squared = neighbors.detach().square().sum(2)
    inside = _neighborhood(torch.ones_like(tile_velocity[:, :1]))[:, :, 0] > 0
    squared = torch.where(inside, squared, -1.0)
    if cull:
        squared = torch.where(_reaches_middle(neighbors), squared, -1.0)
    index = squared.argmax(1, keepdim=True)[:, :, None]
    return neighbors.gather(1, index.expand(-1, -1, 2, -1, -1))[:, 0]


def _neighborhood(tiles: Tensor) -> Tensor:
    """Return the 3x3 neighborhoods, zero outside: (B, 9, C, Ty, Tx), row by row."""
    batch, channels, height, width = tiles.shape
    windows = F.unfold(tiles, 3, padding=1)
    return windows.reshape(batch, channels, 9, height, width).transpose(1, 2)


def _reaches_middle(neighbors: Tensor) -> Tensor:
    # |v̂ · ô| > cos 45° for a diagonal offset o, squared and without the rounding.
    offsets = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    ox, oy = neighbors.new_tensor(offsets).T.reshape(2, 1, 9, 1, 1)
    on_axis = ox * oy == 0
    reaches: Tensor = on_axis | (ox * oy * neighbors[:, :, 0] * neighbors[:, :, 1] > 0)
    return reaches


def tile_min(size: Tensor, tile_size: int) -> Tensor:
    """Return the least value in each tile of ``tile_size``² pixels.

    Args:
        size: Lengths in px, (B, 1, H, W).
        tile_size: r, the edge of a tile in px, at least 1.

    Returns:
        Lengths in px, (B, 1, Ty, Tx).

    Border: tiles at the right and lower edge hold what there is of them.
    Reference: Jimenez 2014.
    """
    # ceil_mode: a window over the edge takes what lies inside.
    return -F.max_pool2d(-size, tile_size, ceil_mode=True)


def neighbor_min(tile_values: Tensor) -> Tensor:
    """Return, for each tile, the least value of it and its eight neighbors.

    Args:
        tile_values: Values per tile, (B, 1, Ty, Tx).

    Returns:
        Values, (B, 1, Ty, Tx).

    Border: tiles outside the image do not take part.
    """
    return -F.max_pool2d(-tile_values, 3, stride=1, padding=1)


def tile_variance(tile_velocity: Tensor, min_length: float | Tensor = 0.5) -> Tensor:
    """Return how much the directions of a tile and its neighbors differ.

    ``υ(t) = 1 − mean over u in N(t) of |v̂(t) · v̂(u)|``, N being the 3x3 tiles around t.

    Args:
        tile_velocity: Longest velocity per tile, px, (B, 2, Ty, Tx).
        min_length: Tiles below this length (px) are still: they do not count, and have 0.

    Returns:
        υ in [0, 1], (B, 1, Ty, Tx); 0 where all directions agree.

    Differentiable: in the velocities of moving tiles.
    Border: tiles outside the image do not take part.
    Reference: Guertin 2014, eq. 2. We differ: unit vectors (the paper's products of velocities
        would leave [0, 1]), and still tiles do not count.
    """
    moving = (length(tile_velocity) >= min_length).to(tile_velocity.dtype)
    unit = direction(tile_velocity) * moving
    agreement = (_neighborhood(unit) * unit[:, None]).sum(2).abs().sum(1, keepdim=True)
    count = _neighborhood(moving).sum((1, 2))[:, None]
    return moving * (1 - agreement / count.clamp(min=1))


def tile_offset(
    like: Tensor,
    noise: Tensor,
    tile_size: int,
    tau: float | Tensor,
    pixels: PixelList | None = None,
) -> Tensor:
    """Return the shift of each pixel's tile lookup: only near edges, never to a diagonal tile.

    Along one axis, which alternates like a checkerboard, the shift is ``τ · b · (ξ − ½)`` tiles
    with ``b = 2 |frac(x / r) − ½|``: at an edge every second pixel of τ = 1 sees the other tile,
    half way to the middle none does.

    Args:
        like: Any tensor of the image's size, (B, C, H, W).
        noise: ξ in [0, 1), broadcasts to (B, 1, H, W).
        tile_size: r in px.
        tau: τ; 0 turns it off.
        pixels: For these alone; noise and shift are lists of them, (P, C, 1, M).

    Returns:
        Shift in tiles, x and y, (B, 2, H, W).

    Reference: Guertin 2014, section 4.2. We differ: the paper has "a simple linear fall-off";
        this is the one that CryENGINE uses.
    """
    x, y = pixel_grid(like, pixels)
    along_x = ((x + y) / 2).frac() == 0
    shift = tau * (noise - 0.5)
    shift_x = torch.where(along_x, shift * _edge_distance(x, tile_size), 0.0)
    shift_y = torch.where(along_x, 0.0, shift * _edge_distance(y, tile_size))
    return torch.cat(torch.broadcast_tensors(shift_x, shift_y), 1)


def _edge_distance(position: Tensor, tile_size: int) -> Tensor:
    return 2 * (((position + 0.5) / tile_size).frac() - 0.5).abs()


def tile_lookup(
    tiles: Tensor,
    like: Tensor,
    tile_size: int,
    offset: Tensor | None = None,
    *,
    bilinear: bool = False,
    pixels: PixelList | None = None,
) -> Tensor:
    """Return for each pixel the value of its tile.

    Args:
        tiles: Planes per tile, (B, C, Ty, Tx).
        like: Any tensor of the image's size, (B, ?, H, W).
        tile_size: r in px.
        offset: Shift in tiles from `tile_offset`, (B, 2, H, W).
        bilinear: Interpolate between the middles of tiles instead of taking the nearest.
        pixels: For these alone; the shift and the result are lists of them, (P, C, 1, M).

    Returns:
        Planes per pixel, (B, C, H, W).

    Border: replicated.
    """
    x, y = ((axis + 0.5) / tile_size for axis in pixel_grid(like, pixels))
    if offset is not None:
        x, y = x + offset[:, :1], y + offset[:, 1:]
    x, y = (x - 0.5, y - 0.5) if bilinear else (x.floor(), y.floor())
    if pixels is not None and pixels.batch_size > 1:
        height = tiles.shape[2]
        y = y.clamp(0, height - 1) + pixels.image(like) * height
        tiles = pixels.texture(tiles)[None]
    return lookup(tiles, x, y, "bilinear" if bilinear else "nearest")
