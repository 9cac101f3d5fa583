"""The command `bench`."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.cli.console import (
    FAILED,
    INTERRUPTED,
    print_error,
    print_warning,
    results,
    show_progress,
)
from tuning.cli.options import Overwrite, Set

__all__ = ["bench"]


def bench(  # noqa: PLR0913 - each argument is an option
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="NAME", help="Filter or preset; repeatable."),
    ] = None,
    sizes: Annotated[
        list[str] | None, typer.Option("--size", metavar="WxH", help="Size in px; repeatable.")
    ] = None,
    num_samples: Annotated[
        list[int] | None, typer.Option("--num-samples", metavar="N", help="Taps; repeatable.")
    ] = None,
    what: Annotated[
        list[str] | None,
        typer.Option(
            metavar="WHAT",
            help="forward, backward (forward, then backward to color and parameters), or "
            "parameters (backward to them alone); repeatable.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TABLE",
            help="filters, taps, sizes, moving, batch, notes, step; repeatable. Default: all.",
        ),
    ] = None,
    engine: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="eager, compiled; repeatable.")
    ] = None,
    device: Annotated[str, typer.Option(metavar="NAME", help="auto, cpu, cuda, cuda:1 …")] = "auto",
    set_: Set = None,
    targets: Annotated[
        bool, typer.Option("--targets", help="Measure the figures that are aimed at, and judge.")
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Tiny images, eager: to see that everything works.")
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="All filters and engines in all tables, up to 4K.")
    ] = False,
    runs: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Timed runs of each.")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="CPU threads. Default: OMP_NUM_THREADS, or all."),
    ] = None,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", help="Write everything here, too; kept up to date."),
    ] = None,
    json_schema: Annotated[
        bool, typer.Option("--json-schema", help="Print the JSON Schema of that file instead.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure time and memory of the filters; leave the machine alone meanwhile.

    Figures are medians after a warm-up; compiling is reported apart. The default selection takes
    about a quarter of an hour on two cores. On a GPU: `--targets --device cuda --json gpu.json`.
    """
    import json

    from torchblur.params import build
    from tuning.bench.cases import Report
    from tuning.bench.plan import BenchOptions
    from tuning.bench.run import run_bench
    from tuning.cli.bench_table import print_report
    from tuning.config.overrides import apply_overrides

    if json_schema:
        typer.echo(json.dumps(Report.model_json_schema(), indent=2))
        return
    data: dict[str, Any] = {
        "filters": tuple(filters or ()),
        "sizes": tuple(sizes or ()),
        "num_samples": tuple(num_samples or ()),
        "what": tuple(what or ()),
        "only": tuple(only or ()),
        "engines": tuple(engine or ()),
        "device": device,
        "targets": targets,
        "quick": quick,
        "full": full,
        "runs": runs,
        "threads": threads,
        "params": apply_overrides({}, set_ or []),
    }
    options = build(BenchOptions, data, "bench")
    # Whoever ends the benchmark (a job's time limit) also ends the process that measures.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with show_progress() as progress:
            report = run_bench(
                options,
                progress=progress,
                output=json_file,
                overwrite=overwrite,
                warn=print_warning,
            )
    except KeyboardInterrupt as error:
        kept = "" if json_file is None else f"; what was measured is in {json_file}"
        print_error(f"stopped{kept}")
        raise typer.Exit(INTERRUPTED) from error
    finally:
        signal.signal(signal.SIGTERM, before)
    print_report(report)
    if json_file is not None:
        results.print(f"wrote {json_file}", soft_wrap=True)
    if any(row.error for table in report.tables for row in table.rows):
        raise typer.Exit(FAILED)
