"""The command that fits filters to all cases but one: `crossfit`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.console import plain_table, print_error, results, show_progress
from tuning.options import Set

__all__ = ["crossfit"]

_INTERRUPTED = 130


def crossfit(
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG", help="Cases and filters; configs/crossfit has examples."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder. Default: runs/CONFIG."),
    ] = None,
    set_: Set = None,
    workers: Annotated[
        int, typer.Option(min=1, metavar="N", help="Processes that share the fits; same figures.")
    ] = 1,
) -> None:
    """Leave each case out once: fit filters to all others, and score them on the one left out.

    The folder gets tables.md, crossfit.json, points.csv and ratios.png, with bootstrap intervals.
    Each fit is kept, in a run folder of its own: what was stopped goes on when started again, and
    another filter costs no more than itself.
    """
    from tuning.experiments.crossfit.config import load_crossfit_config
    from tuning.experiments.crossfit.run import run_crossfit
    from tuning.experiments.crossfit.summary import (
        MEAN,
        cut_texts,
        mean_names,
        summary_of,
        verdicts,
    )
    from tuning.experiments.crossfit.write import (
        COLUMNS,
        TARGETS,
        UNSURE,
        cell,
        note_of,
        write_crossfit,
    )

    folder = output or Path("runs") / config.stem
    loaded = load_crossfit_config(config, set_ or [])
    try:
        with show_progress() as progress:
            found = run_crossfit(loaded, folder, progress, workers=workers)
    except KeyboardInterrupt as error:
        print_error("stopped (Ctrl-C); the same command goes on")
        raise typer.Exit(_INTERRUPTED) from error
    files = write_crossfit(folder, loaded, found)
    rows = summary_of(loaded, found)
    shown = ("flip", "flip_ratio", "psnr", "flip_band", "psnr_band", "psnr_band_gain")
    labels = [COLUMNS[name][0].replace(", b", " b").replace(" b", "\nb") for name in shown]
    means = mean_names(loaded, rows)
    for mean in means:
        title = mean.replace(MEAN, "Mean over the cases that were left out")
        table = plain_table(title, ("", *labels), right=labels)
        for row in rows:
            if row.case == mean:
                table.add_row(row.label, *(cell(row, name, interval=False) for name in shown))
        results.print(table)
    for text in cut_texts(loaded, found):
        results.print(text, markup=False, soft_wrap=True)
    every = verdicts(loaded, found, rows)
    cases = (*loaded.data.cases, *means)
    for target, limit in loaded.targets.items():
        texts = {(v.filter, v.case): v.text for v in every if v.target == target}
        table = plain_table(TARGETS[target].format(limit), ("", *cases))
        for name in dict.fromkeys(name for name, _ in texts):
            table.add_row(name, *(texts.get((name, case), "–") for case in cases))
        results.print(table)
    results.print(note_of(loaded) + (f" {UNSURE}" if loaded.targets else ""))
    results.print(f"tables: {folder / 'tables.md'}, {len(files)} files", soft_wrap=True)
