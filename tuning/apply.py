"""Filtering files: a frame comes in as a renderer wrote it, and the blurred image goes out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from torchblur.errors import ConfigError, OutputError, nearest_name
from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.io import ConventionOverrides, get_convention, read_frame
from torchblur.ops.gather import Engine
from torchblur.params import Config
from torchblur.presets import create_filter
from tuning.images import write_color
from tuning.outputs import Job, made_by

__all__ = [
    "FilterSettings",
    "blur_frame",
    "device_named",
    "make_filter",
    "read_job",
    "recipe_of",
    "write_job",
]

_FRAME_LAYERS = ("velocity", "depth", "normal", "object_id", "acceleration", "valid")


class FilterSettings(Config):
    """How frames are read, filtered and written."""

    filter: str = Field(description="registered name of a filter, or the path of a preset")
    params: dict[str, Any] = Field(
        default_factory=dict, description="parameters over the preset's; also shutter"
    )
    layers: tuple[str, ...] = Field(
        (), description="what to write beside color: layers of the frame or of the filter"
    )
    convention: str = Field("auto", description="whose channel names, units and signs")
    overrides: ConventionOverrides = Field(
        default_factory=ConventionOverrides, description="what differs from the convention"
    )
    on_invalid: Literal["raise", "mask"] = Field(
        "raise", description="refuse NaN and inf, or replace them"
    )
    half: bool = Field(True, description="write color as 16-bit float")
    engine: Engine = Field("eager", description="eager, or compiled taps")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1 …")


def make_filter(settings: FilterSettings) -> BlurFilter:
    """Make the filter on its device, and check the other settings.

    Raises:
        ConfigError: unknown filter, parameter or convention, value out of range, no such device.
    """
    if settings.convention != "auto":
        get_convention(settings.convention)
    blur = create_filter(settings.filter, engine=settings.engine, **settings.params)
    return blur.to(device_named(settings.device)).eval()


def device_named(name: str) -> torch.device:
    """Return a device by its name; "auto" is a GPU if there is one.

    Raises:
        ConfigError: no such device here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"`device` {name!r} cannot be used here: {reason}") from error
    return device


def recipe_of(settings: FilterSettings, blur: BlurFilter, gbuffer: bool = False) -> dict[str, Any]:
    """Return all settings that the pixels depend on, as plain data for a result's metadata.

    Args:
        settings: How it is read and written.
        blur: The filter that they make.
        gbuffer: Whether the layers come from a second file.
    """
    reading = settings.model_dump(
        mode="json", include={"layers", "convention", "on_invalid", "half"}
    )
    overrides = settings.overrides.model_dump(mode="json", exclude_unset=True)
    params = blur.current_config().model_dump(mode="json")
    return {
        "filter": blur.name,
        "params": params,
        "gbuffer": gbuffer,
        "overrides": overrides,
        **reading,
    }


def read_job(job: Job, settings: FilterSettings) -> Frame:
    """Read the frame of a job.

    Raises:
        FileFormatError: missing or damaged file, missing channel, sizes that differ.
        FrameError: NaN or inf.
    """
    overrides = settings.overrides.model_dump(exclude_unset=True)
    return read_frame(
        job.source,
        settings.convention,
        gbuffer=job.gbuffer,
        on_invalid=settings.on_invalid,
        **overrides,
    )


@torch.no_grad()
def blur_frame(
    blur: BlurFilter, frame: Frame, names: Sequence[str] = ()
) -> tuple[Tensor, dict[str, Tensor]]:
    """Filter one frame.

    Args:
        blur: The filter, on its device.
        frame: A frame of batch size 1.
        names: Layers that are wanted beside color: of the frame, or of the filter's `layers`.

    Returns:
        Color, (1, 3, H, W), and the layers by name, on the CPU.

    Raises:
        ConfigError: no such layer, or one that is not of the image's size.
    """
    moved = frame.to(next((t.device for t in _tensors(blur)), torch.device("cpu")))
    result = blur.layers(moved)
    there = {name: moved.layers()[name] for name in _FRAME_LAYERS if name in moved.layers()} | {
        name: layer for name, layer in result.items() if name != "color"
    }
    return result["color"].cpu(), {name: _layer(name, there, frame).cpu() for name in names}


def write_job(
    job: Job,
    color: Tensor,
    layers: Mapping[str, Tensor],
    *,
    settings: FilterSettings,
    recipe: Mapping[str, Any],
    overwrite: bool,
) -> None:
    """Write the result of a job with what it was made by.

    Raises:
        OutputError: it exists and `overwrite` is false, or it cannot be written.
    """
    write_color(
        job.output,
        color,
        layers=layers,
        half=settings.half,
        metadata=made_by(recipe, job.source),
        overwrite=overwrite,
    )


def _tensors(blur: BlurFilter) -> list[Tensor]:
    return [*blur.parameters(), *blur.buffers()]


def _layer(name: str, there: Mapping[str, Tensor], frame: Frame) -> Tensor:
    if name not in there:
        hint = nearest_name(name, there) or f"; there are {', '.join(there) or 'none'}"
        raise ConfigError(f"no layer `{name}` to write{hint}")
    layer = there[name]
    if tuple(layer.shape[-2:]) != frame.size:
        raise OutputError(
            f"layer `{name}` has {layer.shape[-1]}x{layer.shape[-2]} values (one per tile), and "
            f"only layers of the image's size can be written"
        )
    return layer
