"""The commands of `torchblur`, and its entry point.

It imports nothing but the standard library, so that a missing package is one clear sentence.
"""

from __future__ import annotations

import os
import sys

__all__ = ["main"]

_NEEDED = ("typer", "rich")


def main() -> None:
    """Run the command line; exit codes are 0, 1 (something failed), 2 (bad input), 130 (Ctrl-C)."""
    # Torch's large allocations then take huge pages, which costs half the time.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    try:
        from tuning.cli.app import app
    except ModuleNotFoundError as error:
        if error.name not in _NEEDED:
            raise
        sys.exit(
            f"error: the command line needs the package `{error.name}`, which is not installed; "
            "install it with: pip install 'torchblur[tune]'"
        )
    app(prog_name="torchblur")
