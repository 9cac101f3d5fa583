"""Filtering single files or a sequence, and how close that comes to a reference."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchblur.errors import ConfigError, FrameError, OutputError
from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.metrics import border_band, evaluate
from torchblur.params import build
from torchblur.presets import create_filter
from tuning.apply import FilterSettings, blur_frame, make_filter, read_job, recipe_of, write_job
from tuning.config import apply_overrides
from tuning.images import read_color
from tuning.outputs import Job, find_inputs, make_folders, name_outputs, numbered
from tuning.progress import Progress, Stage

__all__ = [
    "BASELINES",
    "FileJob",
    "Scores",
    "asked_name",
    "filter_files",
    "judge",
    "load_settings",
    "mean_scores",
    "plan_files",
]

BASELINES = ("line", "mcguire2012", "guertin2014")
"""Filters that a result is compared with, at their papers' settings."""

_SETTINGS = FilterSettings.model_fields.keys() - {"filter", "params"}


@dataclass(frozen=True)
class FileJob:
    """One file that is filtered, and compared with its reference if there is one."""

    source: Path
    output: Path | None
    gbuffer: Path | None
    reference: Path | None


@dataclass(frozen=True)
class Scores:
    """How close filters come to the references, mean over the frames.

    Args:
        by_name: What `judge` returns.
        asked: Name of the filter that was asked for.
    """

    by_name: Mapping[str, Mapping[str, float]]
    asked: str


def load_settings(name: str, overrides: Sequence[str], convention: str = "auto") -> FilterSettings:
    """Return the settings that a command line gives, and check the parameters.

    Args:
        name: A filter or the path of a preset.
        overrides: "key=value" in YAML. Keys are the filter's parameters, and the other fields of
            `FilterSettings`: "overrides.velocity_scale=2", "on_invalid=mask", "layers=[luma]".
        convention: Whose channel names and units.

    Raises:
        ConfigError: unknown filter, parameter or convention, value out of range.
    """
    given = apply_overrides({}, overrides)
    fields = {key: value for key, value in given.items() if key in _SETTINGS}
    params = {key: value for key, value in given.items() if key not in _SETTINGS}
    data = {"convention": convention} | fields | {"filter": name, "params": params}
    settings = build(FilterSettings, data, "--set")
    make_filter(settings)
    return settings


def plan_files(
    inputs: Sequence[str],
    output: str | None,
    *,
    gbuffer: str | None = None,
    reference: str | None = None,
    overwrite: bool = False,
) -> list[FileJob]:
    """Name the files of a `torchblur filter` command, before any work is done.

    Args:
        inputs: Files, folders, patterns.
        output: A file, folder or pattern; nothing is written if left out.
        gbuffer: Second file, or a pattern with ####.
        reference: File with true motion blur, or a pattern with ####.
        overwrite: Whether outputs may exist.

    Raises:
        ConfigError: neither output nor reference; or several inputs with one reference.
        FileFormatError: no such input.
        OutputError: an output exists, or several inputs have one output.
    """
    if output is None and reference is None:
        raise ConfigError("nothing to do: give -o OUT, --reference REF, or both")
    sources = find_inputs(inputs)
    pairs: list[tuple[Path, Path | None]] = [(source, None) for source in sources]
    if output is not None:
        named = name_outputs(sources, output)
        existing = [path for _, path in named if path.exists()]
        if existing and not overwrite:
            raise OutputError(f"{existing[0]} exists; overwrite=True (--overwrite) replaces it")
        make_folders([path for _, path in named])
        pairs = list(named)
    beside = {"gbuffer": gbuffer, "reference": reference}
    return [
        FileJob(
            source=source,
            output=path,
            **{
                key: None if text is None else Path(_beside(key, text, source, len(pairs)))
                for key, text in beside.items()
            },
        )
        for source, path in pairs
    ]


