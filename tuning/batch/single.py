"""Filtering single files or a sequence, and how close that comes to a reference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from torchblur.errors import ConfigError, FrameError
from torchblur.filters import BlurFilter
from torchblur.filters.parts.base import TemporalBlur
from torchblur.frame import Frame
from torchblur.params import build
from tuning.batch.apply import (
    FilterSettings,
    blur_frame,
    blur_step,
    make_filter,
    read_samples,
    recipe_of,
    samples_beside,
    write_job,
)
from tuning.config.overrides import apply_overrides
from tuning.files.frame_numbers import shots_of
from tuning.files.images import read_color
from tuning.files.outputs import (
    Job,
    find_inputs,
    make_folders,
    name_outputs,
    numbered,
    refuse_existing,
)
from tuning.objective.engine import files_engine
from tuning.progress import Progress, Stage
from tuning.scoring.baselines import Scores, SequenceJudge, asked_name, judge, mean_scores

__all__ = ["FileJob", "filter_files", "load_settings", "plan_files"]

_SETTINGS = FilterSettings.model_fields.keys() - {"filter", "params"}


@dataclass(frozen=True)
class FileJob:
    """One file that is filtered, and compared with its reference if there is one."""

    source: Path
    output: Path | None
    gbuffer: Path | None
    reference: Path | None


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
        refuse_existing((path for _, path in named), overwrite=overwrite)
        make_folders(path for _, path in named)
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

    A filter with a memory takes the frames of a shot in the order of their numbers; it forgets
    where a number is missing, at the cuts of the settings, and where the size changes.

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
    blur.engine = files_engine(blur, [_named(job, settings) for job in jobs])
    stage = Stage(blur.name, len(jobs), progress if len(jobs) > 1 else None)
    stage.step(0)
    scores: list[dict[str, dict[str, float]]] = []
    count = 0
    has_memory = isinstance(blur, TemporalBlur)
    for shot in shots_of(jobs, settings.cuts) if has_memory else [[job] for job in jobs]:
        first = shot[0].source.name if has_memory else None
        found = _filter_shot(blur, shot, settings, shot_name=first, overwrite=overwrite)
        for job, frame_scores in found:
            scores += [] if frame_scores is None else [frame_scores]
            count += 1
            stage.step(count, message=job.source.name)
    return Scores(mean_scores(scores), asked_name(blur)) if scores else None


def _filter_shot(
    blur: BlurFilter,
    shot: Sequence[FileJob],
    settings: FilterSettings,
    *,
    shot_name: str | None,
    overwrite: bool,
) -> Iterator[tuple[FileJob, dict[str, dict[str, float]] | None]]:
    """Filter files that follow each other; yield each with its comparison."""
    history = None
    sequence = SequenceJudge(blur)
    recipe = recipe_of(settings, blur, shot[0].gbuffer is not None)
    for job in shot:
        named = _named(job, settings)
        samples = read_samples(named, settings)
        if isinstance(blur, TemporalBlur):
            color, layers, history = blur_step(blur, samples, history, settings.layers)
        else:
            color, layers = blur_frame(blur, samples[0], settings.layers)
        scores = None
        if job.reference is not None:
            reference = _reference(job.reference, samples[0])
            if history is None:
                scores = judge(blur, samples[0], color, reference)
            else:
                scores = sequence.judge(samples, color, reference)
        if job.output is not None:
            write_job(
                named,
                color,
                layers,
                settings=settings,
                recipe=recipe,
                shot=shot_name,
                overwrite=overwrite,
            )
        yield job, scores


def _named(job: FileJob, settings: FilterSettings) -> Job:
    more = samples_beside(job.source, settings)
    return Job(job.source, job.output or job.source, job.gbuffer, more)


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
