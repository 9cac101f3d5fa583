"""Comparing sequences with their references: means over the frames, and curves."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.frame import Shutter
from torchblur.io import read_frame
from torchblur.metrics import border_band, prepare_flip_ldr
from tuning.data.streams import shot_starts
from tuning.files.frame_numbers import frame_numbers, numbered_file
from tuning.files.images import read_color
from tuning.report.compare import Comparison, check_size, short_names
from tuning.report.sequence_plots import frame_curves
from tuning.results.fit import FrameScore, finite_or_none
from tuning.scoring.sequences import FrameByFrame

__all__ = ["compare_sequences", "is_sequence"]

Figures = Mapping[str, float]

_NAMED = 8
_FIRST = ("flip", "flip_median", "psnr", "ssim", "temporal")


def is_sequence(paths: Sequence[Path]) -> bool:
    """Return whether paths are patterns with #### for the frame number.

    Raises:
        ConfigError: if some are and some are not.
    """
    patterns = ["#" in path.name for path in paths]
    if any(patterns) and not all(patterns):
        single = paths[patterns.index(False)]
        raise ConfigError(
            f"sequences are compared with sequences: {single} has no #### for the frame number"
        )
    return all(patterns)


@torch.no_grad()
def compare_sequences(
    paths: Sequence[Path],
    reference: Path,
    *,
    frame: Path | None = None,
    convention: str = "auto",
    shutter: Shutter | None = None,
) -> Comparison:
    """Compare image files with references, frame by frame.

    The frames are those of the first sequence; a number that is missing there begins a new shot,
    and a warning names it.

    Args:
        paths: Patterns with ####, EXR or PNG.
        reference: The same.
        frame: The sharp frames with their velocity, a pattern: as in `compare_images`.
        convention: Of those frames.
        shutter: Of the references, for the band; half a frame, centered, if left out.

    Returns:
        Means over the frames. The images shown are those of the frame in which the first sequence
        is farthest from its reference.

    Raises:
        ConfigError: no file fits a pattern.
        FileFormatError: a file that is missing or cannot be read.
        FrameError: NaN or inf, or sizes that differ; with both files.
    """
    numbers = frame_numbers(paths[0].parent, paths[0].name, "IMAGE")
    _tell_missing(numbers, paths[0], reference)
    cuts = shot_starts(numbers, (), "")
    names = short_names(paths)
    rows: list[dict[str, Figures]] = []
    judges: dict[str, FrameByFrame] = {}
    for index, number in enumerate(numbers):
        target = read_color(_file(reference, number))
        images, masks = _images(names, paths, number, target, _file(reference, number)), {}
        if frame is not None:
            sharp = read_frame(_file(frame, number), convention)
            check_size(sharp.color, _file(frame, number), target, _file(reference, number))
            masks["band"] = border_band(sharp, shutter or Shutter())
            images = {"sharp": sharp.color} | images
        prepared = prepare_flip_ldr(target)
        rows.append(
            {
                name: judges.setdefault(name, FrameByFrame()).figures(
                    image, target, masks=masks, prepared=prepared, begins_shot=index in cuts
                )
                for name, image in images.items()
            }
        )
    worst = max(range(len(rows)), key=lambda index: rows[index][names[0]]["flip"])
    shown = numbers[worst]
    target = read_color(_file(reference, shown))
    return Comparison(
        reference=target,
        images=_images(names, paths, shown, target, _file(reference, shown)),
        scores={name: _means([row[name] for row in rows]) for name in rows[0]},
        shown=f"Frame {shown}, the worst of {names[0]}",
        frames=f"{len(numbers)} frame{'' if len(numbers) == 1 else 's'}",
        curves=frame_curves(
            {name: _scores(numbers, [row[name] for row in rows]) for name in rows[0]}, "frames"
        ),
    )


def _images(
    names: Sequence[str], paths: Sequence[Path], number: int, target: Tensor, place: Path
) -> dict[str, Tensor]:
    images = {}
    for name, pattern in zip(names, paths, strict=True):
        path = _file(pattern, number)
        images[name] = read_color(path)
        check_size(images[name], path, target, place)
    return images


def _tell_missing(numbers: Sequence[int], images: Path, reference: Path) -> None:
    """Warn of frames without an image: between the others, or of which there is a reference."""
    known = set(frame_numbers(reference.parent, reference.name, "--reference"))
    whole = known.union(range(numbers[0], numbers[-1] + 1))
    missing = sorted(whole - set(numbers))
    if missing:
        first = ", ".join(map(str, missing[:_NAMED]))
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        warnings.warn(
            f"{images} lacks {len(missing)} of {len(whole)} frames: {first}{more}; the figures are "
            f"those of the other {len(numbers)}",
            stacklevel=3,
        )


def _file(pattern: Path, number: int) -> Path:
    return pattern.with_name(numbered_file(pattern.name, number))


def _means(frames: Sequence[Figures]) -> dict[str, float]:
    """Return means over the frames that have a figure, those of sequences among the first."""
    keys = [*_FIRST, *(key for key in frames[0] if key not in _FIRST)]
    means = {}
    for key in keys:
        known = [row[key] for row in frames if not math.isnan(row[key])]
        means[key] = sum(known) / len(known) if known else math.nan
    return means


def _scores(numbers: Sequence[int], frames: Sequence[Figures]) -> list[FrameScore]:
    return [
        FrameScore(
            label=str(number),
            scored=True,
            scores={key: finite_or_none(value) for key, value in figures.items()},
        )
        for number, figures in zip(numbers, frames, strict=True)
    ]
