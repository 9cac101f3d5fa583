"""Two passes of any filter: the second closes the gaps between the taps of the first."""

from __future__ import annotations

import dataclasses
from typing import Any

from torch import Tensor, nn

from torchblur.errors import ConfigError
from torchblur.filters.base import BlurFilter, TemporalBlur, with_shutter
from torchblur.frame import Frame
from torchblur.params import Param, declared

__all__ = ["TwoPassBlur"]

_SPREAD = Param(
    low=0.0,
    high=1.0,
    grad="weak",
    source="1 / N closes the gaps",
    meaning="spread of the second pass over that of the first",
)


class TwoPassBlur(nn.Module):
    """Blur, then blur the result once more over the distance between two taps.

    N taps over the spread ±V leave gaps of about 2V / N; the same filter over ±V / N closes them,
    so that 2N lookups do nearly as well as N². The inner filter's parameters stay those of
    `blur`; fits see them as they are.

    Args:
        blur: The filter of both passes; it must have the parameter `num_samples`, or `spread`
            must be given.
        spread: Spread of the second pass over that of the first, in [0, 1]; 1 / N if left out.

    Differentiable: as the inner filter, through both passes.
    Reference: Sousa 2013, two passes. We differ: any filter will do; the spread is ours; the
        second pass lies around the pixel even where the shutter is not centered, and has its own
        noise. Velocities longer than a tile are cut in the first pass only, so that there the
        second reaches somewhat farther than the gaps.
    Raises: ConfigError for a spread out of range, none for a filter without `num_samples`, or a
        filter with a memory.

    Example:
        >>> from torchblur.filters import get_filter
        >>> TwoPassBlur(get_filter("line")(num_samples=8)).ratio
        0.125
    """

    def __init__(self, blur: BlurFilter, *, spread: float | None = None) -> None:
        super().__init__()
        if isinstance(blur, TemporalBlur):
            raise ConfigError(
                f"two passes need a filter of single frames, got `{blur.name}`, which has a memory"
            )
        if spread is not None:
            _SPREAD.check("spread", spread)
        elif not hasattr(blur.config, "num_samples"):
            raise ConfigError(f"`spread` is needed: `{blur.name}` has no `num_samples`, got None")
        self.blur = blur
        self.spread = spread

    @property
    def ratio(self) -> float:
        """Spread of the second pass over that of the first."""
        return self._ratio({})

    def _ratio(self, overrides: dict[str, Any]) -> float:
        if self.spread is not None:
            return self.spread
        taps: int = overrides.get("num_samples", getattr(self.blur.config, "num_samples", 1))
        return 1 / taps

    def layers(self, frame: Frame, **overrides: Any) -> dict[str, Tensor]:
        """Return the layers of the first pass, but "color" after both.

        Args:
            frame: Frames to blur.
            **overrides: Values of the inner filter's parameters for this call.

        Returns:
            "color" after both passes and "first_pass" after one, (B, 3, H, W), and what else the
            inner filter adds in its first pass.
        """
        overrides = with_shutter(overrides)
        first = self.blur.layers(frame, **overrides)
        color = first["color"]
        again = dataclasses.replace(frame.expand(color.shape[0]), color=color)
        second = self.blur.layers(again, **(overrides | self._second(overrides)))
        return first | {"color": second["color"], "first_pass": color}

    def _second(self, overrides: dict[str, Any]) -> dict[str, Any]:
        """Return what differs in the second pass: shutter, position, background and noise."""
        shutter = overrides.get("shutter", self.blur.shutter)
        changed = {"shutter": shutter * self._ratio(overrides), "shutter_position": "centered"}
        specs = declared(self.blur.config_class)
        if "background" in specs:  # the first pass has put the revealed layer where it belongs
            changed["background"] = "guessed"
        spec = specs.get("seed")
        if spec is not None:
            seed = overrides.get("seed", getattr(self.blur.config, "seed", 0))
            changed["seed"] = seed + 1 if seed < spec.bounds[1] else 0
        return changed

    def forward(self, frame: Frame, **overrides: Any) -> Tensor:
        """Return the color after both passes, (B, 3, H, W), scene-linear.

        Args:
            frame: Frames to blur.
            **overrides: Values of the inner filter's parameters for this call.
        """
        return self.layers(frame, **overrides)["color"]

    def extra_repr(self) -> str:
        """Show the spread, if it was given."""
        return "" if self.spread is None else f"spread={self.spread!r}"
