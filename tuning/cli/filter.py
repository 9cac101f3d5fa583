"""The commands that filter files: `filter` a few, `batch` many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.cli.console import FAILED, INTERRUPTED, metrics_table, results, show_progress
from tuning.cli.options import ConventionName, NoCompile, Overwrite, Scheduler, Set, open_workers

__all__ = ["batch", "filter_"]


def filter_(  # noqa: PLR0913 - each argument is an option
    filter_name: Annotated[
        str, typer.Argument(metavar="FILTER", help="Name of a filter, or the path of a preset.")
    ],
    inputs: Annotated[
        list[str],
        typer.Argument(metavar="INPUT", help="EXR files, a folder, or a pattern with ####."),
    ],
    output: Annotated[
        str | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="File (.exr, or .png for sRGB), folder, or pattern with #### or {name}.",
        ),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(metavar="REF", help="Render with motion blur: print how close filters come."),
    ] = None,
    set_: Set = None,
    gbuffer: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Second file with all layers but color; #### works."),
    ] = None,
    convention: ConventionName = "auto",
    overwrite: Overwrite = False,
    no_compile: NoCompile = False,
) -> None:
    """Blur frames that a renderer wrote.

    Keys for --set are the filter's parameters (`torchblur params FILTER` lists them), shutter
    among them, and: layers=[NAME, ...] to write more than color, overrides.FIELD for what differs
    from the convention (velocity_scale, velocity_y ...), on_invalid=mask, half, engine, device.
    """
    from tuning.batch.single import filter_files, load_settings, plan_files

    settings = load_settings(filter_name, set_ or [], convention)
    jobs = plan_files(inputs, output, gbuffer=gbuffer, reference=reference, overwrite=overwrite)
    with show_progress() as progress:
        scores = filter_files(settings, jobs, overwrite=overwrite, progress=progress)
    if scores is not None:
        frames = f", mean of {len(jobs)} frames" if len(jobs) > 1 else ""
        title = f"against {reference}{frames}; PSNR in dB, linear"
        results.print(metrics_table(title, scores.by_name, highlight=scores.asked))
    written = [job.output for job in jobs if job.output is not None]
    if written:
        more = f" … {written[-1]} ({len(written)} files)" if len(written) > 1 else ""
        results.print(f"wrote {written[0]}{more}", soft_wrap=True)


def batch(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="What to filter; configs/batch has examples.")
    ],
    set_: Set = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan alone.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Make all results anew, whoever made them.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Frames that are filtered at a time.")
    ] = None,
    no_compile: NoCompile = False,
    scheduler: Scheduler = None,
) -> None:
    """Filter many frames; what is done is skipped, so a stopped run goes on when started again."""
    from tuning.batch.run import load_batch_config, plan_batch, run_batch
    from tuning.cli.printing import print_batch, print_plan

    overrides = [*(set_ or []), *([f"workers={workers}"] if workers is not None else [])]
    plan = plan_batch(load_batch_config(config, overrides), overwrite=overwrite)
    if dry_run:
        print_plan(plan)
        plan.check()
        return
    with show_progress() as progress, open_workers(scheduler) as cluster:
        result = run_batch(plan, progress, cluster)
    print_batch(plan, result)
    if result.interrupted:
        raise typer.Exit(INTERRUPTED)
    raise typer.Exit(FAILED if result.failures else 0)
