"""What the effects share: the Module over a function, and checks of the planes they take."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from torchblur.errors import ConfigError, FrameError, nearest_name
from torchblur.params import Config, build, declared

__all__ = ["Effect", "Values", "check_plane"]


class Values(SimpleNamespace):
    """Values of an effect's parameters: tensors that broadcast to (B, 1, H, W), or choices."""


class Effect(nn.Module):
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

    name: ClassVar[str]
    config_class: ClassVar[type[Config]]

    def __init__(self, config: Config | None = None, **params: Any) -> None:
        super().__init__()
        start = {} if config is None else config.model_dump()
        self.config = build(self.config_class, start | params, place=self.name)
        for key, spec in declared(self.config_class).items():
            value = getattr(self.config, key)
            if spec.grad == "smooth":
                self.register_parameter(key, nn.Parameter(torch.tensor(float(value))))
            elif spec.grad == "weak":
                self.register_buffer(key, torch.tensor(float(value)))

    def current_config(self) -> Config:
        """Return the config with the present values of the parameters, after a fit say.

        Raises:
            ConfigError: if a parameter has left its range; `project_` brings it back.
        """
        now = {key: float(getattr(self, key).detach()) for key in self._numbers()}
        return build(self.config_class, self.config.model_dump() | now, place=self.name)

    @torch.no_grad()
    def project_(self) -> Self:
        """Move each number back into its range, in place; for use after an optimizer's step."""
        for key in self._numbers():
            getattr(self, key).clamp_(*declared(self.config_class)[key].bounds)
        return self

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
        values = {key: getattr(self.config, key) for key in declared(self.config_class)}
        values |= {key: getattr(self, key) for key in self._numbers()}
        for key, value in overrides.items():
            values[key] = self._override(key, value, given[0])
        tensors = [v for v in values.values() if isinstance(v, Tensor)]
        batch_size = max([p.shape[0] for p in given] + [t.shape[0] for t in tensors if t.ndim == 4])
        for key, value in values.items():
            if isinstance(value, Tensor):
                values[key] = value.to(device=given[0].device, dtype=given[0].dtype)
        return Values(**values), [p.expand(batch_size, -1, -1, -1) for p in given]

    def _numbers(self) -> list[str]:
        specs = declared(self.config_class)
        return [key for key, spec in specs.items() if spec.grad != "discrete"]

    def _override(self, key: str, value: Any, color: Tensor) -> Any:
        specs = declared(self.config_class)
        if key not in specs:
            raise ConfigError(f"unknown parameter `{key}`{nearest_name(key, specs)} ({self.name})")
        if specs[key].grad == "discrete":
            return getattr(build(self.config_class, {key: value}, place=self.name), key)
        value = torch.as_tensor(value)
        specs[key].check(key, value)
        want = (color.shape[0], 1, *color.shape[2:])
        try:
            shape = torch.broadcast_shapes(value.shape, want)
        except RuntimeError:
            shape = ()
        if len(shape) != 4 or shape[1:] != want[1:]:
            raise ConfigError(
                f"`{key}` must broadcast to (B, 1, H, W) = {want}, got shape {tuple(value.shape)}"
            )
        return value

    def extra_repr(self) -> str:
        """Show the parameters that differ from the defaults, so that `repr` evaluates back."""
        default = self.config_class()
        changed = {k: v for k, v in self.config.model_dump().items() if v != getattr(default, k)}
        return ", ".join(f"{key}={value!r}" for key, value in changed.items())


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
