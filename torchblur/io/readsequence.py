"""Consecutive frames as a `FrameSequence`, with one error for whatever does not fit."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchblur.errors import FileFormatError
from torchblur.frame import Frame, FrameSequence
from torchblur.io.frames import read_frame
from torchblur.io.sequences import FrameFiles, find_frames

__all__ = ["read_sequence"]

_ROUNDING = 1e-5  # how far beyond [0, 1] a time may be rounded


def read_sequence(
    place: str | Path | Iterable[str | Path],
    *,
    name: str = "stream",
    cuts: Iterable[int] = (),
    numbers: tuple[int, int] | None = None,
    needs: Iterable[str] | None = None,
    **options: Any,
) -> FrameSequence:
    """Read consecutive frames in the order of their numbers.

    Args:
        place: A folder with files `NAME.####.exr`, a pattern with #### ("shots/sharp.####.exr"),
            or files in their order, whose numbers may have gaps.
        name: Which of a folder's files, if `place` is one: "stream", one of several samples per
            pixel ("stream01"), "center", or the name of another sequence.
        cuts: Positions in the sequence of the frames that begin a new shot, from 0, as in
            `FrameSequence`.
        numbers: First and last frame number to be read; all if left out.
        needs: Layers beside color and velocity that every frame must have, such as a filter's
            `needs`. Left out, that is "time" for files named stream, and none for others.
        **options: As for `read_frame`: convention, layer, view, and overrides.

    Returns:
        The frames, of batch size 1 each.

    Raises:
        FileFormatError: no file fits; a number is missing in between; a frame lacks a layer, has
            another size than the first, or has times outside [0, 1]; with the file.
        FrameError: bad values, as `read_frame`; a cut outside the sequence.
        ConfigError: unknown convention or override.
    """
    files = _between(_files(place, name), numbers, place)
    if isinstance(place, str | Path):
        _check_numbers(files)
    if needs is None:
        needs = ("time",) if files[0].path.name.startswith("stream") else ()
    needs = tuple(needs)
    frames: list[Frame] = []
    for each in files:
        frame = read_frame(each, **options)
        _check_layers(frame, each.path, needs)
        if frames and frame.size != frames[0].size:
            (height, width), (rows, columns) = frame.size, frames[0].size
            raise FileFormatError(
                f"the frames of a sequence must have one size: {files[0].path} is "
                f"{columns}x{rows}, {each.path} is {width}x{height}"
            )
        frames.append(frame)
    return FrameSequence(tuple(frames), tuple(cuts))


def _files(place: str | Path | Iterable[str | Path], name: str) -> list[FrameFiles]:
    if isinstance(place, str | Path):
        place = Path(place)
        return find_frames(place / f"{name}.####.exr" if place.is_dir() else place)
    files = [file for path in place for file in find_frames(path)]
    if not files:
        raise FileFormatError("a sequence needs at least one file, got none")
    return files


def _between(
    files: list[FrameFiles], numbers: tuple[int, int] | None, place: str | Path | Iterable[Any]
) -> list[FrameFiles]:
    if numbers is None:
        return files
    first, last = numbers
    chosen = [each for each in files if first <= each.number <= last]
    if [each.number for each in chosen[:1] + chosen[-1:]] != [first, last]:
        raise FileFormatError(
            f"`numbers` asks for the frames {first} to {last}; {place} has {files[0].number} to "
            f"{files[-1].number}"
        )
    return chosen


def _check_numbers(files: list[FrameFiles]) -> None:
    for before, after in itertools.pairwise(files):
        if after.number == before.number + 1:
            continue
        first, last = before.number + 1, after.number - 1
        missing = f"frame {first} is" if first == last else f"frames {first} to {last} are"
        raise FileFormatError(
            f"a sequence must have consecutive frames: {missing} missing between "
            f"{before.path} and {after.path.name}; numbers=({files[0].number}, "
            f"{before.number}) reads what comes before"
        )


def _check_layers(frame: Frame, path: Path, needs: tuple[str, ...]) -> None:
    present = frame.layers()
    for layer in needs:
        if layer not in present:
            hint = "; needs=() reads frames that are no stream" if layer == "time" else ""
            raise FileFormatError(
                f"{path} has no layer `{layer}`; present: {', '.join(present)}{hint}"
            )
    if "time" in needs and frame.time is not None:
        low, high = float(frame.time.min()), float(frame.time.max())
        if low < -_ROUNDING or high > 1 + _ROUNDING:
            raise FileFormatError(
                f"`time` must lie in [0, 1] over the shutter, got {low:g} to {high:g} ({path}); "
                "time_start=... and time_end=... convert other times"
            )
