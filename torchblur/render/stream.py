"""Stochastic streams: each pixel is seen once, at a random time of its own."""

from __future__ import annotations

import struct

import numpy as np
import torch
from torch import Tensor

from torchblur.frame import Frame, Shutter
from torchblur.render.scene import Scene
from torchblur.render.surface import pixel_centers, surface_layers
from torchblur.render.trace import Tracer

__all__ = ["StreamTracer", "random_planes"]


class StreamTracer:
    """One frame of a scene, ready to be seen at a random time per pixel.

    Args:
        scene: The scene.
        frame: The frame that the shutter opens around, in frames.
        device: Where to compute.
        compiled: Whether to compile.
    """

    def __init__(self, scene: Scene, frame: float, *, device: torch.device, compiled: bool) -> None:
        # float32 would show another body than the layers have, at a few pixels of an edge.
        self._lit, self._unlit = (
            Tracer(each, frame, dtype=torch.float64, device=device, compiled=compiled)
            for each in (scene, _without_light(scene))
        )
        self._device = device

    def frame(
        self, size: tuple[int, int], shutter: Shutter, time: Tensor, shift: Tensor | None = None
    ) -> Frame:
        """Return what each pixel sees at its time.

        Args:
            size: Height and width in px.
            shutter: When the shutter is open.
            time: Time over the shutter, 0 opening, 1 closing, float32, (H*W,).
            shift: Position right of and below the pixel's center, px, (2, H*W); at the center if
                left out.

        Returns:
            A frame of one with all layers of a stream.
        """
        x, y = pixel_centers(size, self._device)
        if shift is not None:
            x, y = (a + b.to(self._device) for a, b in zip((x, y), shift, strict=True))
        time = time.to(self._device)
        start, end = shutter.interval
        times = start + (end - start) * time.double()
        layers = surface_layers(self._lit, size, x, y, times)
        layers |= {
            "color": self._lit.image(size, x, y, times),
            "albedo": self._unlit.image(size, x, y, times),
            "time": time,
        }
        images = {name: layer.reshape(1, -1, *size).float() for name, layer in layers.items()}
        images["object_id"] = images["object_id"].long()
        return Frame(**images)  # type: ignore[arg-type]


def random_planes(seed: int, frame: float, sample: int, shape: tuple[int, ...]) -> Tensor:
    """Return uniform numbers in [0, 1), float32, of a stream's sample.

    Args:
        seed: Of the stream.
        frame: The frame; each has numbers of its own, whatever was drawn before.
        sample: Which of a pixel's samples, from 0.
        shape: Of the result.
    """
    (bits,) = struct.unpack("<Q", struct.pack("<d", frame + 0.0))  # + 0.0: -0 is 0
    generator = np.random.default_rng([seed % 2**64, bits, sample])
    return torch.from_numpy(generator.random(shape, dtype=np.float32))


def _without_light(scene: Scene) -> Scene:
    """Return the scene as its textures are: all of its light falls on all sides."""
    light = scene.light.model_copy(update={"ambient": 1.0})
    return scene.model_copy(update={"light": light})
