"""The hash of source files: what other source has made is made anew."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

import torchblur

__all__ = ["source_hash"]


@functools.cache
def source_hash(*places: str, without: str | None = None) -> str:
    """Return the hash of the library's source, in folders and the folders in them.

    Args:
        *places: Folders below `torchblur/`, or "" for the files that lie there themselves.
        without: Beginning of the names of files that are left out.
    """
    root = Path(torchblur.__file__).parent
    files = [
        f for p in places for f in (root.glob("*.py") if p == "" else (root / p).rglob("*.py"))
    ]
    digest = hashlib.sha256()
    for file in sorted(files):
        if without is None or not file.name.startswith(without):
            digest.update(file.read_bytes())
    return digest.hexdigest()
