"""Small frames for tests: random ones, and scenes in which a given weight must act."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from torchblur.frame import Frame

__all__ = ["as_stream", "constant_motion", "moving_square", "random_frame"]


def random_frame(
    height: int = 23,
    width: int = 31,
    *,
    batch_size: int = 1,
    speed: float = 12.0,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
) -> Frame:
    """Return a frame of noise: color in [0, 1], depth in [1, 3], blocks of random velocity.

    Args:
        height: H in px; sizes that no tile divides are the useful ones.
        width: W in px.
        batch_size: B.
        speed: Standard deviation of the velocity, px/frame.
        seed: Another frame for another seed.
        dtype: Floating type of all layers.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(channels: int, h: int = height, w: int = width) -> Tensor:
        return torch.rand(batch_size, channels, h, w, generator=generator, dtype=dtype)

    coarse = torch.randn(batch_size, 2, 5, 7, generator=generator, dtype=dtype) * speed
    velocity = torch.nn.functional.interpolate(coarse, (height, width), mode="nearest")
    velocity = velocity + 0.1 * torch.randn(velocity.shape, generator=generator, dtype=dtype)
    depth = torch.nn.functional.interpolate(uniform(1, 4, 6), (height, width), mode="nearest")
    return Frame(color=uniform(3), velocity=velocity, depth=1 + 2 * depth)


def constant_motion(
    velocity: tuple[float, float], height: int = 24, width: int = 40, *, seed: int = 0
) -> Frame:
    """Return a frame of noise at one depth that moves as a whole, velocity in px/frame."""
    generator = torch.Generator().manual_seed(seed)
    motion = torch.tensor(velocity).view(1, 2, 1, 1).expand(1, 2, height, width)
    color = torch.rand(1, 3, height, width, generator=generator)
    return Frame(color=color, velocity=motion, depth=torch.full_like(color[:, :1], 5.0))


def moving_square(
    height: int = 21,
    width: int = 27,
    *,
    velocity: tuple[float, float] = (14.0, 3.0),
    background: tuple[float, float] = (-3.0, 5.0),
    depths: tuple[float, float] = (2.0, 2.6),
    dtype: torch.dtype = torch.float32,
) -> Frame:
    """Return a textured square that moves before a textured background that moves otherwise.

    Depths lie close together and the directions differ, so that depth, direction, cone and
    cylinder weights are all partly open; the left quarter of the background is slow. Each
    parameter of a filter has something to act on: there are object numbers (1 is the square),
    normals, and the background behind the square as revealed layer.

    Args:
        height: H in px.
        width: W in px.
        velocity: Of the square, px/frame.
        background: Of the background, px/frame.
        depths: Of square and background, scene units.
        dtype: Floating type of all layers.
    """
    generator = torch.Generator().manual_seed(7)
    inside = torch.zeros(1, 1, height, width, dtype=torch.bool)
    inside[..., height // 4 : 3 * height // 4, width // 4 : 3 * width // 4] = True

    def plane(front: float, back: float) -> Tensor:
        return torch.where(
            inside, torch.tensor(front, dtype=dtype), torch.tensor(back, dtype=dtype)
        )

    color = torch.rand(1, 3, height, width, generator=generator, dtype=dtype)
    motion = torch.cat([plane(f, b) for f, b in zip(velocity, background, strict=True)], 1)
    motion[..., : width // 4] *= 0.4
    wobble = torch.randn(motion.shape, generator=generator, dtype=dtype)
    grain = torch.rand(1, 1, height, width, generator=generator, dtype=dtype)
    square = Frame(color=color, velocity=motion + 0.7 * wobble, depth=plane(*depths) + 0.3 * grain)
    normal = torch.cat([plane(0.6, 0.0), plane(0.0, 0.0), plane(-0.8, -1.0)], 1)
    normal = normal + 0.2 * torch.randn(normal.shape, generator=generator, dtype=dtype)
    back = torch.rand(color.shape, generator=generator, dtype=dtype)
    flow = torch.tensor(background, dtype=dtype).view(1, 2, 1, 1)
    behind = Frame(
        color=torch.where(inside, back, color),
        velocity=torch.where(inside, flow + 0.7 * wobble, square.velocity),
        depth=torch.where(inside, depths[1] + 0.3 * grain, square.require("depth")),
    )
    return dataclasses.replace(
        square,
        normal=torch.nn.functional.normalize(normal, dim=1),
        object_id=inside.to(torch.int32),
        revealed=behind,
    )


def as_stream(frame: Frame, seed: int = 0) -> Frame:
    """Return a frame with a random time for each pixel, and a random albedo.

    Its color stays what it was: noise, not what a moving texture would show at these times. An
    eighth of the albedo is nearly black.

    Args:
        frame: Any frame.
        seed: Other times for another seed.
    """
    generator = torch.Generator().manual_seed(seed)
    batch, _, height, width = frame.color.shape
    drawn = torch.rand(batch, 5, height, width, generator=generator, dtype=torch.float64)
    drawn = drawn.to(frame.dtype)
    albedo = torch.where(drawn[:, 4:] < 1 / 8, 1e-3, 0.2 + 0.8 * drawn[:, 1:4])
    return dataclasses.replace(frame, time=drawn[:, :1], albedo=albedo)
