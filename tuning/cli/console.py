"""What the commands print: tables, progress, warnings, and one clear error.

Results go to the standard output, everything else to the standard error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as Bars
from rich.table import Column, Table
from rich.text import Text

from tuning.progress import Progress, ProgressEvent

__all__ = [
    "BAD_INPUT",
    "FAILED",
    "INTERRUPTED",
    "log",
    "metrics_table",
    "number_text",
    "plain_table",
    "print_error",
    "print_warning",
    "results",
    "show_progress",
    "status",
    "stoppable",
]

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
"""Exit codes."""

results = Console(highlight=False)
"""Standard output."""

status = Console(stderr=True, highlight=False)
"""Standard error."""

_LOG_EVERY = 5.0
_NOTE_COLUMN = Column(no_wrap=True, overflow="ellipsis", ratio=1)  # takes what the bars leave
_METRICS = {
    "flip": ("FLIP", ".4f", "less"),
    "psnr": ("PSNR", ".2f", "more"),
    "ssim": ("SSIM", ".4f", "more"),
    "temporal": ("change", ".4f", "less"),
}


def print_error(message: str) -> None:
    """Print an error; lines after the first are indented."""
    first, *others = message.splitlines() or [""]
    status.print(Text.assemble(("error: ", "bold red"), first), soft_wrap=True)
    for line in others:
        status.print(Text(f"       {line}"), soft_wrap=True)


def print_warning(message: str) -> None:
    """Print a warning."""
    status.print(Text.assemble(("warning: ", "bold yellow"), message), soft_wrap=True)


def log(message: str) -> None:
    """Print what is going on; above the progress bar if there is one."""
    status.print(Text(message), soft_wrap=True)


@contextmanager
def stoppable() -> Iterator[None]:
    """Let Ctrl-C end a command that goes on when it is started again."""
    try:
        yield
    except KeyboardInterrupt as error:
        print_error("stopped (Ctrl-C); the same command goes on")
        raise typer.Exit(INTERRUPTED) from error


# -- progress ----------------------------------------------------------------------------------


@contextmanager
def show_progress() -> Iterator[Progress]:
    """Show how far a job is and how long it will take.

    On a terminal each stage is a bar that moves; elsewhere a line each few seconds.

    Yields:
        What is to be called with each event.
    """
    if not status.is_terminal:
        yield _Lines()
        return
    columns: tuple[ProgressColumn, ...] = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("[cyan]{task.fields[left]}"),
        TextColumn("[dim]{task.fields[note]}", table_column=_NOTE_COLUMN),
    )
    with Bars(*columns, console=status, expand=True) as bars:
        yield _Bars(bars)


class _Bars:
    """A bar for each stage."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, event: ProgressEvent) -> None:
        if event.stage not in self._tasks:
            self._tasks[event.stage] = self._bars.add_task(event.stage, left="", note="")
        self._bars.update(
            self._tasks[event.stage],
            total=event.total,
            completed=event.done,
            left=_left(event),
            note=escape(_note(event)),
        )


class _Lines:
    """A line now and then, and at the end of each stage."""

    def __init__(self) -> None:
        self._before = ("", -1)
        self._last = 0.0

    def __call__(self, event: ProgressEvent) -> None:
        now, before = time.monotonic(), self._before
        self._before = (event.stage, event.done)
        is_step = event.stage == before[0] and event.done != before[1]
        if event.done < event.total and is_step and now - self._last < _LOG_EVERY:
            return
        self._last = now
        parts = [f"{event.stage} {event.done}/{event.total}", _left(event), _note(event)]
        log(f"{time.strftime('%H:%M:%S')} {', '.join(part for part in parts if part)}")


def _left(event: ProgressEvent) -> str:
    if event.eta is None or event.done >= event.total:
        return ""
    seconds = round(event.eta)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"


def _note(event: ProgressEvent) -> str:
    best = "" if event.best is None else f"best {event.best:.5g}"
    return ", ".join(part for part in (best, event.message) if part)


# -- tables ------------------------------------------------------------------------------------


def plain_table(title: str, columns: Sequence[str], *, right: Sequence[str] = ()) -> Table:
    """Return an empty table in the house style.

    Args:
        title: Its heading, or "".
        columns: Names of the columns.
        right: Those with numbers, set flush right.
    """
    table = Table(
        title=title or None,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        header_style="bold",
        pad_edge=False,
    )
    for index, name in enumerate(columns):
        number = name in right
        table.add_column(
            name,
            justify="right" if number else "left",
            overflow="fold",
            no_wrap=number or index == 0,
        )
    return table


def metrics_table(
    title: str,
    rows: Mapping[str, Mapping[str, float]],
    *,
    highlight: str = "",
    unranked: Sequence[str] = (),
) -> Table:
    """Return a table of FLIP, PSNR and SSIM over the image and, if there, over masks.

    The best value of each column is bold.

    Args:
        title: Heading.
        rows: By name, values as `torchblur.metrics.evaluate` names them: "flip", "psnr_band" …
        highlight: The row that the reader asked for; it is marked.
        unranked: Rows that are bounds, not competitors: they are never the best.
    """
    keys = [key for key in next(iter(rows.values())) if key.partition("_")[0] in _METRICS]
    labels = {key: _label(key) for key in keys}
    table = plain_table(title, ["", *labels.values()], right=list(labels.values()))
    ranked = [row for name, row in rows.items() if name not in unranked]
    best = {key: _best(key, [row[key] for row in ranked]) for key in keys}
    for name, row in rows.items():
        cells = [
            Text(number_text(key, row[key]), style=_style(name, row[key], best[key], unranked))
            for key in keys
        ]
        marked = name == highlight
        table.add_row(Text(f"{'>' if marked else ' '} {name}"), *cells)
    return table


def number_text(key: str, value: float) -> str:
    """Return a metric's value as it is printed: "0.0123", "38.92", "–" where there is none."""
    if math.isnan(value):
        return "–"
    return format(value, _METRICS[key.partition("_")[0]][1])


def _style(name: str, value: float, best: float, unranked: Sequence[str]) -> str:
    if name in unranked:
        return "dim"
    return "bold" if value == best else ""


def _label(key: str) -> str:
    metric, _, mask = key.partition("_")
    if metric == "temporal":
        return "change\nin time"
    where = {"": "image", "band": "borders"}.get(mask, mask)
    return f"{_METRICS[metric][0]}\n{where}"


def _best(key: str, values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return math.nan
    return min(known) if _METRICS[key.partition("_")[0]][2] == "less" else max(known)
