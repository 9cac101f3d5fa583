"""The commands that measure claims and filters: `ablate` and `study`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.console import print_error, results, show_progress
from tuning.options import NoCompile, Overwrite, Set

__all__ = ["ablate", "study"]

_INTERRUPTED = 130


def ablate(
    config: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG", help="The claims and their scenes; configs/ablations has examples."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder. Default: runs/CONFIG."),
    ] = None,
    set_: Set = None,
    overwrite: Overwrite = False,
    no_compile: NoCompile = False,
) -> None:
    """Measure claims: a filter with a feature off and on, against references of their scenes.

    The folder gets table.md, table.json, and ablation.html with a slider for each claim.
    """
    from tuning.experiments.ablation.run import load_ablation_config, run_ablation
    from tuning.experiments.ablation.write import check_outputs, write_ablation
    from tuning.printing import print_ablation

    folder = output or Path("runs") / config.stem
    loaded = load_ablation_config(config, set_ or [])
    check_outputs(folder, overwrite=overwrite)
    with show_progress() as progress:
        rows = run_ablation(loaded, progress)
    files = write_ablation(folder, loaded, rows, overwrite=overwrite)
    print_ablation(loaded, rows)
    results.print(f"page: {files[-1]}", soft_wrap=True)


def study(
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG", help="What is measured; configs/studies has examples."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder. Default: runs/CONFIG."),
    ] = None,
    set_: Set = None,
    overwrite: Overwrite = False,
    no_compile: NoCompile = False,
) -> None:
    """Measure filters frame by frame, on scenes and on files, beside raw samples.

    The folder gets study.json with every figure, tables.md, tables.csv, plots over the frames,
    and sheets of pictures. What is measured and rendered is kept: a stopped study goes on when
    started again, and another variant costs no more than itself.
    """
    from tuning.experiments.study.config import load_study_config
    from tuning.experiments.study.run import run_study
    from tuning.experiments.study.write import check_study_outputs, write_study
    from tuning.study_printing import print_study

    folder = output or Path("runs") / config.stem
    loaded = load_study_config(config, set_ or [])
    check_study_outputs(folder, overwrite=overwrite)
    try:
        with show_progress() as progress:
            found = run_study(loaded, folder, progress)
    except KeyboardInterrupt as error:
        print_error("stopped (Ctrl-C); the same command goes on")
        raise typer.Exit(_INTERRUPTED) from error
    files = write_study(folder, loaded, found, overwrite=overwrite)
    print_study(found)
    results.print(f"tables: {folder / 'tables.md'}, {len(files)} files", soft_wrap=True)
