"""The command that fits a filter: `tune`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.cli.console import FAILED, INTERRUPTED, print_error, show_progress
from tuning.cli.options import NoCompile, Scheduler, Set, open_workers

__all__ = ["tune"]


def tune(  # noqa: PLR0913 - each argument is an option
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG", help="What to fit to what; configs/tune has examples."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Run folder. Default: runs/CONFIG."),
    ] = None,
    set_: Set = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Remove a run that is there.")
    ] = False,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="auto, cpu, cuda, cuda:1 …")
    ] = None,
    no_compile: NoCompile = False,
    scheduler: Scheduler = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="The same, on N processes started here.")
    ] = None,
    track: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Log folder of TensorBoard: curves, figures, images."),
    ] = None,
) -> None:
    """Fit a filter's parameters to reference renders.

    The run folder gets the tuned preset, which `torchblur filter` and `torchblur batch` take, and
    a report with the evidence. A cluster takes the candidates that a search draws together
    (`population`); `torchrun -m tuning tune CONFIG` splits the windows of each step.
    """
    from tuning.cli.printing import print_fit
    from tuning.config.fit import load_tune_config
    from tuning.fit.run import run_fit
    from tuning.fit.tensorboard import tracking
    from tuning.parallel.ranks import RankZeroStoppedError, rank_here

    overrides = [*(set_ or []), *([f"device={device}"] if device else [])]
    overrides += ["engine=eager"] if no_compile else []
    folder = output or Path("runs") / config.stem
    loaded = load_tune_config(config, overrides)
    try:
        shown = track if rank_here() == 0 else None
        with (
            show_progress() as progress,
            tracking(shown, folder, loaded, progress) as tracker,
            open_workers(scheduler, workers) as cluster,
        ):
            told = tracker or progress
            result = run_fit(loaded, folder, resume, told, overwrite=overwrite, cluster=cluster)
            if tracker is not None:
                tracker.finish(result)
    except RankZeroStoppedError as error:
        raise typer.Exit(FAILED) from error
    except KeyboardInterrupt as error:
        places = {"--scheduler": scheduler, "--workers": workers, "--track": track}
        again = shlex.join(_again(config, folder, overrides, places))
        print_error(
            f"stopped (Ctrl-C); nothing but the step in flight is lost. Go on with: {again}"
        )
        raise typer.Exit(INTERRUPTED) from error
    if rank_here() == 0:
        print_fit(result, folder)


def _again(
    config: Path, folder: Path, overrides: list[str], places: Mapping[str, Any]
) -> list[str]:
    changes = [word for text in overrides for word in ("--set", text)]
    where = [word for name, value in places.items() if value for word in (name, str(value))]
    return ["torchblur", "tune", str(config), "-o", str(folder), *changes, *where, "--resume"]
