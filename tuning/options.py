"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["ConventionName", "Overwrite", "Set"]

Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace one key; the value is YAML, dots lead into mappings and lists. Repeatable.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing results.")]
ConventionName = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Whose channel names, units and signs: auto, torchblur, blender, nuke …",
    ),
]