def filter_files(
    settings: FilterSettings,
    jobs: Sequence[FileJob],
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Scores | None:
    """Filter files one after the other, and compare the results with their references.

    Args:
        settings: Filter, parameters, convention.
        jobs: What `plan_files` returned.
        overwrite: Replace existing files.
        progress: Told after each file.

    Returns:
        The comparison, or None if there are no references.

    Raises:
        TorchblurError: the first file that cannot be read, filtered or written.
    """
    blur = make_filter(settings)
    stage = Stage(blur.name, len(jobs), progress if len(jobs) > 1 else None)
    stage.step(0)
    scores = []
    for done, job in enumerate(jobs, start=1):
        frame = read_job(Job(job.source, job.source, job.gbuffer), settings)
        color, layers = blur_frame(blur, frame, settings.layers)
        if job.reference is not None:
            reference = _reference(job.reference, frame)
            scores.append(judge(blur, frame, color, reference))
        if job.output is not None:
            recipe = recipe_of(settings, blur, job.gbuffer is not None)
            named = Job(job.source, job.output, job.gbuffer)
            write_job(named, color, layers, settings=settings, recipe=recipe, overwrite=overwrite)
        stage.step(done, message=job.source.name)
    return Scores(mean_scores(scores), asked_name(blur)) if scores else None


def _beside(key: str, pattern: str, source: Path, count: int) -> str:
    if count > 1 and "#" not in pattern:
        raise ConfigError(
            f"`--{key}` must have #### for the frame number, as there are {count} inputs, "
            f"got {pattern}"
        )
    return numbered(pattern, source)


def _reference(path: Path, frame: Frame) -> Tensor:
    image = read_color(path)
    if tuple(image.shape[-2:]) != frame.size:
        raise FrameError(
            f"reference and frame must have one size: {path} is {image.shape[-1]}x"
            f"{image.shape[-2]}, {frame.source} is {frame.size[1]}x{frame.size[0]}"
        )
    return image


# -- evidence ----------------------------------------------------------------------------------


@torch.no_grad()
def judge(
    blur: BlurFilter, frame: Frame, color: Tensor, reference: Tensor
) -> dict[str, dict[str, float]]:
    """Compare a result, the sharp frame and the baselines with a reference.

    All filters get the shutter of the asked one; the rest of a baseline is its paper's.

    Args:
        blur: The filter that was asked for.
        frame: The frame, batch size 1, on the CPU.
        color: Its result, (1, 3, H, W).
        reference: The frame with true motion blur, (1, 3, H, W).

    Returns:
        By name, what `evaluate` returns over the image and over "band", the pixels that moving
        borders sweep. The asked filter stands under its name, with "(asked)" if it is a baseline
        with other settings. A baseline that needs a layer which the frame lacks is left out, with
        a warning.

    Raises:
        FrameError: sizes that differ.
    """
    band = {"band": border_band(frame, blur.shutter_setting)}
    asked = asked_name(blur)
    images = {"sharp": frame.color}
    for name in BASELINES:
        try:
            images[name] = color if name == asked else _with_shutter_of(blur, name)(frame)
        except FrameError as error:
            warnings.warn(f"{name} is left out of the comparison: {error}", stacklevel=2)
    images.setdefault(asked, color)
    return {
        name: {k: float(v) for k, v in evaluate(image, reference, masks=band).items()}
        for name, image in images.items()
    }


def asked_name(blur: BlurFilter) -> str:
    """Return the name under which `judge` lists the asked filter."""
    is_plain = _with_shutter_of(blur, blur.name).config == blur.current_config()
    return blur.name if is_plain or blur.name not in BASELINES else f"{blur.name} (asked)"


def mean_scores(scores: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the mean over frames of what `judge` returned; frames with an empty band don't count.

    Args:
        scores: One entry per frame; names that not all of them have are left out.
    """
    return {
        name: {key: _mean([frame[name][key] for frame in scores]) for key in scores[0][name]}
        for name in scores[0]
        if all(name in frame for frame in scores)
    }


def _with_shutter_of(blur: BlurFilter, name: str) -> BlurFilter:
    config = blur.config
    return create_filter(name, shutter=config.shutter, shutter_position=config.shutter_position)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
