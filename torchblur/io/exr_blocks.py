"""Whether all blocks of an OpenEXR file are there, told from its table of offsets."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

from torchblur.errors import FileFormatError

__all__ = ["check_complete"]

# Bits of the version field
_TILED = 0x200
_DEEP = 0x800
_MULTIPART = 0x1000


def check_complete(path: Path) -> None:
    """Refuse a file that ends before its last block of pixels.

    OpenEXR would print about it and go on; this says it as an error, before.

    Args:
        path: A file that begins as an OpenEXR file does.

    Raises:
        FileFormatError: if it is truncated.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        try:
            flags = struct.unpack("<4xI", file.read(8))[0]
            _skip_headers(file, multipart=bool(flags & _MULTIPART))
            last = _last_block(file)
            end = _end_of_block(file, last, flags)
        except (struct.error, EOFError):
            end = size + 1
    if end > size:
        raise FileFormatError(
            f"{path} is truncated: it ends after {size} bytes, before its last block of pixels; "
            "was the render or the copy interrupted?"
        )


def _skip_headers(file: BinaryIO, *, multipart: bool) -> None:
    while True:
        name = _text(file)
        if not name and not (multipart and (name := _text(file))):
            return
        _text(file)
        file.seek(struct.unpack("<i", file.read(4))[0], os.SEEK_CUR)


def _text(file: BinaryIO) -> bytes:
    text = b""
    while (byte := file.read(1)) != b"\0":
        if not byte:
            raise EOFError
        text += byte
    return text


def _last_block(file: BinaryIO) -> int:
    """Return the largest offset of the table that follows the headers.

    The table ends where the first block begins.
    """
    first, last = struct.unpack("<Q", file.read(8)) * 2
    while file.tell() < first:
        offset = struct.unpack("<Q", file.read(8))[0]
        first, last = min(first, offset), max(last, offset)
    if first < file.tell():  # zero: the table was never filled in
        raise EOFError
    return int(last)


def _end_of_block(file: BinaryIO, offset: int, flags: int) -> int:
    """Return where a block ends, or less for tiles in a file of several parts and for deep ones."""
    if flags & _DEEP:
        return offset + 8
    place_of_size = 8 if flags & _MULTIPART else 16 if flags & _TILED else 4
    file.seek(offset + place_of_size)
    return int(struct.unpack("<i", file.read(4))[0]) + file.tell()
