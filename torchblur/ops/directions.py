"""Two blur directions per tile: the longest velocity, and one that points elsewhere."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchblur.ops.tiles import neighbor_max, tile_max
from torchblur.ops.velocity import direction, length

__all__ = [
    "DirectionReduction",
    "TileDirections",
    "best_in_tiles",
    "secondary_score",
    "tile_directions",
]

DirectionReduction = Literal["exact", "hierarchical"]

_CELL = 8  # px; edge of the first step of the hierarchical reduction
_OFFSETS = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]


class TileDirections(NamedTuple):
    """Displacements in px per tile, of the tile and of those that reach it, (B, 2, Ty, Tx)."""

    primary: Tensor
    secondary: Tensor


def secondary_score(primary: Tensor, sample: Tensor, exponent: float | Tensor = 2.0) -> Tensor:
    """Return ``|v| · (1 − |cos|) ** exponent``: long, and across the primary direction.

    Args:
        primary: The direction that is taken already, px, (B, 2, ·, ·).
        sample: Candidates v, px, broadcasts to it.
        exponent: How much an angle counts against the length; > 0.

    Returns:
        Scores >= 0 in px, (B, 1, ·, ·); |v| where the primary is zero.

    Reference: 2025 notes, Second Blur Direction. We differ: the text does not say what its weight
        of the angle multiplies; we take the length. The exponent is a parameter (2 there).
    """
    return _score(direction(primary), direction(sample), length(sample), exponent)


def _score(primary: Tensor, unit: Tensor, size: Tensor, exponent: float | Tensor) -> Tensor:
    """Return `secondary_score` from the unit vectors of both and the candidate's length."""
    (ax, ay), (bx, by) = primary.split(1, 1), unit.split(1, 1)
    cosine = (ax * bx + ay * by).abs()  # a sum over two channels would cost more
    score: Tensor = size * (1 - cosine).clamp_min(0) ** exponent
    return score


def tile_directions(
    velocity: Tensor,
    tile_size: int,
    *,
    reduction: DirectionReduction = "exact",
    cull: bool = False,
    exponent: float | Tensor = 2.0,
) -> TileDirections:
    """Return the longest velocity around each tile, and the one that complements it best.

    Args:
        velocity: Displacements in px, (B, 2, H, W).
        tile_size: r, the edge of a tile in px, at least 1.
        reduction: "exact": the secondary is the best of all pixels of the 3x3 tiles, given their
            primary. "hierarchical": as on a GPU, cells of at most 8 px, then tiles, then 3x3
            tiles; each step picks among what the step before it has left.
        cull: Leave out velocities of diagonal tiles that cannot reach the middle one.
        exponent: See `secondary_score`; a number or (B, 1, 1, 1).

    Differentiable: in the selected vectors; the selection has no gradient.
    Border: tiles outside the image do not take part.
    Reference: 2025 notes, Second Blur Direction. We differ: the text has the hierarchical form
        only, and does not say what a step picks among; ours are the primaries and secondaries
        of the step before.
    """
    if reduction == "exact":
        primary = neighbor_max(tile_max(velocity, tile_size), cull=cull)
        return TileDirections(
            primary, _best_of_pixels(velocity, primary, tile_size, cull, exponent)
        )
    cell = max(n for n in range(1, _CELL + 1) if tile_size % n == 0)
    cells = tile_max(velocity, cell)
    second = _best_in_windows([velocity], cells, cell, exponent)
    step = tile_size // cell
    tiles = tile_max(cells, step)
    second = _best_in_windows([cells, second], tiles, step, exponent)
    primary = neighbor_max(tiles, cull=cull)
    return TileDirections(primary, _best_of_neighbors([tiles, second], primary, cull, exponent))


def best_in_tiles(
    velocity: Tensor, primary: Tensor, tile_size: int, exponent: float | Tensor = 2.0
) -> Tensor:
    """Return, per tile, the pixel's vector with the highest score against the tile's primary.

    Args:
        velocity: Displacements in px, (B, 2, H, W).
        primary: The direction that is taken already, px, (B, 2, Ty, Tx).
        tile_size: r, the edge of a tile in px.
        exponent: See `secondary_score`; a number or (B, 1, 1, 1).

    Returns:
        Displacements in px, (B, 2, Ty, Tx).

    Differentiable: in the selected vectors.
    """
    return _best_in_windows([velocity], primary, tile_size, exponent)


