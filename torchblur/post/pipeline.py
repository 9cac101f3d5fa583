"""The effects of a frame in one Module: blur, depth of field, anti-aliasing, bloom."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator
from torch import Tensor, nn

from torchblur.errors import ConfigError, nearest_name
from torchblur.frame import Frame
from torchblur.params import Config, Param, build
from torchblur.post.bloom import Bloom, BloomConfig
from torchblur.post.depth_of_field import DepthOfField, DepthOfFieldConfig
from torchblur.post.fxaa import Fxaa, FxaaConfig

__all__ = ["FramePipeline", "PipelineConfig", "Step"]

Step = Literal["blur", "depth_of_field", "fxaa", "bloom"]


class PipelineConfig(Config):
    """Which steps a frame goes through, in which order, and their parameters.

    The settings of a step that is not listed are checked and not used, so that a step can be
    taken out by its name alone.
    """

    steps: tuple[Step, ...] = ("blur", "depth_of_field", "fxaa", "bloom")
    """Names of the steps, first to last, each at most once."""
    depth_of_field: DepthOfFieldConfig = Field(default_factory=DepthOfFieldConfig)
    fxaa: FxaaConfig = Field(default_factory=FxaaConfig)
    bloom: BloomConfig = Field(default_factory=BloomConfig)
    fxaa_luma: Annotated[
        Literal["auto", "blur", "color"],
        Param(
            grad="discrete",
            source="Guertin 2014, section 4.5",
            meaning="luma for FXAA: the blur's, the color's, or (auto) the blur's unless another "
            "step changed the color since",
        ),
    ] = "auto"
    bloom_input: Annotated[
        Literal["auto", "color"],
        Param(
            grad="discrete",
            source="2025 notes, section on half resolution",
            meaning="bloom from the blur's half-resolution color, if it has one and bloom comes "
            "right after it (auto), or from the full color",
        ),
    ] = "auto"

    @field_validator("steps", mode="before")
    @classmethod
    def _from_list(cls, steps: Any) -> Any:
        return tuple(steps) if isinstance(steps, list) else steps

    @field_validator("steps")
    @classmethod
    def _check_steps(cls, steps: tuple[Step, ...]) -> tuple[Step, ...]:
        if not steps or len(set(steps)) < len(steps):
            raise ValueError("must name at least one step, each at most once")
        return steps


class FramePipeline(nn.Module):
    """Blur, depth of field, FXAA and bloom in any order: ``pipeline(frame) -> (B, 3, H, W)``.

    Each step takes the color that the one before it left; depth and velocity stay the frame's.
    A blur passes two things on beside its color: its "luma" layer to FXAA (true or with
    the checkerboard, as Guertin 2014 has it) and its "half_color" layer to bloom (2025 notes).

    The order of blur and depth of field is open: Guertin 2014 (section 5) blurs first, which
    also smooths the blur's noise; most engines do it second.

    Args:
        config: Steps and their parameters.
        blur: A Module that blurs a frame: ``blur(frame)``, or ``blur.layers(frame)`` with "color"
            and perhaps "luma" and "half_color". Needed exactly if "blur" is a step.

    Raises:
        ConfigError: a blur is missing, or there is one without its step.
    """

    def __init__(self, config: PipelineConfig | None = None, blur: nn.Module | None = None) -> None:
        super().__init__()
        self.config = PipelineConfig() if config is None else config
        steps = self.config.steps
        if ("blur" in steps) != (blur is not None):
            what = "no blur is given" if blur is None else f"a {type(blur).__name__} is given"
            raise ConfigError(f"`steps` are {', '.join(steps)}, and {what}")
        made: dict[str, Any] = {
            "blur": blur,
            "depth_of_field": DepthOfField(self.config.depth_of_field),
            "fxaa": Fxaa(self.config.fxaa),
            "bloom": Bloom(self.config.bloom),
        }
        self.steps = nn.ModuleDict({name: made[name] for name in steps})

    def layers(self, frame: Frame, **overrides: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return what each step makes of a frame; "color" is the result.

        Args:
            frame: Frames with what the steps need, B of them.
            **overrides: Values of parameters for this call, by step:
                ``bloom={"intensity": 0.1}``.

        Returns:
            "color" (B, 3, H, W), the color after each step by the step's name, and what else the
            steps compute as "step.layer".

        Raises:
            ConfigError: overrides for a step that is not there, or a bad value.
            FrameError: a layer is missing that a step needs.
        """
        for name in overrides:
            if name not in self.steps:
                raise ConfigError(
                    f"no step `{name}`{nearest_name(name, self.steps)}; "
                    f"steps: {', '.join(self.steps)}"
                )
        result: dict[str, Tensor] = {}
        passed: dict[str, Tensor] = {}
        for name in self.config.steps:
            made = self._run(name, frame, passed, dict(overrides.get(name, {})))
            passed = self._passed_on(name, made, passed)
            frame = _with_color(frame, made["color"])
            result |= {f"{name}.{key}": plane for key, plane in made.items() if key != "color"}
            result[name] = result["color"] = made["color"]
        return result

    def forward(self, frame: Frame, **overrides: Mapping[str, Any]) -> Tensor:
        """Return the color after the last step, (B, 3, H, W); arguments as for `layers`."""
        return self.layers(frame, **overrides)["color"]

    def get_extra_state(self) -> dict[str, Any]:
        """Return the order of the steps and the switches between them, for `state_dict`."""
        names = ("steps", "fxaa_luma", "bloom_input")
        return self.config.model_dump(mode="json", include=set(names))

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        """Take over the order and the switches, for `load_state_dict`.

        Raises:
            ConfigError: the state is of a pipeline with other steps.
        """
        steps, saved = self.config.steps, state["steps"]
        if set(saved) != set(steps):
            raise ConfigError(
                f"a state must be loaded into a pipeline of its steps, {', '.join(saved)}, "
                f"got {', '.join(steps)}"
            )
        self.config = build(type(self.config), self.config.model_dump() | dict(state))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        if state_dict:  # one that torchblur 0.1 saved has no order: that of the module stays
            state_dict = {f"{prefix}_extra_state": self.get_extra_state()} | state_dict
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _run(
        self, name: str, frame: Frame, passed: dict[str, Tensor], values: dict[str, Any]
    ) -> dict[str, Tensor]:
        step: Any = self.steps[name]
        if name == "blur":
            if hasattr(step, "layers"):
                return dict(step.layers(frame, **values))
            return {"color": step(frame, **values)}
        if name == "depth_of_field":
            return dict(step.layers(frame.color, frame.require("depth"), **values))
        beside = passed.get("luma" if name == "fxaa" else "half_color")
        return dict(step.layers(frame.color, beside, **values))

    def _passed_on(
        self, name: str, made: dict[str, Tensor], passed: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return what later steps get of the blur: after another step, its luma if asked for."""
        if name == "blur":
            wanted = {"luma": self.config.fxaa_luma != "color"}
            wanted["half_color"] = self.config.bloom_input != "color"
            return {key: made[key] for key, on in wanted.items() if on and key in made}
        if self.config.fxaa_luma == "blur" and "luma" in passed:
            return {"luma": passed["luma"]}
        return {}


def _with_color(frame: Frame, color: Tensor) -> Frame:
    """Return the frame with another color; a batch of parameter sets makes it a batch."""
    if color.shape[0] != frame.batch_size:
        frame = frame.expand(color.shape[0])
    return dataclasses.replace(frame, color=color)
