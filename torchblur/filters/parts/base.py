"""What all filters share: the shutter, and the Module over a function.

A filter is three things in one file: a `FilterConfig` (its parameters, each declared once), a
function of a frame and the parameters' values, and a `BlurFilter` that holds the values as
`nn.Parameter`s and calls the function. Making the class registers it by its `name`.
"""

from __future__ import annotations

import copy
import math
from collections import abc
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, get_args

from torch import Tensor

from torchblur.configured import ConfiguredModule, Values, batch_size_of
from torchblur.errors import ConfigError
from torchblur.filters.parts.cost import Cost
from torchblur.filters.parts.registry import register_filter
from torchblur.frame import LONGEST_SHUTTER, Frame, FrameSequence, Shutter, ShutterPosition
from torchblur.ops.compiling import EngineChoice, compiler_works, worth_compiling
from torchblur.ops.gather import Engine, Storage, stored_as
from torchblur.params import Config, Param

__all__ = ["BlurFilter", "FilterConfig", "History", "TemporalBlur", "Values", "with_shutter"]

_TAPS = 16  # of a filter that does not say how many it has


class FilterConfig(Config):
    """Parameters that every filter has."""

    shutter: Annotated[
        float,
        Param(
            symbol="E",
            unit="frame",
            low=0.0,
            high=LONGEST_SHUTTER,
            grad="weak",
            source="180 degree shutter = 0.5",
            meaning="open time of the shutter in frames; the strength of the blur",
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
        engine: "eager"; "compiled" to compile the tap function (once per structure, on the first
            call); or "auto": compiled for a `sequence` that is worth it, eager else.
        storage: "half" keeps what the taps look up in 16 bits: less memory traffic, where that is
            the limit; see `ops.gather.stored_as` for the error.
        **params: Single parameters by name, over those of `config`; `shutter` may be a `Shutter`,
            which brings its position.

    Raises:
        ConfigError: unknown name, or a value out of range.
    """

    config_class: ClassVar[type[FilterConfig]]
    config: FilterConfig
    _config_base: ClassVar[type[Config]] = FilterConfig
    published: ClassVar[bool] = True
    """Whether the defaults are those of a paper; else they are ours."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Layers without which the filter cannot run, beside color and velocity."""
    per_frame: ClassVar[tuple[str, ...] | None] = None
    """Parameters of which each value needs a frame of its own; sets of all others share what they
    can of one frame. None: all parameters."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            register_filter(cls)

    def __init__(
        self,
        config: FilterConfig | None = None,
        *,
        engine: EngineChoice = "auto",
        storage: Storage = "full",
        **params: Any,
    ) -> None:
        super().__init__(config, **with_shutter(params))
        self._engine: EngineChoice = engine
        if storage not in get_args(Storage):
            raise ConfigError(f"`storage` must be 'full' or 'half', got {storage!r}")
        self.storage: Storage = storage

    @property
    def engine(self) -> Engine:
        """The engine of a call: "eager" if it is "auto"."""
        return "eager" if self._engine == "auto" else self._engine

    @engine.setter
    def engine(self, engine: EngineChoice) -> None:
        self._engine = engine

    @property
    def shutter_setting(self) -> Shutter:
        """The shutter as it is now."""
        now = self._now()
        return Shutter(now["shutter"], now["shutter_position"])

    def values_for(self, color: Tensor, overrides: dict[str, Any] | None = None) -> Values:
        """Return the values for one call, as the base does; a `Shutter` stands for two of them."""
        return super().values_for(color, with_shutter(overrides or {}))

    @classmethod
    def cost(cls, config: Any) -> Cost:
        """Return what the filter costs per pixel; each filter counts.

        Args:
            config: Its configuration.

        Raises:
            ConfigError: the class does not say.
        """
        raise ConfigError(
            f"the cost of `{cls.name}` is not known; give its class a method cost(config) -> Cost"
        )

    def layers(self, frame: Frame, **overrides: Any) -> dict[str, Tensor]:
        """Return everything the filter computes, by name; "color" is the result.

        Args:
            frame: Frames to blur, B of them (or one, with a batch of parameter values).
            **overrides: Values of parameters for this call.

        Returns:
            "color" (B, 3, H, W), and what the filter adds: its class says what. What is the same
            for a whole batch of parameter values may have a batch of one.
        """
        frame, values = self._prepared(frame, overrides)
        with stored_as(self.storage):
            layers = self.compute(frame, values)
        return layers | {"color": _one_per_set(layers["color"], values)}

    def engine_for(self, pixels: float) -> Engine:
        """Return the engine that suits an amount of work; the given one unless it is "auto".

        Without a C++ compiler that is "eager", with one notice if compiling would be worth it.

        Args:
            pixels: Of all calls together; one with its gradient counts `GRADIENT_CALLS` times.
        """
        if self._engine != "auto":
            return self._engine
        tensors = [*self.parameters(), *self.buffers()]
        device = tensors[0].device if tensors else "cpu"
        work = pixels * getattr(self.config, "num_samples", _TAPS)
        return "compiled" if worth_compiling(work, device) and compiler_works() else "eager"

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Call the filter's function; each filter says how."""
        raise NotImplementedError  # pragma: no cover

    def forward(self, frame: Frame, **overrides: Any) -> Tensor:
        """Return the blurred color, (B, 3, H, W), scene-linear.

        Args:
            frame: Frames to blur.
            **overrides: Values of parameters for this call.
        """
        frame, values = self._prepared(frame, overrides)
        with stored_as(self.storage):
            return _one_per_set(self.color(frame, values), values)

    def color(self, frame: Frame, values: Values) -> Tensor:
        """Return "color" of `compute`; a filter may have a shorter way to it."""
        return self.compute(frame, values)["color"]

    def _prepared(self, frame: Frame, overrides: dict[str, Any]) -> tuple[Frame, Values]:
        values = self.values_for(frame.color, overrides)
        given = vars(values)
        per_frame = given if self.per_frame is None else {k: given[k] for k in self.per_frame}
        batch_size = batch_size_of(Values(**per_frame), frame.batch_size)
        return frame if batch_size == frame.batch_size else frame.expand(batch_size), values


def with_shutter(params: abc.Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters in which a `Shutter` is its open time and its position.

    Args:
        params: Values by name; `shutter` may be a `Shutter`.

    Raises:
        ConfigError: `shutter_position` is given beside it, and another.
    """
    shutter = params.get("shutter")
    if not isinstance(shutter, Shutter):
        return dict(params)
    position = params.get("shutter_position", shutter.position)
    if position != shutter.position:
        raise ConfigError(
            f"`shutter_position` must be that of the `shutter`, {shutter.position!r}, got "
            f"{position!r}; leave it out"
        )
    return {**params, "shutter": float(shutter.open), "shutter_position": position}


def _one_per_set(color: Tensor, values: Values) -> Tensor:
    """Return one color for each set of parameters, also of those that change nothing."""
    return color.expand(batch_size_of(values, color.shape[0]), -1, -1, -1)


@dataclass(frozen=True, eq=False)
class History:
    """What a filter keeps of the frames before: planes by name, (B, C, H, W) each."""

    planes: abc.Mapping[str, Tensor]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in px."""
        plane = next(iter(self.planes.values()))
        return plane.shape[2], plane.shape[3]

    @property
    def batch_size(self) -> int:
        """Number of sequences side by side."""
        return next(iter(self.planes.values())).shape[0]

    def detach(self) -> History:
        """Return the same planes, cut off from the graph: gradients stop here."""
        return History({name: plane.detach() for name, plane in self.planes.items()})


class TemporalBlur(BlurFilter):
    """A filter with a memory: ``color, history = blur(frame, history)``.

    The state is explicit: nothing is kept in the Module, so that one Module serves many
    sequences, and gradients go through time as far as the caller keeps the graph.
    """

    def step(
        self, frame: Frame | abc.Sequence[Frame], history: History | None = None, **overrides: Any
    ) -> tuple[dict[str, Tensor], History]:
        """Return everything the filter computes for one frame, and what the next one needs.

        Args:
            frame: The frame; or several of the same pixels, n samples per pixel.
            history: What the call for the frame before returned; None at the start of a shot. One
                of another size or batch is forgotten too.
            **overrides: Values of parameters for this call.
        """
        samples = (frame,) if isinstance(frame, Frame) else tuple(frame)
        values = self.values_for(samples[0].color, overrides)
        batch_size = batch_size_of(values, samples[0].batch_size)
        samples = tuple(s if s.batch_size == batch_size else s.expand(batch_size) for s in samples)
        if history is not None and (
            history.size != samples[0].size or history.batch_size != batch_size
        ):
            history = None
        with stored_as(self.storage):
            return self.advance(samples, history, values)

    def advance(
        self, samples: tuple[Frame, ...], history: History | None, values: Values
    ) -> tuple[dict[str, Tensor], History]:
        """Call the filter's function; each filter says how."""
        raise NotImplementedError  # pragma: no cover

    def compute(self, frame: Frame, values: Values) -> dict[str, Tensor]:
        """Return the layers of a frame that has no past."""
        return self.advance((frame,), None, values)[0]

    def layers(
        self, frame: Frame | abc.Sequence[Frame], history: History | None = None, **overrides: Any
    ) -> dict[str, Tensor]:
        """Return the first part of `step`: the layers, "color" among them."""
        return self.step(frame, history, **overrides)[0]

    def forward(  # type: ignore[override]
        self, frame: Frame | abc.Sequence[Frame], history: History | None = None, **overrides: Any
    ) -> tuple[Tensor, History]:
        """Return the blurred color, (B, 3, H, W), and the history; see `step`."""
        layers, history = self.step(frame, history, **overrides)
        return layers["color"], history

    def sequence(
        self, sequence: FrameSequence, *, detach_every: int | None = None, **overrides: Any
    ) -> list[Tensor]:
        """Return the blurred color of each frame, (B, 3, H, W) each; memory ends at cuts.

        Args:
            sequence: The frames in their order.
            detach_every: Let gradients go back through at most so many frames (truncated): the
                history is cut off from the graph after every k-th frame. None: all of them.
            **overrides: Values of parameters for this call.

        Raises:
            ConfigError: if `detach_every` is below 1.
        """
        if detach_every is not None and detach_every < 1:
            raise ConfigError(f"`detach_every` must be at least 1 frame, got {detach_every}")
        blur = copy.copy(self)  # shares all parameters
        blur.engine = self.engine_for(sum(f.batch_size * math.prod(f.size) for f in sequence))
        history: History | None = None
        colors = []
        for index, frame in enumerate(sequence):
            if index in sequence.cuts:
                history = None
            color, history = blur(frame, history, **overrides)
            if detach_every is not None and (index + 1) % detach_every == 0:
                history = history.detach()
            colors.append(color)
        return colors
