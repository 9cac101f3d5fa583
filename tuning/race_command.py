"""The command that lets methods race: `race`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.console import plain_table, print_error, results, show_progress
from tuning.options import Set

__all__ = ["race"]

_INTERRUPTED = 130


def race(
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG", help="Problems and methods; configs/races has examples."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder. Default: runs/CONFIG."),
    ] = None,
    set_: Set = None,
) -> None:
    """Let fitting methods race: how good is each after so many evaluations and CPU-seconds.

    The folder gets tables.md, race.json, points.csv and a plot for each problem. Each fit is kept:
    a stopped race goes on when started again, and another method costs no more than itself.
    """
    from tuning.experiments.race.config import load_race_config
    from tuning.experiments.race.run import run_race
    from tuning.experiments.race.summary import standings
    from tuning.experiments.race.write import COLUMNS, SHORT, cells, note_of, write_race

    folder = output or Path("runs") / config.stem
    loaded = load_race_config(config, set_ or [])
    try:
        with show_progress() as progress:
            curves = run_race(loaded, folder, progress)
    except KeyboardInterrupt as error:
        print_error("stopped (Ctrl-C); the same command goes on")
        raise typer.Exit(_INTERRUPTED) from error
    files = write_race(folder, loaded, curves)
    for problem in loaded.problems:
        names = tuple(SHORT.values())
        table = plain_table(problem.name, ("method", *names), right=names)
        for one in standings(loaded, problem, curves):
            texts = dict(zip(COLUMNS, cells(loaded, one), strict=True))
            table.add_row(one.entrant, *(texts[column] for column in SHORT))
        results.print(table)
        results.print(note_of(loaded, problem))
    results.print(f"tables: {folder / 'tables.md'}, {len(files)} files", soft_wrap=True)
