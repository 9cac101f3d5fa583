"""What the effects share: the Module over a function, and checks of the planes they take."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchblur.configured import ConfiguredModule, Values, batch_size_of
from torchblur.errors import FrameError

__all__ = ["Effect", "Values", "check_plane"]


class Effect(ConfiguredModule):
    """An effect beside a blur, as a Module.

    As in a filter, smooth parameters are `nn.Parameter`s and weak ones buffers, 0-d tensors
    named as in the config; switches and integers stay in `config`. Any number can be replaced
    for one call by a tensor that broadcasts to (B, 1, H, W).

    Args:
        config: The parameters; the defaults if left out.
        **params: Single parameters by name, over those of `config`.

    Raises:
        ConfigError: unknown name, or a value out of range.
    """

    def prepare(
        self, overrides: dict[str, Any], **planes: Tensor | None
    ) -> tuple[Values, list[Tensor]]:
        """Return the values for one call, and the planes in one common batch.

        Args:
            overrides: Numbers, tensors that broadcast to (B, 1, H, W), or choices, by name.
            **planes: Checked planes, the color first; those that are None are left out.

        Returns:
            Values in the planes' type and on their device, and the planes, (B, C, H, W).

        Raises:
            ConfigError: unknown name, value out of range, or a tensor that does not broadcast.
        """
        given = [plane for plane in planes.values() if plane is not None]
        values = self.values_for(given[0], overrides)
        batch_size = batch_size_of(values, max(plane.shape[0] for plane in given))
        return values, [plane.expand(batch_size, -1, -1, -1) for plane in given]


def check_plane(name: str, plane: Tensor, channels: int, like: Tensor | None = None) -> None:
    """Refuse a tensor that is not a floating plane of so many channels.

    Args:
        name: Name for the message.
        plane: What was given.
        channels: C.
        like: A plane whose batch, size, type and device it must have, but for a batch of one.

    Raises:
        FrameError: wrong shape or type, or it does not go with `like`.
    """
    if not isinstance(plane, Tensor):
        raise FrameError(f"`{name}` must be a tensor, got {type(plane).__name__}")
    if plane.ndim != 4 or plane.shape[1] != channels or 0 in plane.shape:
        raise FrameError(
            f"`{name}` must have shape (B, {channels}, H, W), got {tuple(plane.shape)}"
        )
    if not plane.is_floating_point():
        raise FrameError(f"`{name}` must be floating point, got {plane.dtype}")
    if like is None:
        return
    if plane.shape[2:] != like.shape[2:] or plane.shape[0] not in (1, like.shape[0]):
        raise FrameError(
            f"`{name}` must have the batch and size of `color`, "
            f"{(like.shape[0], *like.shape[2:])}, got {(plane.shape[0], *plane.shape[2:])}"
        )
    if (plane.dtype, plane.device) != (like.dtype, like.device):
        raise FrameError(
            f"`{name}` must have the type and device of `color`, {like.dtype} on {like.device}, "
            f"got {plane.dtype} on {plane.device}"
        )
