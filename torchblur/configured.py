"""A `nn.Module` whose parameters are those that its configuration declares."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from torchblur.errors import ConfigError, nearest_name
from torchblur.params import Config, Param, build, declared

__all__ = ["ConfiguredModule", "Values", "batch_size_of"]


class Values(SimpleNamespace):
    """Values of parameters for one call: tensors that broadcast to (B, 1, H, W), or choices."""


class ConfiguredModule(nn.Module):
    """Base of filters and effects.

    Smooth parameters are `nn.Parameter`s, weak ones are buffers; both are 0-d tensors named as
    in the config. Switches and integers stay in `config`.

    Args:
        config: The parameters; the defaults if left out.
        **params: Single parameters by name, over those of `config`.

    Raises:
        ConfigError: unknown name, or a value out of range.
    """

    name: ClassVar[str]
    config_class: ClassVar[type[Config]]
    config: Config

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
        specs = declared(self.config_class)
        now = {key: _as_declared(getattr(self, key), specs[key]) for key in self._numbers()}
        return build(self.config_class, self.config.model_dump() | now, place=self.name)

    @torch.no_grad()
    def project_(self) -> Self:
        """Move each number back into its range, in place; for use after an optimizer's step."""
        for key in self._numbers():
            getattr(self, key).clamp_(*declared(self.config_class)[key].bounds)
        return self

    def values_for(self, color: Tensor, overrides: dict[str, Any] | None = None) -> Values:
        """Return the values for one call, in the color's type and on its device.

        Args:
            color: What the call works on, (B, C, H, W).
            overrides: Numbers, tensors that broadcast to (B, 1, H, W), or choices, by name.

        Raises:
            ConfigError: unknown name, value out of range, or a tensor that does not broadcast.
        """
        values = {key: getattr(self.config, key) for key in declared(self.config_class)}
        values |= {key: getattr(self, key) for key in self._numbers()}
        for key, value in (overrides or {}).items():
            values[key] = self._override(key, value, color)
        for key, value in values.items():
            if isinstance(value, Tensor):
                values[key] = value.to(device=color.device, dtype=color.dtype)
        return Values(**values)

    def extra_repr(self) -> str:
        """Show the parameters that differ from the defaults, so that `repr` evaluates back."""
        default = self.config_class()
        changed = {k: v for k, v in self.config.model_dump().items() if v != getattr(default, k)}
        return ", ".join(f"{key}={value!r}" for key, value in changed.items())

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


def _as_declared(value: Tensor, spec: Param) -> float:
    """Return a number; what a float32 makes of an end of the range is that end."""
    number = float(value.detach())
    ends = (end for end in spec.bounds if number == float(value.new_tensor(end)))
    return next(ends, number)


def batch_size_of(values: Values, given: int) -> int:
    """Return the batch that values and planes of a batch `given` broadcast to.

    Args:
        values: Values for one call.
        given: Batch of the planes.
    """
    tensors = [v for v in vars(values).values() if isinstance(v, Tensor) and v.ndim == 4]
    return max([given, *(t.shape[0] for t in tensors)])
