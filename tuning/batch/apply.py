"""Filtering files: a frame comes in as a renderer wrote it, and the blurred image goes out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from torchblur.errors import ConfigError, FileFormatError, OutputError, nearest_name
from torchblur.filters import BlurFilter
from torchblur.filters.parts.base import History, TemporalBlur
from torchblur.frame import Frame
from torchblur.io import ConventionOverrides, get_convention, read_frame
from torchblur.ops.compiling import EngineChoice
from torchblur.params import Config
from torchblur.presets import create_filter
from tuning.files.images import write_color
from tuning.files.outputs import Job, made_by, numbered

__all__ = [
    "FilterSettings",
    "blur_frame",
    "blur_step",
    "device_named",
    "make_filter",
    "read_job",
    "read_samples",
    "recipe_of",
    "samples_beside",
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
    cuts: tuple[int, ...] = Field(
        (), description="frame numbers that begin a new shot, for filters with a memory"
    )
    samples: tuple[str, ...] = Field(
        (),
        description="files beside each input with more samples of its pixels, for filters with a "
        "memory: stream02.####.exr",
    )
    half: bool = Field(True, description="write color as 16-bit float")
    engine: EngineChoice = Field(
        "auto", description="eager, compiled, or auto: compiled if there is so much to do"
    )
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1 …")


def make_filter(settings: FilterSettings) -> BlurFilter:
    """Make the filter on its device, and check the other settings.

    Raises:
        ConfigError: unknown filter, parameter or convention, value out of range, no such device.
    """
    if settings.convention != "auto":
        get_convention(settings.convention)
    blur = create_filter(settings.filter, engine=settings.engine, **settings.params)
    if settings.samples and not isinstance(blur, TemporalBlur):
        raise ConfigError(
            f"`samples` are for filters that take several samples per pixel, and {blur.name} takes "
            f"one; got {', '.join(settings.samples)}"
        )
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
    recipe = {
        "filter": blur.name,
        "params": params,
        "gbuffer": gbuffer,
        "overrides": overrides,
        **reading,
    }
    return recipe | ({"samples": list(settings.samples)} if settings.samples else {})


def read_job(job: Job, settings: FilterSettings) -> Frame:
    """Read the frame of a job.

    Raises:
        FileFormatError: missing or damaged file, missing channel, sizes that differ.
        FrameError: NaN or inf.
    """
    return _read(job.source, job.gbuffer, settings)


def read_samples(job: Job, settings: FilterSettings) -> tuple[Frame, ...]:
    """Read the frame of a job, and the other samples of its pixels if it has any.

    Raises:
        FileFormatError: as `read_job`; samples of another size.
        FrameError: as `read_job`.
    """
    first = read_job(job, settings)
    others = tuple(_read(path, None, settings) for path in job.samples)
    for path, frame in zip(job.samples, others, strict=True):
        if frame.size != first.size:
            raise FileFormatError(
                f"the samples of a frame must have one size: {job.source} is {first.size[1]}x"
                f"{first.size[0]}, {path} is {frame.size[1]}x{frame.size[0]}"
            )
    return (first, *others)


def samples_beside(source: Path, settings: FilterSettings) -> tuple[Path, ...]:
    """Return the files with more samples of a frame.

    Raises:
        ConfigError: #### in a pattern, and no frame number in the name of the frame.
    """
    return tuple(source.parent / numbered(pattern, source) for pattern in settings.samples)


def _read(path: Path, gbuffer: Path | None, settings: FilterSettings) -> Frame:
    overrides = settings.overrides.model_dump(exclude_unset=True)
    return read_frame(
        path, settings.convention, gbuffer=gbuffer, on_invalid=settings.on_invalid, **overrides
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
    moved = frame.to(_device_of(blur))
    return _picked(blur.layers(moved), moved, names)


@torch.no_grad()
def blur_step(
    blur: TemporalBlur, samples: Sequence[Frame], history: History | None, names: Sequence[str] = ()
) -> tuple[Tensor, dict[str, Tensor], History]:
    """Filter one frame with what is remembered of those before it.

    Args:
        blur: The filter, on its device.
        samples: The frame, or several of the same pixels; of batch size 1.
        history: What the call for the frame before returned; None at the start of a shot.
        names: As in `blur_frame`; layers of a frame are those of the first sample.

    Returns:
        Color, (1, 3, H, W), and the layers by name, on the CPU; and the history for the next.

    Raises:
        ConfigError: as `blur_frame`.
        FrameError: a layer that the filter needs is missing.
    """
    moved = [frame.to(_device_of(blur)) for frame in samples]
    result, history = blur.step(moved, history)
    return (*_picked(result, moved[0], names), history)


def write_job(
    job: Job,
    color: Tensor,
    layers: Mapping[str, Tensor],
    *,
    settings: FilterSettings,
    recipe: Mapping[str, Any],
    overwrite: bool,
    shot: str | None = None,
) -> None:
    """Write the result of a job with what it was made by.

    Args:
        job: The frame and its output.
        color: Scene-linear radiance, (1, 3, H, W).
        layers: More layers by name.
        settings: How it is written.
        recipe: What `recipe_of` returned.
        overwrite: Replace an existing file.
        shot: Name of the first frame of its shot, for a filter with a memory.

    Raises:
        OutputError: it exists and `overwrite` is false, or it cannot be written.
    """
    write_color(
        job.output,
        color,
        layers=layers,
        half=settings.half,
        metadata=made_by(recipe, job.source, shot),
        overwrite=overwrite,
    )


def _device_of(blur: BlurFilter) -> torch.device:
    tensors = [*blur.parameters(), *blur.buffers()]
    return tensors[0].device if tensors else torch.device("cpu")


def _picked(
    result: Mapping[str, Tensor], frame: Frame, names: Sequence[str]
) -> tuple[Tensor, dict[str, Tensor]]:
    there = {name: frame.layers()[name] for name in _FRAME_LAYERS if name in frame.layers()} | {
        name: layer for name, layer in result.items() if name != "color"
    }
    return result["color"].cpu(), {name: _layer(name, there, frame).cpu() for name in names}


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
