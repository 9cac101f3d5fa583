"""Frame numbers in the names of files: #### stands for the digits; and which files are one shot."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from torchblur.errors import ConfigError
from tuning.files.outputs import number_of

__all__ = ["frame_numbers", "numbered_file", "shots_of"]


def frame_numbers(folder: Path, pattern: str, key: str) -> list[int]:
    """Return the numbers of the files in a folder that fit a pattern, rising.

    Args:
        folder: Where they lie.
        pattern: File name with # for digits.
        key: Place in the configuration, for the message.

    Raises:
        ConfigError: if there is none.
    """
    name = re.sub(r"\\?#(\\?#)*", r"(\\d+)", re.escape(pattern))
    found = [m for f in folder.iterdir() if (m := re.fullmatch(name, f.name))]
    if not found:
        raise ConfigError(f"no file in {folder} is called {pattern} ({key})")
    return sorted(int(match[1]) for match in found)


def numbered_file(pattern: str, number: int | None) -> str:
    """Return a file name with its ####, if it has any, replaced by the number, padded."""
    if number is None:
        return pattern
    return re.sub("#+", lambda match: str(number).zfill(len(match[0])), pattern)


class _Sourced(Protocol):
    @property
    def source(self) -> Path: ...


_J = TypeVar("_J", bound=_Sourced)


def shots_of(jobs: Iterable[_J], cuts: Collection[int] = ()) -> list[list[_J]]:
    """Return jobs by shot, each in the order of its frame numbers.

    A shot is what lies in one folder under one name with consecutive numbers. It ends where a
    number is missing and before a cut. A file without a number is a shot of its own.

    Args:
        jobs: In any order.
        cuts: Frame numbers that begin a new shot.
    """
    sequences: dict[tuple[Path, str], list[tuple[int, _J]]] = {}
    for job in jobs:
        digits = number_of(job.source)
        stem = job.source.stem.removesuffix(digits or "")
        name = f"{stem}#" if digits else job.source.name
        entries = sequences.setdefault((job.source.parent, name), [])
        entries.append((int(digits or 0), job))
    return [shot for entries in sequences.values() for shot in _split(entries, cuts)]


def _split(entries: Sequence[tuple[int, _J]], cuts: Collection[int]) -> list[list[_J]]:
    shots: list[list[_J]] = []
    last: int | None = None
    for number, job in sorted(entries, key=lambda entry: entry[0]):
        if last is None or number != last + 1 or number in cuts:
            shots.append([])
        shots[-1].append(job)
        last = number
    return shots
