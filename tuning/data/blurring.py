"""Calling a filter with the data's shutter and with values of a fit: on a frame, on a sequence.

Fits call thousands of times, so what a filter cuts short is no warning here: their results say it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.filters.parts.base import TemporalBlur
from torchblur.filters.parts.reach import ReachingBlur
from torchblur.frame import Frame

__all__ = ["arguments", "blurred", "blurred_sequence"]


def blurred(
    blur: BlurFilter,
    frame: Frame,
    shutter: Tensor | float,
    position: str,
    values: Mapping[str, Any],
    free: Sequence[str] = (),
) -> Tensor:
    """Return the filtered color with the data's shutter and single values, (B, 3, H, W).

    Args:
        blur: The filter; one with a memory has no past here.
        frame: A batch of M frames, or one frame for K sets of values.
        shutter: Open time as a fraction of a frame: a number, or (M, 1, 1, 1).
        position: The shutter's position.
        values: Values by name: (K,) tensors, numbers, or choices.
        free: Names of the free parameters; the shutter is left alone if it is one of them.
    """
    _keep_quiet(blur)
    given = arguments(shutter, position, values, free, frame.device)
    return blur.layers(frame, **given)["color"]


def arguments(
    shutter: Tensor | float,
    position: str,
    values: Mapping[str, Any],
    free: Sequence[str],
    device: torch.device,
) -> dict[str, Any]:
    """Return the overrides of a call: the data's shutter, and values shaped to broadcast.

    Args:
        shutter: As in `blurred`.
        position: As in `blurred`.
        values: As in `blurred`.
        free: As in `blurred`.
        device: Of the frames.
    """
    given: dict[str, Any] = {"shutter": shutter, "shutter_position": position}
    given = {key: value for key, value in given.items() if key not in free}
    for name, value in values.items():
        is_batch = isinstance(value, Tensor) and value.ndim == 1
        given[name] = value.to(device).view(-1, 1, 1, 1) if is_batch else value
    return given


def blurred_sequence(
    blur: BlurFilter,
    steps: Sequence[Sequence[Frame]],
    cuts: Collection[int],
    given: Mapping[str, Any],
    *,
    unroll: int | None = None,
) -> Iterator[Tensor]:
    """Yield the filtered color of each time step, (B, 3, H, W).

    A filter without a memory takes each frame alone; of several samples per pixel it blurs each,
    and the mean counts.

    Args:
        blur: The filter.
        steps: For each time step one frame, or several of the same pixels.
        cuts: Positions of frames that begin a new shot: what was before is forgotten.
        given: What `arguments` returned.
        unroll: Let gradients go back through at most so many frames: the memory is cut off from
            the graph after every k-th frame. All of them if left out.
    """
    _keep_quiet(blur)
    if not isinstance(blur, TemporalBlur):
        for step in steps:
            colors = [blur.layers(frame, **given)["color"] for frame in step]
            yield colors[0] if len(colors) == 1 else torch.stack(colors).mean(dim=0)
        return
    history = None
    for index, step in enumerate(steps):
        layers, history = blur.step(step, None if index in cuts else history, **given)
        if unroll is not None and (index + 1) % unroll == 0:
            history = history.detach()
        yield layers["color"]


def _keep_quiet(blur: BlurFilter) -> None:
    if isinstance(blur, ReachingBlur):
        blur.keep_quiet()
