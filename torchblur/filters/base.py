"""What all filters share: the shutter, the Module over a function, the registry.

A filter is three things in one file: a `FilterConfig` (its parameters, each declared once), a
function of a frame and the parameters' values, and a `BlurFilter` that holds the values as
`nn.Parameter`s and calls the function. Making the class registers it by its `name`.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from torch import Tensor

from torchblur.configured import ConfiguredModule, Values, batch_size_of
from torchblur.errors import ConfigError, nearest_name
from torchblur.frame import Frame, Shutter, ShutterPosition
from torchblur.ops.gather import Engine
from torchblur.params import Config, Param

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


class BlurFilter(ConfiguredModule):
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

    config_class: ClassVar[type[FilterConfig]]
    config: FilterConfig

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            _REGISTRY[cls.name] = cls

    def __init__(
        self, config: FilterConfig | None = None, *, engine: Engine = "eager", **params: Any
    ) -> None:
        super().__init__(config, **params)
        self.engine: Engine = engine

    @property
    def shutter_setting(self) -> Shutter:
        """The shutter as the config has it."""
        return Shutter(self.config.shutter, self.config.shutter_position)

    def layers(self, frame: Frame, **overrides: Any) -> dict[str, Tensor]:
        """Return everything the filter computes, by name; "color" is the result.

        Args:
            frame: Frames to blur, B of them (or one, with a batch of parameter values).
            **overrides: Values of parameters for this call.

        Returns:
            "color" (B, 3, H, W), and what the filter adds: its class says what.
        """
        values = self.values_for(frame.color, overrides)
        batch_size = batch_size_of(values, frame.batch_size)
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
