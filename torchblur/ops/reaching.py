"""Which tiles' motion reaches which tiles, however far: neighborhoods of blurs longer than a tile.

A vector V of a tile sweeps the places ``τ V``, τ over the open shutter in half open intervals:
[-1, 1] if it is centered, [0, 2] leading, [-2, 0] trailing. It reaches each tile that the swept
tile overlaps. So tiles can be small, which keeps motions apart, and blurs long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from torchblur.ops.directions import TileDirections, best_in_tiles
from torchblur.ops.pixels import takes_all_pixels
from torchblur.ops.tiles import tile_max
from torchblur.ops.velocity import clamp_length, direction, length

__all__ = ["least_along", "longest_reaching", "reaching_directions"]

Interval = tuple[float, float]
_Pairs = Iterator[tuple[Tensor, Tensor]]

_ACROSS = 4  # an open range of tiles less than 4 long has no more of them
_PAIRS = 1 << 21  # of tiles that are looked at together


def longest_reaching(
    tiles: Tensor, tile_size: int, longest: float, interval: Interval = (-1.0, 1.0)
) -> Tensor:
    """Return, for each tile, the longest vector among the tiles whose motion reaches it.

    The tile itself and the eight around it always take part.

    Args:
        tiles: Longest half spread per tile, px, (B, 2, Ty, Tx).
        tile_size: r, the edge of a tile in px.
        longest: Half spread that blurs reach at most, px; longer ones are chosen by their length
            and reach as far as this.
        interval: Times over which a vector sweeps, in half open intervals of the shutter.

    Returns:
        Half spreads in px, (B, 2, Ty, Tx).

    Differentiable: in the selected vector; the selection has no gradient.
    Border: tiles outside the image do not take part.
    Reference: torchblur; after NeighborMax (McGuire 2012, section 3.2) and its culling (Guertin
        2014, section 4.4), which look no farther than one tile.
    """
    size = length(tiles.detach()).flatten()
    swept = clamp_length(tiles.detach(), longest)
    best = _best(lambda: _pairs(swept, tile_size, longest, interval), lambda s, _: size[s], size)
    return _picked(tiles, best)


def reaching_directions(
    velocity: Tensor,
    tile_size: int,
    longest: float,
    interval: Interval = (-1.0, 1.0),
    *,
    two: bool = True,
    exponent: float | Tensor = 2.0,
) -> TileDirections:
    """Return the longest vector that reaches each tile, and the one that complements it best.

    The candidates are two vectors of each tile: the longest, and the one of its pixels with the
    highest `secondary_score` against it.

    Args:
        velocity: Half spreads of the pixels, px, (B, 2, H, W).
        tile_size: As in `longest_reaching`.
        longest: Likewise.
        interval: Likewise.
        two: Whether the second is wanted; else it is 0.
        exponent: See `secondary_score`; a number or (B, 1, 1, 1).

    Differentiable: in the selected vectors; the selection has no gradient.
    Border: tiles outside the image do not take part.
    Reference: torchblur; the second direction is that of the 2025 notes.
    """
    tiles = tile_max(velocity, tile_size)
    primary = longest_reaching(tiles, tile_size, longest, interval)
    if not two:
        return TileDirections(primary, torch.zeros_like(primary))
    # One below the other along the batch: each is a source of its own.
    both = torch.cat((tiles, best_in_tiles(velocity, tiles, tile_size, exponent)))
    vectors = both.detach()
    unit, size = _flat(direction(vectors)), length(vectors).flatten()
    taken = _flat(direction(primary.detach()))
    powers = torch.as_tensor(exponent, dtype=size.dtype, device=size.device)
    per_tile = powers.expand(tiles.shape[0], 1, *tiles.shape[-2:]).flatten()
    count = per_tile.shape[0]

    def score(source: Tensor, target: Tensor) -> Tensor:
        place = target.clamp(max=count - 1)
        cosine = (unit[:, source] * taken[:, place]).sum(0).abs()
        return size[source] * (1 - cosine).clamp_min(0) ** per_tile[place]

    swept = clamp_length(vectors, longest)
    best = _best(lambda: _of_both(swept, tile_size, longest, interval), score, per_tile)
    return TileDirections(primary, _picked(both, best, like=tiles))


def least_along(
    tile_values: Tensor,
    tiles: Tensor,
    tile_size: int,
    longest: float,
    interval: Interval = (-1.0, 1.0),
) -> Tensor:
    """Return, for each tile, the least value of those around it and of those that its taps meet.

    Args:
        tile_values: Values per tile, (B, 1, Ty, Tx).
        tiles: The half spread along which the taps of a tile lie, px, (B, 2, Ty, Tx).
        tile_size: r, the edge of a tile in px.
        longest: No tile's half spread is longer, px.
        interval: Times at which taps lie, in half open intervals of the shutter.

    Returns:
        Values, (B, 1, Ty, Tx), without a gradient.

    Border: tiles outside the image do not take part.
    """
    values = tile_values.detach().flatten()
    beyond = torch.cat((values, values.new_full((1,), math.inf)))
    least = values.clone()
    vectors = -tiles.detach()  # taps lie where what arrives comes from
    for source, target in _pairs(vectors, tile_size, longest, interval):
        least = least.scatter_reduce(0, source, beyond[target], "amin")
    return least.reshape(tile_values.shape)


# -- pairs of tiles --------------------------------------------------------------------------------


def _of_both(vectors: Tensor, tile_size: int, longest: float, interval: Interval) -> _Pairs:
    """Return the pairs of tiles that stand twice along the batch; targets are those of one."""
    count = vectors[:, 0].numel() // 2
    for source, target in _pairs(vectors, tile_size, longest, interval):
        inside = target < 2 * count
        yield source, torch.where(inside, target % count, count)


def _pairs(vectors: Tensor, tile_size: int, longest: float, interval: Interval) -> _Pairs:
    """Return numbers of tiles and of those that their motion reaches, some at a time.

    Args:
        vectors: Half spread of each tile, px, (B, 2, Ty, Tx).
        tile_size: Edge of a tile, px.
        longest: The longest of them if a graph is recorded, px.
        interval: Times over which they sweep.

    Returns:
        Source and target, int64, of one shape: positions in the flattened (B, Ty, Tx). A target
        outside the image is B * Ty * Tx.
    """
    grid = _Grid(vectors)
    every = torch.arange(grid.count, device=vectors.device)
    ring = torch.arange(-1, 2, device=vectors.device)
    yield grid.reached(every, ring.repeat(3)[None], ring.repeat_interleave(3)[None])
    x, y = _flat(vectors) / tile_size
    far = torch.maximum(x.abs(), y.abs())
    order, start = every, 0
    if not takes_all_pixels():
        order = far.argsort()[int((far <= 0).sum()) :]
    while start < order.shape[0]:  # the longest last: each part is as wide as its longest vector
        part = order[start : start + _PAIRS // 32]
        steps = longest / tile_size if takes_all_pixels() else float(far[part[-1]])
        part = part[: max(1, int(_PAIRS / (_ACROSS * (2 * steps + 3))))]
        if not takes_all_pixels():
            steps = float(far[part[-1]])
        yield grid.swept(part, x, y, steps, interval)
        start += part.shape[0]


class _Grid:
    """The tiles of a batch of images, by number."""

    def __init__(self, vectors: Tensor) -> None:
        batch, _, self.height, self.width = vectors.shape
        self.count = batch * self.height * self.width

    def swept(
        self, source: Tensor, x: Tensor, y: Tensor, longest: float, interval: Interval
    ) -> tuple[Tensor, Tensor]:
        """Return the pairs of some tiles with what their vectors sweep.

        Args:
            source: Numbers of the tiles, (n,).
            x: Vectors of all tiles, columns, tiles.
            y: The same, rows.
            longest: The longest component of those tiles' vectors, tiles.
            interval: Times over which they sweep.
        """
        begin, end = interval
        x, y = x[source, None], y[source, None]
        level = x.abs() >= y.abs()
        major, minor = torch.where(level, x, y), torch.where(level, y, x)
        # A tile at a distance d along the longer component is met while |d - τ V| < 1.
        low, high = (
            torch.minimum(begin * major, end * major),
            torch.maximum(begin * major, end * major),
        )
        steps = math.floor(longest * (end - begin)) + 3
        along = (low - 1).floor() + 1 + torch.arange(steps, device=x.device)
        safe = torch.where(major == 0, 1.0, major)
        one, other = (along - 1) / safe, (along + 1) / safe
        since = torch.minimum(one, other).clamp(begin, end)
        until = torch.maximum(one, other).clamp(begin, end)
        left = torch.minimum(since * minor, until * minor)[..., None]
        right = torch.maximum(since * minor, until * minor)[..., None]
        across = (left - 1).floor() + 1 + torch.arange(_ACROSS, device=x.device)
        met = (along < high + 1)[..., None] & (across < right + 1) & (major != 0)[..., None]
        along = along[..., None].expand_as(across)
        columns = torch.where(level[..., None], along, across).flatten(1)
        rows = torch.where(level[..., None], across, along).flatten(1)
        return self.reached(source, columns.long(), rows.long(), met.flatten(1))

    def reached(
        self, source: Tensor, columns: Tensor, rows: Tensor, met: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the pairs of tiles with those at some distances from them, (n, m) or (1, m)."""
        row = torch.div(source, self.width, rounding_mode="floor")
        column = (source - row * self.width)[:, None] + columns
        image = torch.div(row, self.height, rounding_mode="floor") * self.height
        row = row[:, None] + rows
        above = image[:, None]
        inside = (column >= 0) & (column < self.width)
        inside = inside & (row >= above) & (row < above + self.height)
        if met is not None:
            inside = inside & met
        target = torch.where(inside, row * self.width + column, self.count)
        return source[:, None].expand_as(target).reshape(-1), target.reshape(-1)


