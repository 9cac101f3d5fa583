"""Small stochastic streams whose motion blur is known: textures that move, turn and cover."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.frame import Frame

__all__ = ["TexturedPlane"]


@dataclass(frozen=True)
class TexturedPlane:
    """A smooth texture that moves or turns, all over the image or in a square before a wall.

    The shutter is open for a whole frame around it: time t of frame f is ``f + t − 1/2``. Colors
    lie in [0, 1].

    Args:
        velocity: Of the texture, px/frame.
        spin: Turn about the middle of the image, radians per frame.
        size: Height and width in px.
        wave: Length of the texture's waves, px.
        square: Edge of the square at frame 0, in the middle, px; 0 fills the image.
        wall: Velocity of the wall behind the square, px/frame.
        dtype: Floating type of all layers.
    """

    velocity: tuple[float, float] = (8.0, 0.0)
    spin: float = 0.0
    size: tuple[int, int] = (32, 48)
    wave: float = 12.0
    square: float = 0.0
    wall: tuple[float, float] = (0.0, 0.0)
    dtype: torch.dtype = torch.float32

    def stream(self, frame: int = 0, seed: int = 0, still_time: float | None = None) -> Frame:
        """Return one sample per pixel, at a random time each.

        Args:
            frame: Which frame, from 0.
            seed: Other times for another seed; streams of one frame are its samples.
            still_time: One time for all pixels, in [0, 1]; a sharp image.
        """
        generator = torch.Generator().manual_seed(1000 * seed + frame)
        time = torch.rand(1, 1, *self.size, generator=generator, dtype=torch.float64)
        if still_time is not None:
            time = torch.full_like(time, still_time)
        color, velocity, depth = self._seen(frame + time - 0.5)
        layers = {"color": color, "velocity": velocity, "depth": depth, "time": time}
        layers["albedo"] = 0.25 + color / 2
        return Frame(**{name: plane.to(self.dtype) for name, plane in layers.items()})  # type: ignore[arg-type]

    def reference(self, frame: int = 0, steps: int = 128) -> Tensor:
        """Return the exact blur: the mean over evenly spread times, (1, 3, H, W)."""
        total = torch.zeros(1, 3, *self.size, dtype=torch.float64)
        for step in range(steps):
            time = torch.full((1, 1, *self.size), (step + 0.5) / steps, dtype=torch.float64)
            total += self._seen(frame + time - 0.5)[0]
        return (total / steps).to(self.dtype)

    def _seen(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return color, velocity and depth at times in frames, float64."""
        height, width = self.size
        y = torch.arange(height, dtype=torch.float64).view(1, 1, -1, 1) - (height - 1) / 2
        x = torch.arange(width, dtype=torch.float64).view(1, 1, 1, -1) - (width - 1) / 2
        x, y = x + 0 * time, y + 0 * time
        angle = -self.spin * time
        own_x = angle.cos() * x - angle.sin() * y - self.velocity[0] * time
        own_y = angle.sin() * x + angle.cos() * y - self.velocity[1] * time
        # Where the texture is turned, its drift turns along.
        drift_x = angle.cos() * self.velocity[0] + angle.sin() * self.velocity[1]
        drift_y = angle.cos() * self.velocity[1] - angle.sin() * self.velocity[0]
        motion = torch.cat((drift_x - self.spin * y, drift_y + self.spin * x), 1)
        color = self._texture(own_x, own_y, 0.0)
        if self.square == 0:
            return color, motion, torch.full_like(x, 4.0)
        inside = (own_x.abs() <= self.square / 2) & (own_y.abs() <= self.square / 2)
        behind = self._texture(x - self.wall[0] * time, y - self.wall[1] * time, 2.0)
        wall = torch.tensor(self.wall, dtype=torch.float64).view(1, 2, 1, 1)
        depth = torch.where(inside, 4.0, torch.full_like(x, 8.0))
        return torch.where(inside, color, behind), torch.where(inside, motion, wall), depth

    def _texture(self, x: Tensor, y: Tensor, phase: float) -> Tensor:
        k = 2 * math.pi / self.wave
        waves = [
            torch.sin(k * x + phase + channel) * torch.cos(k * 0.7 * y + 2 * channel)
            for channel in range(3)
        ]
        return 0.5 + 0.4 * torch.cat(waves, 1)
