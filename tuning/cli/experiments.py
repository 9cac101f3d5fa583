"""The commands that measure claims, filters and fits: `ablate`, `study`, `race`, `crossfit`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.cli.console import plain_table, results, show_progress, stoppable
from tuning.cli.options import NoCompile, Overwrite, RunFolder, Set

__all__ = ["ablate", "crossfit", "race", "study"]


def ablate(
    config: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG", help="The claims and their scenes; configs/ablations has examples."
        ),
    ],
    output: RunFolder = None,
    set_: Set = None,
    overwrite: Overwrite = False,
    no_compile: NoCompile = False,
) -> None:
    """Measure claims: a filter with a feature off and on, against references of their scenes.

    The folder gets table.md, table.json, and ablation.html with a slider for each claim.
    """
    from tuning.cli.printing import print_ablation
    from tuning.experiments.ablation.run import load_ablation_config, run_ablation
    from tuning.experiments.ablation.write import FILES, write_ablation
    from tuning.experiments.tables import check_outputs

    folder = output or Path("runs") / config.stem
    loaded = load_ablation_config(config, set_ or [])
    check_outputs(folder, FILES, overwrite=overwrite)
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
    output: RunFolder = None,
    set_: Set = None,
    overwrite: Overwrite = False,
    no_compile: NoCompile = False,
) -> None:
    """Measure filters frame by frame, on scenes and on files, beside raw samples.

    The folder gets study.json with every figure, tables.md, tables.csv, plots over the frames,
    and sheets of pictures. What is measured and rendered is kept: a stopped study goes on when
    started again, and another variant costs no more than itself.
    """
    from tuning.cli.printing import print_study
    from tuning.experiments.study.config import load_study_config
    from tuning.experiments.study.run import run_study
    from tuning.experiments.study.write import FILES, write_study
    from tuning.experiments.tables import check_outputs

    folder = output or Path("runs") / config.stem
    loaded = load_study_config(config, set_ or [])
    check_outputs(folder, FILES, overwrite=overwrite)
    with stoppable(), show_progress() as progress:
        found = run_study(loaded, folder, progress)
    files = write_study(folder, loaded, found, overwrite=overwrite)
    print_study(found)
    results.print(f"tables: {folder / 'tables.md'}, {len(files)} files", soft_wrap=True)


def race(
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG", help="Problems and methods; configs/races has examples."),
    ],
    output: RunFolder = None,
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
    with stoppable(), show_progress() as progress:
        curves = run_race(loaded, folder, progress)
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


def crossfit(
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG", help="Cases and filters; configs/crossfit has examples."),
    ],
    output: RunFolder = None,
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
    with stoppable(), show_progress() as progress:
        found = run_crossfit(loaded, folder, progress, workers=workers)
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
