"""Pipelines of a frame from one file: a blur by name or preset, and the effects around it.

::

    blur: {filter: guertin2014, params: {kappa: 31.2}}   # or the path of a preset
    steps: [blur, depth_of_field, fxaa, bloom]
    depth_of_field: {focus_distance: 8.0}
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import field_validator

from torchblur.errors import ConfigError
from torchblur.io.yaml import load_yaml
from torchblur.ops.compiling import EngineChoice
from torchblur.params import build
from torchblur.post.pipeline import FramePipeline, PipelineConfig
from torchblur.presets import Preset, create_filter

__all__ = ["FrameConfig", "create_pipeline"]


class FrameConfig(PipelineConfig):
    """A `PipelineConfig` that says which blur, too."""

    blur: Preset | None = None
    """The blur; a text alone is its name or the path of a preset. Needed if "blur" is a step."""

    @field_validator("blur", mode="before")
    @classmethod
    def _from_name(cls, blur: Any) -> Any:
        return {"filter": blur} if isinstance(blur, str) else blur


def create_pipeline(
    config: FrameConfig | Mapping[str, Any] | str | Path, *, engine: EngineChoice = "auto"
) -> FramePipeline:
    """Make the pipeline of a frame from its config.

    Args:
        config: The config, its data, or the path of a YAML file. Paths of presets in a file are
            relative to the file.
        engine: Of the blur: "auto", "eager" or "compiled"; see `BlurFilter`.

    Returns:
        A Module: ``pipeline(frame) -> (B, 3, H, W)``.

    Raises:
        ConfigError: unknown key, step, filter or parameter, value out of range, or a step "blur"
            without a blur.
        FileFormatError: no such file.
    """
    place, folder = "", Path()
    if isinstance(config, str | Path):
        place, folder = str(config), Path(config).parent
        config = load_yaml(config)
    if not isinstance(config, FrameConfig):
        config = build(FrameConfig, config, place)
    try:
        blur = None
        if config.blur is not None:
            name: str | Path = config.blur.filter
            if Path(name).suffix:
                name = folder / name
            blur = create_filter(name, engine=engine, **config.blur.params)
        return FramePipeline(config, blur if "blur" in config.steps else None)
    except ConfigError as error:
        raise ConfigError(f"{error} ({place})" if place else str(error)) from error
