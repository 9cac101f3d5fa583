"""Options that several commands have, and what they stand for."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tuning.parallel.cluster import Cluster

__all__ = [
    "ConventionName",
    "NoCompile",
    "Overwrite",
    "RunFolder",
    "Scheduler",
    "Set",
    "open_workers",
]


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
RunFolder = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="DIR", help="Folder. Default: runs/CONFIG.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing results.")]
ConventionName = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Whose channel names, units and signs: auto, torchblur, blender, nuke …",
    ),
]


def open_workers(
    scheduler: str | None, workers: int | None = None
) -> AbstractContextManager[Cluster | None]:
    """Return the cluster that a command's options ask for, if any.

    Args:
        scheduler: Address of a Dask scheduler.
        workers: In its place, so many processes on this machine.
    """
    if scheduler is None and workers is None:
        return nullcontext()
    from tuning.parallel.cluster import open_cluster

    return open_cluster(scheduler, workers=workers)
