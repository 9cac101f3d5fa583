"""What all filters share: the shutter, the Module over a function, the registry.

A filter is three things in one file: a `FilterConfig` (its parameters, each declared once), a
function of a frame and the parameters' values, and a `BlurFilter` that holds the values as
`nn.Parameter`s and calls the function. Making the class registers it by its `name`.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor, nn

from torchblur.errors import ConfigError, nearest_name
from torchblur.frame import Frame, Shutter, ShutterPosition
from torchblur.ops.gather import Engine
from torchblur.params import Config, Param, build, declared

__all__ = ["BlurFilter", "FilterConfig", "Values", "get_filter", "registered_filters"]

_REGISTRY: dict[str, type[BlurFilter]] = {}


class FilterConfig(Config):
    """Parameters that every filter has."""

    shutter: Annotated[
        float,
        Param(
            symbol="E",
            unit="frame",
            low=0.0,
            high=2.0,
            grad="weak",
            source="180 degree shutter = 0.5",
            meaning="open time of the shutter as a fraction of a frame; the strength of the blur",
        ),
    ] = 0.5
    shutter_position: Annotated[
        ShutterPosition,
        Param(
            grad="discrete",
            source="torchblur",
            meaning="open around the frame's time, after it (leading) or before it (trailing)",
        ),
    ] = "centered"


class Values(SimpleNamespace):
    """Values of a filter's parameters: tensors that broadcast to (B, 1, H, W), or choices."""


class BlurFilter(nn.Module):
    """A motion-blur filter as a Module: `blur(frame) -> (B, 3, H, W)`.

    Smooth parameters are `nn.Parameter`s, weak ones are buffers; both are 0-d tensors named as
    in the config. Switches and integers stay in `config`. Any number can be replaced for one
    call by a tensor that broadcasts to (B, 1, H, W): ``blur(frame, kappa=torch.rand(32,1,1,1))``
    evaluates 32 values of κ at once, and a network may predict one per pixel.

    Args:
        config: The parameters; the paper's if left out.
        engine: "eager", or "compiled" to compile the tap function (once, on the first call).
        **params: Single parameters by name, over those of `config`.

    Raises:
        ConfigError: unknown name, or a value out of range.
    """

    name: ClassVar[str]
    config_class: ClassVar[type[FilterConfig]]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            _REGISTRY[cls.name] = cls

    def __init__(
        self, config: FilterConfig | None = None, *, engine: Engine = "eager", **params: Any
    ) -> None:
        super().__init__()
        start = {} if config is None else config.model_dump()
        self.config = build(self.config_class, start | params, place=self.name)
        self.engine: Engine = engine
        for key, spec in declared(self.config_class).items():
            value = getattr(self.config, key)
            if spec.grad == "smooth":
                self.register_parameter(key, nn.Parameter(torch.tensor(float(value))))
            elif spec.grad == "weak":
                self.register_buffer(key, torch.tensor(float(value)))

    @property
    def shutter_setting(self) -> Shutter:
        """The shutter as the config has it."""
        return Shutter(self.config.shutter, self.config.shutter_position)

    def current_config(self) -> FilterConfig:
        """Return the config with the present values of the parameters, after a fit say.

        Raises:
            ConfigError: if a parameter has left its range; `project_` brings it back.
        """
        now = {
            key: float(getattr(self, key).detach())
            for key, spec in declared(self.config_class).items()
            if spec.grad != "discrete"
        }
        return build(self.config_class, self.config.model_dump() | now, place=self.name)

    @torch.no_grad()
    def project_(self) -> BlurFilter:
        """Move each number back into its range, in place; for use after an optimizer's step."""
        for key, spec in declared(self.config_class).items():
            if spec.grad != "discrete":
                getattr(self, key).clamp_(*spec.bounds)
        return self

    def values(self, frame: Frame, overrides: dict[str, Any] | None = None) -> Values:
        """Return the values for one call, in the frame's type and on its device.

        Args:
            frame: The frame that will be filtered.
            overrides: Numbers, tensors that broadcast to (B, 1, H, W), or choices, by name.

        Raises:
            ConfigError: unknown name, value out of range, or a tensor that does not broadcast.
        """
        specs = declared(self.config_class)
        values = {key: getattr(self, key, None) for key in specs}
        values |= {k: getattr(self.config, k) for k, s in specs.items() if s.grad == "discrete"}
        for key, value in (overrides or {}).items():
            values[key] = self._override(key, value, frame)
        for key, value in values.items():
            if isinstance(value, Tensor):
                values[key] = value.to(device=frame.device, dtype=frame.dtype)
        return Values(**values)

    def _override(self, key: str, value: Any, frame: Frame) -> Any:
        specs = declared(self.config_class)
        if key not in specs:
            raise ConfigError(f"unknown parameter `{key}`{nearest_name(key, specs)} ({self.name})")
        if specs[key].grad == "discrete":
            return getattr(build(self.config_class, {key: value}, place=self.name), key)
        value = torch.as_tensor(value)
        specs[key].check(key, value)
        try:
            shape = torch.broadcast_shapes(value.shape, (frame.batch_size, 1, *frame.size))
        except RuntimeError:
            shape = ()
        if len(shape) != 4 or shape[1] != 1:
            raise ConfigError(
                f"`{key}` must broadcast to (B, 1, H, W) = "
                f"{(frame.batch_size, 1, *frame.size)}, got shape {tuple(value.shape)}"
            )
        return value

    def layers(self, frame: Frame, **overrides: Any) -> dict[str, Tensor]:
        """Return everything the filter computes, by name; "color" is the result.

        Args:
            frame: Frames to blur, B of them (or one, with a batch of parameter values).
            **overrides: Values of parameters for this call.

        Returns:
            "color" (B, 3, H, W), and what the filter adds: its class says what.
        """
        values = self.values(frame, overrides)
        sizes = {v.shape[0] for v in vars(values).values() if isinstance(v, Tensor) and v.ndim == 4}
        batch_size = max(sizes | {frame.batch_size})
        if batch_size != frame.batch_size:
            frame = frame.expand(batch_size)
        return self.compute(frame, values)

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Call the filter's function; each filter says how."""
        raise NotImplementedError  # pragma: no cover

    def forward(self, frame: Frame, **overrides: Any) -> Tensor:
        """Return the blurred color, (B, 3, H, W), scene-linear.

        Args:
            frame: Frames to blur.
            **overrides: Values of parameters for this call.
        """
        return self.layers(frame, **overrides)["color"]

    def extra_repr(self) -> str:
        """Show the parameters that differ from the defaults, so that `repr` evaluates back."""
        default = self.config_class()
        changed = {k: v for k, v in self.config.model_dump().items() if v != getattr(default, k)}
        return ", ".join(f"{key}={value!r}" for key, value in changed.items())


def registered_filters() -> dict[str, type[BlurFilter]]:
    """Return the filters by name."""
    return dict(sorted(_REGISTRY.items()))


def get_filter(name: str) -> type[BlurFilter]:
    """Return a filter's class by its registered name.

    Raises:
        ConfigError: if there is none; names the nearest.
    """
    if name not in _REGISTRY:
        raise ConfigError(
            f"unknown filter `{name}`{nearest_name(name, _REGISTRY)}; "
            f"filters: {', '.join(sorted(_REGISTRY))}"
        )
    return _REGISTRY[name]
