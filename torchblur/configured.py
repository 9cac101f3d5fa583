"""A `nn.Module` whose parameters are those that its configuration declares."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
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
    in the config. Switches and integers stay in `config`; `state_dict` keeps them as extra state,
    so that a module into which it is loaded computes the same.

    Args:
        config: The parameters; the defaults if left out.
        **params: Single parameters by name, over those of `config`.

    Raises:
        ConfigError: unknown name, or a value out of range.
    """

    name: ClassVar[str]
    config_class: ClassVar[type[Config]]
    config: Config
    _config_base: ClassVar[type[Config]] = Config

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if {"name", "config_class"} & set(cls.__dict__):
            _check_declarations(cls, cls._config_base)

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
        return build(self.config_class, self._now(), place=self.name)

    def changed_params(self) -> dict[str, Any]:
        """Return the present values that differ from the defaults, by name."""
        default = self.config_class().model_dump()
        return {key: value for key, value in self._now().items() if value != default[key]}

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
            ConfigError: unknown name, value out of range, a tensor that does not broadcast, or sets
            of parameters of differing numbers.
        """
        values = {key: getattr(self.config, key) for key in declared(self.config_class)}
        values |= {key: getattr(self, key) for key in self._numbers()}
        for key, value in (overrides or {}).items():
            values[key] = self._override(key, value, color)
        for key, value in values.items():
            if isinstance(value, Tensor):
                values[key] = value.to(device=color.device, dtype=color.dtype)
        _check_sets(values, self.name)
        return Values(**values)

    def extra_repr(self) -> str:
        """Show the values that differ from the defaults, so that `repr` evaluates back."""
        return ", ".join(f"{key}={value!r}" for key, value in self.changed_params().items())

    def get_extra_state(self) -> dict[str, Any]:
        """Return the name and what is not a tensor, for `state_dict`: plain texts and numbers."""
        numbers = self._numbers()
        switches = {k: v for k, v in self.config.model_dump().items() if k not in numbers}
        return {"name": self.name, "config": switches}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        """Take over switches and counts, for `load_state_dict`.

        Raises:
            ConfigError: the state is that of another filter or effect, or it has a switch or a
                value that this one does not know.
        """
        self.config = self._config_of(state)

    def _config_of(self, state: Mapping[str, Any]) -> Config:
        if state["name"] != self.name:
            raise ConfigError(
                f"a state must be loaded into what it was saved from, `{state['name']}`, "
                f"got `{self.name}`"
            )
        data = self.config.model_dump() | state["config"]
        return build(self.config_class, data, place=f"state of {self.name}")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        key = f"{prefix}_extra_state"
        if key in state_dict:
            self._config_of(state_dict[key])  # refused before any number is taken over
        elif any(prefix + number in state_dict for number in self._numbers()):
            own = self.get_extra_state()
            kept = ", ".join(f"{name}={value!r}" for name, value in own["config"].items())
            warnings.warn(
                f"a state of `{self.name}` without switches and counts (torchblur 0.1 saved "
                f"numbers alone): those of the module stay, {kept}",
                stacklevel=4,
            )
            state_dict = state_dict | {key: own}
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _now(self) -> dict[str, Any]:
        """Return the present values by name, whether in their ranges or not."""
        specs, start = declared(self.config_class), self.config.model_dump()
        now = {k: _as_declared(getattr(self, k), specs[k], start[k]) for k in self._numbers()}
        return start | now

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


def _as_declared(value: Tensor, spec: Param, start: float) -> float:
    """Return a number as it was given, an end of the range, or the shortest decimal for it.

    A number that is made as a float32 is that decimal in a double, too.
    """
    number = float(value.detach())
    decimals = (float(f"{number:.{digits}g}") for digits in range(1, 18))
    known = (start, *spec.bounds, *(decimals if math.isfinite(number) else ()))
    single = value.new_empty((), dtype=torch.float32)
    return next((x for x in known if number in _rounded(x, value, single)), number)


def _rounded(x: float, *like: Tensor) -> list[float]:
    return [float(tensor.new_tensor(x)) for tensor in like]


def _check_declarations(cls: type[ConfiguredModule], base: type[Config]) -> None:
    """Refuse a class whose parameters are not all declared, when it is made."""
    model = getattr(cls, "config_class", None)
    if not (isinstance(model, type) and issubclass(model, base)):
        got = "nothing" if model is None else repr(model)
        raise ConfigError(
            f"`{cls.__qualname__}` must have a `config_class`, a subclass of `{base.__name__}`, "
            f"got {got}"
        )
    specs = declared(model)
    for key, field in model.model_fields.items():
        if key not in specs:
            rule = "must be declared with a `Param`: `Annotated[float, Param(...)]`"
        elif specs[key].grad != "discrete" and specs[key].low is None:
            rule = "is a number, and its `Param` must have `low` and `high`"
        elif field.is_required():
            rule = "must have a default"
        else:
            continue
        raise ConfigError(f"`{cls.__qualname__}`: `{model.__qualname__}.{key}` {rule}")


def _check_sets(values: Mapping[str, Any], name: str) -> None:
    sizes = {k: v.shape[0] for k, v in values.items() if isinstance(v, Tensor) and v.ndim == 4}
    several = {key: size for key, size in sizes.items() if size != 1}
    if len(set(several.values())) > 1:
        found = ", ".join(f"{size} of `{key}`" for key, size in several.items())
        raise ConfigError(f"sets of parameters must be of one number, got {found} ({name})")


def batch_size_of(values: Values, given: int) -> int:
    """Return the batch that values and planes of a batch `given` broadcast to.

    Args:
        values: Values for one call.
        given: Batch of the planes.
    """
    tensors = [v for v in vars(values).values() if isinstance(v, Tensor) and v.ndim == 4]
    return max([given, *(t.shape[0] for t in tensors)])
