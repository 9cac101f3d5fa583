"""Stochastic streams: each pixel is seen once, at a random time of its own."""

from __future__ import annotations

import struct

import numpy as np
import torch
from torch import Tensor

from torchblur.frame import Frame, Shutter
from torchblur.render.surface import pixel_centers, surface_layers
from torchblur.render.trace import Tracer

__all__ = ["random_planes", "trace_stream"]


def trace_stream(
    tracer: Tracer,
    size: tuple[int, int],
    shutter: Shutter,
    time: Tensor,
    shift: Tensor | None = None,
) -> Frame:
    """Return what each pixel sees at its time.

    Args:
        tracer: The scene in float64 (float32 would show another body than the layers have, at a
            few pixels of an edge), around the frame that the shutter belongs to.
        size: Height and width in px.
        shutter: When the shutter is open.
        time: Time over the shutter, 0 opening, 1 closing, float32, (H*W,).
        shift: Position right of and below the pixel's center, px, (2, H*W); at the center if left
            out.

    Returns:
        A frame of one with all layers of a stream.
    """
    x, y = pixel_centers(size, time.device)
    if shift is not None:
        x, y = x + shift[0], y + shift[1]
    start, end = shutter.interval
    times = start + (end - start) * time.double()
    layers = surface_layers(tracer, size, x, y, times, radiance=True) | {"time": time}
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
