"""All commands under one: each reads its arguments and calls what the Python API offers.

Only what the help needs is imported here; torch comes with the command that needs it.
"""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from tuning.cli.bench import bench
from tuning.cli.compare import compare
from tuning.cli.console import BAD_INPUT, FAILED, INTERRUPTED, print_error, print_warning, results
from tuning.cli.experiments import ablate, crossfit, race, study
from tuning.cli.export import card, export
from tuning.cli.filter import batch, filter_
from tuning.cli.inspect import inspect, params
from tuning.cli.render import render
from tuning.cli.tune import tune

__all__ = ["app"]


class _Commands(TyperGroup):
    """Turns errors into one message and an exit code; takes --debug and --plugin anywhere."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first, rest, words = [], [], iter(args)
        for word in words:
            if word == "--debug" or word.startswith("--plugin="):
                first.append(word)
            elif word == "--plugin":
                first += [word, *itertools.islice(words, 1)]
            else:
                rest.append(word)
        return super().parse_args(ctx, [*first, *rest])

    def invoke(self, ctx: Any) -> Any:
        with _readable_errors(debug=bool(ctx.params.get("debug"))), _readable_warnings():
            return super().invoke(ctx)


@contextmanager
def _readable_errors(debug: bool) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as error:
        print_error("stopped (Ctrl-C)")
        raise typer.Exit(INTERRUPTED) from error
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
        return str(error), BAD_INPUT
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}", BAD_INPUT
    if isinstance(error, ModuleNotFoundError):
        hint = "pip install 'torchblur[tune]'"
        return f"the package `{error.name}` is needed and is not installed; {hint}", FAILED
    kind = type(error).__name__
    return f"unexpected {kind}: {error}\n--debug shows where it happened", FAILED


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
    plugin: Annotated[
        list[Path] | None,
        typer.Option(
            help="Python file with filters of your own, beside those that are built in; repeatable."
        ),
    ] = None,
) -> None:
    if plugin:
        from torchblur.filters import PLUGINS, list_filters

        # Processes that are started later find the filters by the same variable.
        before = filter(None, [os.environ.get(PLUGINS)])
        os.environ[PLUGINS] = os.pathsep.join([*before, *(str(p.resolve()) for p in plugin)])
        list_filters()


app.command()(tune)
app.command("filter")(filter_)
app.command()(batch)
app.command()(render)
app.command()(compare)
app.command()(export)
app.command()(card)
app.command()(ablate)
app.command()(study)
app.command()(race)
app.command()(crossfit)
app.command()(bench)
app.command()(params)
app.command()(inspect)
