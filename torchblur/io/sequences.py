"""Frames on disk: which files belong together, and in which order."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from torchblur.errors import FileFormatError

__all__ = ["FrameFiles", "find_frames"]

_COMPANIONS = (
    "center",
    "gbuffer",
    "reference",
    "reference_pointsampled",
    "revealed",
    "revealed_gbuffer",
)
_PREFIXES = ("gbuffer", "reference", "revealed")
_STREAM = re.compile(r"stream\d*")
_NUMBERED = re.compile(r"^(?P<stem>.*?)(?P<separator>[._-]?)(?P<number>\d+)\.exr$", re.IGNORECASE)
_PLACEHOLDER = re.compile(r"#+|%0?\d*d|\*")


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame.

    Args:
        number: Frame number; position from 1 where the names have no number.
        path: The sharp color, usually with all layers.
        gbuffer: Layers from one sample at the pixel center (`gbuffer.####.exr`), if there.
        reference: The frame with true motion blur (`reference.####.exr`), if there.
        revealed: What lies behind the moving objects (`revealed.####.exr`), if there.
        revealed_gbuffer: Its point-sampled layers (`revealed_gbuffer.####.exr`), if there.
        center: The frame as one sample at each pixel's center sees it (`center.####.exr`).
        reference_pointsampled: The mean over the shutter at each pixel's center
            (`reference_pointsampled.####.exr`): what a stream converges to.
        streams: Each pixel at a random time of its own: `stream.####.exr` with one sample per
            pixel, or `stream01.####.exr`, `stream02.####.exr` … of several.
    """

    number: int
    path: Path
    gbuffer: Path | None = None
    reference: Path | None = None
    revealed: Path | None = None
    revealed_gbuffer: Path | None = None
    center: Path | None = None
    reference_pointsampled: Path | None = None
    streams: tuple[Path, ...] = ()


def find_frames(place: str | Path) -> list[FrameFiles]:
    """Return the frames of a folder or a pattern, in the order of their numbers.

    Args:
        place: A folder; a pattern `folder/NAME.####.exr` (also `%04d` or `*`); or one file.
            A folder may hold one sequence (or one frame) beside its companions, which
            `FrameFiles` lists; of several, `sharp` is taken. Where there are companions alone,
            it is `center`, or else the stream: a sharp frame comes before a noisy one, and
            ``folder/stream.####.exr`` names the stream.

    Returns:
        One entry per frame; 2 comes before 10 whatever the padding.

    Raises:
        FileFormatError: if nothing fits, if a folder holds several sequences, or if two files
            have the same number.
    """
    place = Path(place)
    if place.is_dir():
        paths = _main_sequence(place)
    elif _PLACEHOLDER.search(place.name):
        paths = [path for path in _exr_files(place.parent) if _fits(place.name, path.name)]
    else:
        paths = [place] if place.is_file() else []
    if not paths:
        raise FileFormatError(f"no frames fit {place}; {_contents(place)}")
    return _in_order(paths)


def _exr_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return [p for p in folder.iterdir() if p.suffix.lower() == ".exr" and p.name[0] != "."]


def _fits(pattern: str, name: str) -> bool:
    """Whether a name fits a pattern whose #### and %04d stand for digits and * for anything."""
    expression, end = "", 0
    for match in _PLACEHOLDER.finditer(pattern):
        expression += re.escape(pattern[end : match.start()])
        expression += ".*" if match.group() == "*" else r"\d+"
        end = match.end()
    return re.fullmatch(expression + re.escape(pattern[end:]), name) is not None


def _main_sequence(folder: Path) -> list[Path]:
    groups: dict[str, list[Path]] = {}
    for path in _exr_files(folder):
        groups.setdefault(_stem(path), []).append(path)
    names = [name for name in groups if not _is_companion(name)]
    if "sharp" in names:
        return groups["sharp"]
    if not names:
        names = [name for name in ("center", *_stream_names(groups)) if name in groups][:1]
    if len(names) > 1 and not any(_number(path) is None for n in names for path in groups[n]):
        raise FileFormatError(
            f"{folder} holds several sequences: {', '.join(sorted(names))}; name one: "
            f"{folder / sorted(names)[0]}.####.exr"
        )
    return [path for name in names for path in groups[name]]


def _in_order(paths: Iterable[Path]) -> list[FrameFiles]:
    ordered = sorted(paths, key=_natural)
    numbers = [_number(path) for path in ordered]
    stems = {_stem(path) for path in ordered}
    if None in numbers or len(stems) > 1:
        return [_with_companions(i, path) for i, path in enumerate(ordered, start=1)]
    by_number: dict[int, Path] = {}
    for number, path in zip(numbers, ordered, strict=True):
        if number in by_number:
            raise FileFormatError(f"two files have number {number}: {by_number[number]}, {path}")
        by_number[int(number or 0)] = path
    return [_with_companions(number, by_number[number]) for number in sorted(by_number)]


def _is_companion(name: str) -> bool:
    return name.startswith(_PREFIXES) or name == "center" or bool(_STREAM.fullmatch(name))


def _with_companions(number: int, path: Path) -> FrameFiles:
    own, digits = _stem(path), _number(path)
    beside = {_stem(p): p for p in _exr_files(path.parent) if _number(p) == digits}
    found = {name: beside[name] for name in _COMPANIONS if name in beside and name != own}
    if _STREAM.fullmatch(own):  # what its pixels show is of other times than a G-buffer's
        for name in ("gbuffer", "revealed", "revealed_gbuffer"):
            found.pop(name, None)
    streams = tuple(beside[name] for name in _stream_names(beside))
    return FrameFiles(number=number, path=path, streams=streams, **found)


def _stream_names(names: Iterable[str]) -> list[str]:
    """Return the names of streams in the order of their samples; `stream` alone counts for 1."""
    found = sorted(filter(_STREAM.fullmatch, names), key=lambda name: (len(name), name))
    return [name for name in found if name != "stream"] or found


def _stem(path: Path) -> str:
    match = _NUMBERED.match(path.name)
    return match["stem"] if match else path.stem


def _number(path: Path) -> int | None:
    match = _NUMBERED.match(path.name)
    return int(match["number"]) if match else None


def _natural(path: Path) -> list[tuple[int, int | str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]


def _contents(place: Path) -> str:
    folder = place if place.is_dir() else place.parent
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    names = sorted(path.name for path in _exr_files(folder))
    if not names:
        return f"{folder} holds no .exr file"
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{folder} holds {', '.join(names[:5])}{more}"
