"""The pre-filter: random samples from along the motion, shared among neighbors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchblur.ops.points import Points, flat, nearest_index, per_point, points_where, put, take
from torchblur.ops.segments import path_distance
from torchblur.ops.taps import Engine, Inputs, sum_taps

__all__ = ["Candidates", "Stream", "add_candidates", "random_candidates"]


class Stream(NamedTuple):
    """One sample per pixel, as planes."""

    color: Tensor
    """What is averaged, any number C of planes, (B, C, H, W)."""
    displacement: Tensor
    """v, over the shutter, px, (B, 2, H, W)."""
    time: Tensor
    """t in [0, 1], (B, 1, H, W)."""
    moving: Tensor
    """1 where the sample moves and can be trusted, else 0, (B, 1, H, W)."""


class Candidates(NamedTuple):
    """Random numbers that choose the candidates."""

    times: Tensor
    """t' in [0, 1), K per pixel, (1 or B, K, H, W)."""
    jitter: Tensor
    """j in [−1, 1), in units of the jitter's size: x of the first candidate, its y, x of the
    second …, (1 or B, 2K, H, W)."""


def random_candidates(like: Tensor, samples: int, seed: int, stream: int = 0) -> Candidates:
    """Return the random numbers for one frame: the same for the same seed and stream.

    Args:
        like: A tensor (B, C, H, W) whose size, type and device they take; all images of a batch
            get the same.
        samples: K, candidates per pixel.
        seed: Other numbers for another seed.
        stream: Other numbers for another frame, or for another sample of the same pixels.
    """
    mixed = (seed * 0x9E3779B1 + stream * 0x85EBCA77) % 2**32  # the generator takes 32 bits
    generator = torch.Generator().manual_seed(mixed)
    height, width = like.shape[-2:]
    drawn = torch.rand(1, 3 * samples, height, width, generator=generator)
    drawn = drawn.to(device=like.device, dtype=like.dtype)
    return Candidates(drawn[:, :samples], 2 * drawn[:, samples:] - 1)


class _Options(NamedTuple):
    samples: int


def add_candidates(
    stream: Stream,
    random: Candidates,
    jitter: Tensor | float = 1.5,
    distance: Tensor | float = 2.5,
    min_length: Tensor | float = 3.0,
    engine: Engine = "eager",
) -> Tensor:
    """Return the color with random samples from along the motion averaged in.

    Each pixel r that moves at least `min_length` draws K candidates at
    ``s = round(r + v_r (t' − t_r) + j)``. A pixel p that moves as far takes, of those of the 3x3
    pixels around it, each that moves and whose path comes nearer to p than `distance`, and
    becomes the mean of itself and those.

    Args:
        stream: One sample per pixel.
        random: From `random_candidates`.
        jitter: Largest |j| in x and in y, px; a number or (B, 1, H, W).
        distance: Threshold of the distance to the path, px, likewise.
        min_length: Least displacement over the shutter, px, likewise.
        engine: See `ops.taps`.

    Returns:
        (B, C, H, W); other pixels are as they were.

    Differentiable: in the color. Which candidates are drawn and taken is a choice.
    Border: replicated: candidates outside come from the border, and at the border the
        candidates of a pixel may count twice.
    Reference: Oberberger 2022, section 4.2. We differ: only colors are averaged, velocity and
        time stay the pixel's own.
    """
    fast = stream.displacement.square().sum(1, keepdim=True).sqrt() >= min_length
    points = points_where(fast & (stream.moving > 0), stream.color.dtype)
    if points.number == 0:
        return stream.color
    number = random.times.shape[1]
    with torch.no_grad():
        drawn = _draw(stream, points, random, jitter)
    inputs = {"texture": flat(torch.cat((stream.color, stream.displacement, stream.time), 1))}
    inputs |= points.inputs() | {"drawn": drawn, "moving": flat(stream.moving)}
    inputs["distance"] = per_point(distance, points, stream.color)
    color, count = sum_taps(_tap, _Options(number), 9 * number, inputs, engine)
    mean = (take(stream.color, points) + color) / (1 + count)
    return put(mean, points, stream.color)


def _draw(stream: Stream, points: Points, random: Candidates, jitter: Tensor | float) -> Tensor:
    """Return the candidates of all pixels as positions in the flat planes, −1 none, (K, P)."""
    batch = stream.color.shape[0]
    times, shift = (take(plane.expand(batch, -1, -1, -1), points) for plane in random)
    shift = shift * per_point(jitter, points, stream.color)
    lead = times - take(stream.time, points)
    velocity = take(stream.displacement, points)
    x = points.x + velocity[:1] * lead + shift[0::2]
    y = points.y + velocity[1:] * lead + shift[1::2]
    inputs = points.inputs()
    rows = [nearest_index(x[k : k + 1], y[k : k + 1], inputs)[0] for k in range(x.shape[0])]
    places = points.place.new_full((x.shape[0], stream.time.numel()), -1)
    return places.index_copy(1, points.place, torch.stack(rows))


def _tap(index: Tensor, count: Tensor, inputs: Inputs, options: _Options) -> tuple[Tensor, ...]:
    neighbor = torch.div(index, options.samples, rounding_mode="floor")
    row = torch.div(neighbor, 3, rounding_mode="floor")
    place, _, _ = nearest_index(
        inputs["x"] + (neighbor - 3 * row - 1), inputs["y"] + (row - 1), inputs
    )
    turn = (index - neighbor * options.samples).long().reshape(1)
    drawn = inputs["drawn"].index_select(0, turn)[0].index_select(0, place)
    sample = drawn.clamp(min=0)
    planes = inputs["texture"].index_select(1, sample)
    inside = sample[None] - inputs["first"]
    width = inputs["size"][0].long()
    y = torch.div(inside, width, rounding_mode="floor")
    dx = inputs["x"] - (inside - y * width).to(planes.dtype)
    dy = inputs["y"] - y.to(planes.dtype)
    far = path_distance(dx, dy, planes[-3:-2], planes[-2:-1], planes[-1:])
    taken = (far < inputs["distance"]) & (drawn[None] >= 0)
    weight = taken * inputs["moving"].index_select(1, sample)
    return weight * planes[:-3], weight
