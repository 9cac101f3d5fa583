"""The layers of a frame: how many channels each has, and what its values must be."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from torchblur.errors import FrameError

__all__ = ["CHANNELS", "check_agreement", "shaped", "without_bad_values"]

CHANNELS = {
    "color": 3,
    "depth": 1,
    "velocity": 2,
    "normal": 3,
    "object_id": 1,
    "time": 1,
    "acceleration": 2,
    "albedo": 3,
    "valid": 1,
}
"""Names of all layers, and the channels of each."""

_CHECKED = ("color", "velocity", "normal", "time", "acceleration", "albedo", "depth")
_NOT_FLOATING = ("object_id", "valid")


def shaped(name: str, layer: Tensor, place: str) -> Tensor:
    """Return a layer with a batch dimension.

    Args:
        name: A name in `CHANNELS`.
        layer: (C, H, W) or (B, C, H, W).
        place: Where the frame came from, as errors say it.

    Raises:
        FrameError: wrong shape or type.
    """
    if not isinstance(layer, Tensor):
        raise FrameError(f"`{name}` must be a tensor, got {type(layer).__name__}")
    if layer.ndim == 3:
        layer = layer[None]
    channels = CHANNELS[name]
    if layer.ndim != 4 or layer.shape[1] != channels or 0 in layer.shape:
        raise FrameError(
            f"`{name}` must have shape (B, {channels}, H, W), got {tuple(layer.shape)}{place}"
        )
    if name not in _NOT_FLOATING and not layer.is_floating_point():
        raise FrameError(f"`{name}` must be floating point, got {layer.dtype}{place}")
    return layer


def check_agreement(layers: Mapping[str, Tensor], place: str) -> None:
    """Refuse layers of mixed sizes, devices or floating types.

    Args:
        layers: By name, (B, C, H, W), the color among them.
        place: Where the frame came from, as errors say it.

    Raises:
        FrameError: if one differs from the color.
    """
    color = layers["color"]
    for name, layer in layers.items():
        for what, got, want in (
            ("batch and size", _batch_and_size(layer), _batch_and_size(color)),
            ("device", layer.device, color.device),
            ("type", layer.dtype, color.dtype),
        ):
            if what == "type" and name in _NOT_FLOATING:
                continue
            if got != want:
                raise FrameError(
                    f"all layers must have one {what}: `color` has {want}, "
                    f"`{name}` has {got}{place}"
                )


def without_bad_values(
    layers: Mapping[str, Tensor], on_invalid: Literal["raise", "mask"], place: str
) -> dict[str, Tensor]:
    """Refuse or replace bad values: depths not above 0, and what else is not finite.

    Args:
        layers: By name, (B, C, H, W), the color among them.
        on_invalid: "raise", or "mask" to replace them, by +inf in the depth and by 0 elsewhere.
        place: Where the frame came from, as errors say it.

    Returns:
        The layers that change; "valid", bool, (B, 1, H, W), is among them if any value is bad.

    Raises:
        FrameError: with layer, count, first position and place.
    """
    changed: dict[str, Tensor] = {}
    good = layers["valid"].bool() if "valid" in layers else None
    for name in _CHECKED:
        if name not in layers:
            continue
        bad = ~(layers[name] > 0) if name == "depth" else ~torch.isfinite(layers[name])
        if bool(bad.any()):
            changed[name] = _replaced(name, layers[name], bad, on_invalid, place)
            pixels = ~bad.any(dim=1, keepdim=True)
            good = pixels if good is None else good & pixels
    if changed and good is not None:
        changed["valid"] = good
    return changed


def _replaced(name: str, layer: Tensor, bad: Tensor, on_invalid: str, place: str) -> Tensor:
    depth = name == "depth"
    rule, filler = ("be a positive distance (or +inf)", math.inf) if depth else ("be finite", 0.0)
    b, c, y, x = (int(i) for i in bad.nonzero()[0])
    text = (
        f"`{name}` must {rule}, got {int(bad.sum())} values that are not, the first "
        f"{float(layer[b, c, y, x])} in channel {c} at x={x}, y={y} of frame {b}{place}"
    )
    if on_invalid == "raise":
        raise FrameError(f'{text}; on_invalid="mask" replaces them')
    # The line that made the frame, behind two functions here and two methods of the frame.
    warnings.warn(f"{text}; replaced by {filler:g} and masked", stacklevel=5)
    return torch.where(bad, torch.full_like(layer, filler), layer)


def _batch_and_size(layer: Tensor) -> tuple[int, int, int]:
    return layer.shape[0], layer.shape[2], layer.shape[3]
