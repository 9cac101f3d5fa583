"""The commands: each reads its arguments and calls what the Python API offers.

Only what the help needs is imported here; torch comes with the command that needs it.
"""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from tuning.cli.bench import bench
from tuning.cli.console import metrics_table, print_error, print_warning, results, show_progress
from tuning.cli.experiments import ablate, crossfit, race, study
from tuning.cli.export import card, export
from tuning.cli.options import ConventionName, NoCompile, Overwrite, Scheduler, Set
from tuning.cli.render import render

if TYPE_CHECKING:
    from tuning.parallel.cluster import Cluster

__all__ = ["app"]

_FAILED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130


class _Commands(TyperGroup):
    """Turns errors into one message and an exit code; takes --debug anywhere."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if "--debug" in args:
            args = ["--debug", *(arg for arg in args if arg != "--debug")]
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        with _readable_errors(debug=bool(ctx.params.get("debug"))), _readable_warnings():
            return super().invoke(ctx)


@contextmanager
def _readable_errors(debug: bool) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as error:
        print_error("stopped (Ctrl-C)")
        raise typer.Exit(_INTERRUPTED) from error
    except (typer.Exit, typer.Abort, BrokenPipeError):
        raise
    except Exception as error:
        if debug or _is_usage_error(error):
            raise
        message, code = _explained(error)
        print_error(message)
        raise typer.Exit(code) from error


def _is_usage_error(error: Exception) -> bool:
    """Whether typer itself says it, with the usage of the command."""
    return hasattr(error, "format_message")


def _explained(error: Exception) -> tuple[str, int]:
    from torchblur.errors import TorchblurError

    if isinstance(error, TorchblurError):
        return str(error), _BAD_INPUT
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}", _BAD_INPUT
    if isinstance(error, ModuleNotFoundError):
        hint = "pip install 'torchblur[tune]'"
        return f"the package `{error.name}` is needed and is not installed; {hint}", _FAILED
    kind = type(error).__name__
    return f"unexpected {kind}: {error}\n--debug shows where it happened", _FAILED


@contextmanager
def _readable_warnings() -> Iterator[None]:
    told: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        from torchblur.errors import ReachWarning

        text = str(message)
        if issubclass(category, ReachWarning):
            filter_name = text.partition(":")[0]
            if filter_name in told:  # by another frame, another thread or another worker
                return
            told.add(filter_name)
        print_warning(text)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Differentiable motion-blur filters: tune them to reference renders, and apply them.",
    epilog="Exit codes: 0 done, 1 something failed, 2 bad input, 130 stopped with Ctrl-C.",
)


def _show_version(value: bool) -> None:
    if value:
        results.print(f"torchblur {version('torchblur')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version."),
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of errors.")] = False,
) -> None:
    pass


# -- the commands ----------------------------------------------------------------------------------


@app.command()
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
            _cluster(scheduler, workers) as cluster,
        ):
            told = tracker or progress
            result = run_fit(loaded, folder, resume, told, overwrite=overwrite, cluster=cluster)
            if tracker is not None:
                tracker.finish(result)
    except RankZeroStoppedError as error:
        raise typer.Exit(_FAILED) from error
    except KeyboardInterrupt as error:
        places = {"--scheduler": scheduler, "--workers": workers, "--track": track}
        again = shlex.join(_tune_again(config, folder, overrides, places))
        print_error(
            f"stopped (Ctrl-C); nothing but the step in flight is lost. Go on with: {again}"
        )
        raise typer.Exit(_INTERRUPTED) from error
    if rank_here() == 0:
        print_fit(result, folder)


@app.command("filter")
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


@app.command()
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
    with show_progress() as progress, _cluster(scheduler) as cluster:
        result = run_batch(plan, progress, cluster)
    print_batch(plan, result)
    if result.interrupted:
        raise typer.Exit(_INTERRUPTED)
    raise typer.Exit(_FAILED if result.failures else 0)


app.command()(render)


@app.command()
def compare(
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGE", help="EXR or PNG files, or sequences with ####."),
    ],
    reference: Annotated[
        Path, typer.Option(metavar="REF", help="Image with true motion blur; #### for sequences.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="HTML", help="Page with sliders and error maps."),
    ] = None,
    frame: Annotated[
        Path | None,
        typer.Option(
            metavar="SHARP", help="Sharp frame with velocity: adds the band at moving borders."
        ),
    ] = None,
    shutter: Annotated[
        float, typer.Option(metavar="S", help="Shutter of the reference, for the band.")
    ] = 0.5,
    convention: ConventionName = "auto",
    overwrite: Overwrite = False,
) -> None:
    """Measure how close images come to a reference: FLIP, PSNR and SSIM.

    Sequences (`out/####.exr --reference reference.####.exr`): means over the frames, the weighted
    median of FLIP, and the error of the change from frame to frame.
    """
    from torchblur.frame import Shutter
    from tuning.report.compare import compare_images, write_page
    from tuning.report.compare_sequences import compare_sequences, is_sequence

    named = [*images, reference, *([] if frame is None else [frame])]
    compared = compare_sequences if is_sequence(named) else compare_images
    found = compared(
        images, reference, frame=frame, convention=convention, shutter=Shutter(shutter)
    )
    frames = f", mean of {found.frames}" if found.frames else ""
    results.print(metrics_table(f"against {reference}{frames}; PSNR in dB, linear", found.scores))
    if output is not None:
        write_page(output, found, title=f"Against {reference.name}", overwrite=overwrite)
        results.print(f"page: {output}", soft_wrap=True)


app.command()(export)
app.command()(card)
app.command()(ablate)
app.command()(study)
app.command()(race)
app.command()(crossfit)
app.command()(bench)


@app.command()
def params(
    filter_name: Annotated[
        str | None, typer.Argument(metavar="[FILTER]", help="Name of a filter. Default: all.")
    ] = None,
    json_schema: Annotated[
        bool, typer.Option("--json-schema", help="Print a JSON Schema for editors instead.")
    ] = False,
) -> None:
    """List the parameters of a filter: default, range, unit, gradient class, source, meaning."""
    from tuning.cli.printing import print_parameters, schema_text

    if json_schema:
        typer.echo(schema_text(filter_name))
    else:
        print_parameters(filter_name)


@app.command()
def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="EXR file.")],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="REF", help="The frame with motion blur: checks the velocity's signs."
        ),
    ] = None,
    convention: ConventionName = "auto",
) -> None:
    """Show what is in a file, how it would be read, and what looks wrong."""
    from torchblur.io import inspect_file
    from tuning.cli.printing import print_inspection

    print_inspection(inspect_file(file, reference, convention=convention))


def _cluster(
    scheduler: str | None, workers: int | None = None
) -> AbstractContextManager[Cluster | None]:
    if scheduler is None and workers is None:
        return nullcontext()
    from tuning.parallel.cluster import open_cluster

    return open_cluster(scheduler, workers=workers)


def _tune_again(
    config: Path, folder: Path, overrides: list[str], places: Mapping[str, Any]
) -> list[str]:
    changes = [word for text in overrides for word in ("--set", text)]
    where = [word for name, value in places.items() if value for word in (name, str(value))]
    return ["torchblur", "tune", str(config), "-o", str(folder), *changes, *where, "--resume"]
