"""Images and frames into OpenEXR files, in torchblur's own layout."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchblur.errors import OutputError
from torchblur.frame import Frame
from torchblur.io.exr import to_half, write_exr

__all__ = ["write_frame", "write_image"]

_SUFFIXES = {1: ("",), 2: (".X", ".Y"), 3: (".R", ".G", ".B"), 4: (".R", ".G", ".B", ".A")}
_FRAME_CHANNELS = {
    "velocity": ("velocity.X", "velocity.Y"),
    "depth": ("Z",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "object_id": ("id",),
    "time": ("time",),
    "acceleration": ("acceleration.X", "acceleration.Y"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "valid": ("valid",),
}


def write_image(
    path: str | Path,
    color: Tensor,
    *,
    layers: Mapping[str, Tensor] | None = None,
    half: bool = True,
    metadata: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a color image, and layers beside it, as one OpenEXR file.

    Args:
        path: The file; it appears whole or not at all.
        color: Scene-linear radiance, (1, 3, H, W) or (3, H, W).
        layers: More tensors by name, (1, C, H, W) or (C, H, W) with C from 1 to 4: channels
            `name`, `name.X/.Y`, `name.R/.G/.B` or `name.R/.G/.B/.A`. Float is written as 32 bits,
            integers and bool as uint.
        half: Write the color as 16-bit float, which holds values up to 65504.
        metadata: Anything JSON can hold; `read_exr(path).metadata` gives it back.
        overwrite: Replace an existing file.

    Raises:
        OutputError: wrong shape, color beyond half float, negative integers, the file exists, or
            its folder cannot be written to.
    """
    channels = {
        name: to_half(plane, name) if half else plane
        for name, plane in _planes_of("color", color, ("R", "G", "B")).items()
    }
    for name, tensor in (layers or {}).items():
        count = tensor.shape[-3] if tensor.ndim >= 3 else 0
        if count not in _SUFFIXES:
            raise OutputError(
                f"layer `{name}` must have 1 to 4 channels, (1, C, H, W), got {tuple(tensor.shape)}"
            )
        channels |= _planes_of(name, tensor, tuple(name + end for end in _SUFFIXES[count]))
    write_exr(path, channels, metadata=metadata, overwrite=overwrite)


def write_frame(
    path: str | Path,
    frame: Frame,
    *,
    half: bool = False,
    metadata: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write all layers of a frame in torchblur's own layout; `read_frame` gives them back.

    Args:
        path: The file; it appears whole or not at all.
        frame: A frame of batch size 1. float64 is rounded to float32; a revealed frame goes into
            the layer `revealed`.
        half: Write the color as 16-bit float.
        metadata: As in `write_image`.
        overwrite: Replace an existing file.

    Raises:
        OutputError: as `write_image`.
    """
    write_exr(path, _channels_of(frame, half), metadata=metadata, overwrite=overwrite)


def _channels_of(frame: Frame, half: bool) -> dict[str, NDArray[Any]]:
    channels = {
        name: to_half(plane, name) if half else plane
        for name, plane in _planes_of("color", frame.color, ("R", "G", "B")).items()
    }
    for name, names in _FRAME_CHANNELS.items():
        layer = getattr(frame, name)
        if layer is not None:
            whole = name in ("object_id", "valid")
            channels |= _planes_of(name, layer.long() if whole else layer, names)
    if frame.revealed is not None:
        behind = _channels_of(frame.revealed, half)
        channels |= {f"revealed.{name}": plane for name, plane in behind.items()}
    return channels


def _planes_of(name: str, tensor: Tensor, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    values = tensor.detach().cpu()
    if values.ndim == 4 and values.shape[0] == 1:
        values = values[0]
    if values.ndim != 3 or values.shape[0] != len(names):
        raise OutputError(
            f"`{name}` must have shape (1, {len(names)}, H, W), got {tuple(tensor.shape)}"
        )
    if values.is_floating_point():
        array: NDArray[Any] = values.float().numpy()
    else:
        if bool((values.long() < 0).any()) or bool((values.long() >= 2**32).any()):
            raise OutputError(f"`{name}` must lie in [0, 2^32) to be written as uint")
        array = values.long().numpy().astype(np.uint32)
    return dict(zip(names, array, strict=True))