@torch.no_grad()
def _best(
    pairs: Callable[[], _Pairs], score: Callable[[Tensor, Tensor], Tensor], like: Tensor
) -> Tensor:
    """Return which source has the highest score for each target; on a tie the last one.

    Args:
        pairs: Sources and targets, some at a time; targets up to the number of tiles, which is
            none.
        score: Of a source for a target, at least 0.
        like: A tensor with a value per target, for its size, type and device.
    """
    best = like.new_full((like.shape[0] + 1,), -1.0)
    which = torch.full(best.shape, -1, dtype=torch.int64, device=like.device)
    for source, target in pairs():
        value = score(source, target)
        top = torch.full_like(best, -1.0).scatter_reduce(0, target, value, "amax")
        number = torch.where(value == top[target], source, -1)
        last = torch.full_like(which, -1).scatter_reduce(0, target, number, "amax")
        better = (top > best) | ((top == best) & (last > which))
        best, which = torch.where(better, top, best), torch.where(better, last, which)
    return which[:-1]


def _picked(tiles: Tensor, index: Tensor, like: Tensor | None = None) -> Tensor:
    shape = tiles.shape if like is None else like.shape
    picked = _flat(tiles).gather(1, index.expand(2, -1))
    return picked.reshape(2, shape[0], *shape[2:]).transpose(0, 1)


def _flat(planes: Tensor) -> Tensor:
    """Return planes (B, C, Ty, Tx) as (C, B * Ty * Tx)."""
    return planes.transpose(0, 1).flatten(1)
