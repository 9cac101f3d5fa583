"""Where files are read from and written to: one clear error, and nothing half-written."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchblur.errors import FileFormatError, OutputError

__all__ = ["input_file", "output_file"]


def input_file(path: str | Path) -> Path:
    """Return the path of a file that can be read.

    Args:
        path: A file.

    Raises:
        FileFormatError: if it does not exist, is a folder, is empty, or may not be read.
    """
    path = Path(path)
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder; a file is needed")
    if not path.exists():
        beside = path.parent if path.parent.is_dir() else _nearest_folder(path)
        where = "" if beside == path.parent else f"; the nearest folder that exists is {beside}"
        raise FileFormatError(f"{path} does not exist{where}")
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error.strerror}") from error
    if empty:
        raise FileFormatError(f"{path} is empty (0 bytes): was the program that wrote it stopped?")
    return path


@contextmanager
def output_file(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary name beside `path`; what was written there becomes `path` at the end.

    If the block fails, the temporary file is removed and what was at `path` stays as it was.

    Args:
        path: The file to be written.
        overwrite: Replace an existing file.

    Yields:
        The name to write to, in the same folder.

    Raises:
        OutputError: if the file exists and `overwrite` is false, if the folder does not exist or
            cannot be written to, or if the path is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise OutputError(f"{path} is a folder; the name of a file is needed")
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists; overwrite=True (--overwrite) replaces it")
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        temporary.open("xb").close()
    except OSError as error:
        raise OutputError(
            f"cannot write into the folder {path.parent}: {error.strerror}"
        ) from error
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _nearest_folder(path: Path) -> Path:
    return next(parent for parent in path.absolute().parents if parent.is_dir())