def _padded(planes: Tensor, multiple: int) -> Tensor:
    height, width = planes.shape[-2:]
    padding = (0, -width % multiple, 0, -height % multiple)
    return F.pad(planes, padding, mode="replicate") if any(padding) else planes


def _best_in_windows(
    candidates: list[Tensor], primary: Tensor, window: int, exponent: float | Tensor
) -> Tensor:
    """Return, per window, the candidate with the highest score against the window's primary."""
    scores, vectors = [], []
    for candidate in candidates:
        whole = _padded(candidate, window)
        score, index = _window_scores(_Candidates.of(whole), primary, window, exponent)
        scores.append(score)
        vectors.append(_picked(whole, index))
    best = torch.stack(scores).argmax(0)
    return _chosen(vectors, best)


def _best_of_pixels(
    velocity: Tensor, primary: Tensor, size: int, cull: bool, exponent: float | Tensor
) -> Tensor:
    """Return the pixel's vector in the 3x3 tiles with the highest score against their primary."""
    whole = _padded(velocity, size)
    candidates = _Candidates.of(whole)
    scores, vectors = [], []
    for offset in _OFFSETS:
        x, y = offset
        # The neighbor at +offset is judged against this tile's primary, and the result moved back.
        score, index = _window_scores(
            candidates, _moved(primary, x, y, 0.0), size, exponent, offset if cull else None
        )
        scores.append(_moved(score, -x, -y, -1.0))
        vectors.append(_moved(_picked(whole, index), -x, -y, 0.0))
    return _chosen(vectors, torch.stack(scores).argmax(0))


def _best_of_neighbors(
    candidates: list[Tensor], primary: Tensor, cull: bool, exponent: float | Tensor
) -> Tensor:
    """Return the best of the candidates of the 3x3 tiles, given their primary."""
    scores, vectors = [], []
    for x, y in _OFFSETS:
        for candidate in candidates:
            vector = _moved(candidate, -x, -y, 0.0)
            score = secondary_score(primary, vector.detach(), exponent)
            inside = _moved(torch.ones_like(score), -x, -y, 0.0) > 0
            if cull:
                inside = inside & _reaches(vector, x, y)
            scores.append(torch.where(inside, score, -1.0))
            vectors.append(vector)
    return _chosen(vectors, torch.stack(scores).argmax(0))


class _Candidates(NamedTuple):
    """Vectors among which windows choose, (B, 2, H, W), without a gradient."""

    vector: Tensor
    unit: Tensor
    size: Tensor

    @classmethod
    def of(cls, vector: Tensor) -> _Candidates:
        vector = vector.detach()
        return cls(vector, direction(vector), length(vector))


@torch.no_grad()
def _window_scores(
    candidates: _Candidates,
    primary: Tensor,
    window: int,
    exponent: float | Tensor,
    offset: tuple[int, int] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the highest score per window, (B, 1, Ty, Tx), and the place of the vector."""
    unit = direction(primary).repeat_interleave(window, 2).repeat_interleave(window, 3)
    score = _score(unit, candidates.unit, candidates.size, exponent)
    if offset is not None:
        score = torch.where(_reaches(candidates.vector, *offset), score, -1.0)
    return F.max_pool2d(score, window, return_indices=True)


def _reaches(vector: Tensor, x: int, y: int) -> Tensor:
    """Whether motion in the tile at an offset can reach the middle: always, but from a diagonal."""
    if x * y == 0:
        return torch.ones_like(vector[:, :1], dtype=torch.bool)
    return x * y * vector[:, :1] * vector[:, 1:] > 0


def _picked(whole: Tensor, index: Tensor) -> Tensor:
    flat = whole.flatten(2).gather(2, index.flatten(2).expand(-1, 2, -1))
    return flat.reshape(*whole.shape[:2], *index.shape[-2:])


def _moved(tiles: Tensor, x: int, y: int, fill: float) -> Tensor:
    """Return the planes moved by whole tiles, to the right and down, filled from outside."""
    height, width = tiles.shape[-2:]
    padded = F.pad(tiles, (1, 1, 1, 1), value=fill)
    return padded[..., 1 - y : 1 - y + height, 1 - x : 1 - x + width]


def _chosen(vectors: list[Tensor], index: Tensor) -> Tensor:
    stacked = torch.stack(vectors)
    return stacked.gather(0, index[None].expand(-1, -1, 2, -1, -1))[0]
