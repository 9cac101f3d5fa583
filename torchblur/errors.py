"""Errors that torchblur raises on bad input.

A message has the rule, the value, the place and, where one is known, a hint. All of them are
`ValueError`s, so that a caller need not know this module.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = [
    "ConfigError",
    "FileFormatError",
    "FrameError",
    "OutputError",
    "ReachWarning",
    "TorchblurError",
    "nearest_name",
]


class TorchblurError(ValueError):
    """Base of all errors about input that torchblur refuses."""


class FrameError(TorchblurError):
    """A tensor of a frame has the wrong shape, type or values, or a layer is missing."""


class ConfigError(TorchblurError):
    """A configuration has an unknown key, a value out of range or of the wrong kind."""


class FileFormatError(TorchblurError):
    """A file cannot be read as what it claims to be, or lacks a channel."""


class OutputError(TorchblurError):
    """A result cannot be written where it should go, or one is there already."""


class ReachWarning(UserWarning):
    """A filter cuts motion short: part of a frame moves farther than it blurs."""


def nearest_name(name: str, valid: Iterable[str]) -> str:
    """Return a hint " (did you mean `x`?)" for a misspelled name, or an empty string.

    Args:
        name: What was given.
        valid: The names that would have been right.

    Returns:
        The hint with a leading space, to be appended to a message.
    """
    close = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.5)
    return f" (did you mean `{close[0]}`?)" if close else ""
