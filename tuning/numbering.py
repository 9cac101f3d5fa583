"""Frame numbers in the names of files: #### stands for the digits."""

from __future__ import annotations

import re
from pathlib import Path

from torchblur.errors import ConfigError

__all__ = ["frame_numbers", "numbered_file"]


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
