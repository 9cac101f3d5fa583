"""One filter under test: what is special about it, and how the contract runs it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.params import declared
from torchblur.testing.frames import as_stream

__all__ = ["FilterCase"]

_LONG_PATHS: dict[str, Any] = {"tile_size": 100, "shutter": 8.0, "num_samples": 2}
_REACH: dict[str, dict[str, Any]] = {
    "reach": {"tile_size": 2},
    "tap_spacing": _LONG_PATHS,
    "max_samples": _LONG_PATHS | {"tap_spacing": 0.5},
}
"""Under what the parameters of the reach act, in filters that have it."""


class FilterCase:
    """What the contract needs to know of a filter, and how it runs it."""

    filter_class: ClassVar[type[BlurFilter]]
    function: ClassVar[Callable[..., Tensor]]
    plain: ClassVar[dict[str, Any]] = {}
    """Parameters that take the noise out, under which the symmetries hold exactly."""
    acts_with: ClassVar[dict[str, dict[str, Any]]] = {}
    """Per parameter: what else must be set for it to act at all."""
    inert: ClassVar[tuple[str, ...]] = ()
    """Parameters of all filters that change nothing in this one."""
    one_structure: ClassVar[dict[str, Any]] = {}
    """For compiled taps: switches that make one kernel, whatever the frame, or a small one."""
    box_tolerance: ClassVar[float] = 0.02
    """Largest mean difference to a box blur under uniform motion, color in [0, 1]."""

    def blur(self, **params: Any) -> BlurFilter:
        """Return the filter with its `plain` parameters and some others."""
        return self.filter_class(**(self.plain | params))

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "filter_class" in cls.__dict__ and "max_reach" in declared(
            cls.filter_class.config_class
        ):
            cls.acts_with = _REACH | cls.acts_with
            cls.inert = (*cls.inert, "max_reach")  # no motion of the frames here is as long

    # -- hooks for filters that need more than color, velocity and depth -----------------------

    def given(self, frame: Frame) -> Frame:
        """Return a frame with the layers that the filter needs."""
        return as_stream(frame) if "time" in self.filter_class.needs else frame

    def outcome(self, blur: BlurFilter, frame: Frame, **overrides: Any) -> dict[str, Tensor]:
        """Return the layers that are looked at; a filter with a memory may run twice."""
        return blur.layers(frame, **overrides)

    def image(self, blur: BlurFilter, frame: Frame, **overrides: Any) -> Tensor:
        """Return the color of `outcome`."""
        return self.outcome(blur, frame, **overrides)["color"]

    def by_function(self, frame: Frame, config: Any = None, **params: Any) -> Tensor:
        """Return the color that the filter's function gives."""
        return self.function(frame, config=config, **params)

    def backwards(self, frame: Frame) -> Frame:
        """Return what moves the other way, and is to blur into the same image."""
        return dataclasses.replace(frame, velocity=-frame.velocity)

    def long_reach(self) -> dict[str, Any]:
        """Return the parameters under which a blur of 12 px is not cut short."""
        return {"tile_size": 40} if "tile_size" in declared(self.filter_class.config_class) else {}

    def tiles_of_10(self) -> dict[str, Any]:
        """Return a tile size of 10, if the filter has tiles."""
        return {"tile_size": 10} if "tile_size" in declared(self.filter_class.config_class) else {}

    def as_function_of(
        self, blur: BlurFilter, frame: Frame, name: str
    ) -> Callable[[Tensor], Tensor]:
        """Return the image as a function of one parameter."""
        return lambda value: self.image(blur, frame, **{name: value})

    def few_taps(self) -> dict[str, Any]:
        """Return a number of taps that keeps gradcheck quick."""
        return {"num_samples": 7} | self.tiles_of_10()
