"""Files that belong to one shot: frames that a filter with a memory takes one after the other."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from tuning.outputs import number_of

__all__ = ["shots_of"]


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
