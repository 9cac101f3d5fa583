"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["ConventionName", "NoCompile", "Overwrite", "Scheduler", "Set"]


def _stop_compiling(value: bool) -> bool:
    if value:
        from torchblur.ops.compiling import stop_compiling

        stop_compiling()
    return value


NoCompile = Annotated[
    bool,
    typer.Option(
        "--no-compile",
        callback=_stop_compiling,
        help="Run filters and renderer without torch.compile, whatever there is to do.",
    ),
]

Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace one key; the value is YAML, dots lead into mappings and lists. Repeatable.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Give the work to a Dask cluster, such as tcp://host:8786."
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
