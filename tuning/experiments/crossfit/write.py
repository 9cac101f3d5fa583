"""What a crossfit is written to: JSON with every figure, tables, points, a plot."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from tuning.experiments.crossfit.config import CrossfitConfig
from tuning.experiments.crossfit.plot import plot_crossfit
from tuning.experiments.crossfit.run import Crossfit, Fold
from tuning.experiments.crossfit.summary import (
    MEAN,
    Row,
    cut_texts,
    mean_names,
    summary_of,
    verdicts,
)
from tuning.experiments.tables import csv_text, json_text, markdown_table, write_texts
from tuning.report.page import short_text

__all__ = ["COLUMNS", "TARGETS", "UNSURE", "cell", "note_of", "write_crossfit"]

COLUMNS = {
    "flip": ("FLIP", ".4f"),
    "flip_ratio": ("to line", ".3f"),
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "flip_band": ("FLIP borders", ".4f"),
    "flip_band_ratio": ("to line, borders", ".3f"),
    "psnr_band": ("PSNR borders", ".2f"),
    "psnr_band_gain": ("gain over line, borders", "+.2f"),
    "ssim_band": ("SSIM borders", ".4f"),
}
"""Heading and format of each figure in the tables."""

TARGETS = {
    "flip_ratio": "FLIP at most {:g} of line's",
    "flip_band_ratio": "FLIP at borders at most {:g} of line's",
    "psnr_gain": "PSNR at least {:g} dB above line's",
    "psnr_band_gain": "PSNR at borders at least {:g} dB above line's",
}
"""What targets ask for."""

UNSURE = "Targets: “?” where the interval reaches to the other side."
"""What a question mark says."""


def write_crossfit(folder: Path, config: CrossfitConfig, found: Crossfit) -> list[Path]:
    """Write `tables.md`, `crossfit.json`, `points.csv` and `ratios.png`; older ones go.

    Args:
        folder: Where to.
        config: The crossfit.
        found: What `run_crossfit` returned.

    Raises:
        OutputError: a file cannot be written.
    """
    rows = summary_of(config, found)
    texts = {
        "tables.md": _markdown(config, found, rows),
        "crossfit.json": _json(config, found, rows),
        "points.csv": _csv(rows),
    }
    files = write_texts(folder, texts)
    plot = folder / "ratios.png"
    plot_crossfit(plot, config, found, rows)
    return [*files, plot]


def cell(row: Row, name: str, *, interval: bool = True) -> str:
    """Return a figure as text, "–" where there is none; with its interval if there is one."""
    figure, form = row.figures[name], COLUMNS[name][1]
    if figure.value is None:
        return "–"
    text = format(figure.value, form)
    if not interval or figure.low is None or figure.high is None:
        return text
    return f"{text} ({format(figure.low, form)} to {format(figure.high, form)})"


def note_of(config: CrossfitConfig) -> str:
    """Return what the tables show, in a few sentences."""
    boot = config.bootstrap
    return (
        "Tuned: fitted to all cases but the one that is scored. Given: the values in the file, "
        "not fitted. FLIP, SSIM and PSNR (linear, peak 1) over all pixels of a case's frames; "
        "borders: the band that moving borders sweep. Intervals: "
        f"{100 * boot.level:g} % of {boot.draws} draws of tiles of {boot.tile} px; ratios and "
        "gains are between the same tiles. Intervals tell of these images, not of other scenes."
    )


def _markdown(config: CrossfitConfig, found: Crossfit, rows: Sequence[Row]) -> str:
    lines = [f"# {config.title}", "", note_of(config), ""]
    head = ["", *(label for label, _ in COLUMNS.values())]
    means = mean_names(config, rows)
    for case in (*means, *config.data.cases):
        heading = case.replace(MEAN, "Mean over the cases") if case in means else case
        own = [row for row in rows if row.case == case]
        cells = [[row.label, *(cell(row, name) for name in COLUMNS)] for row in own]
        lines += [f"## {heading}", "", *markdown_table(head, cells)]
    cuts = cut_texts(config, found)
    if cuts:
        lines += ["## Cut short", "", *(f"- {text}" for text in cuts), ""]
    lines += _targets(config, found, list(rows))
    fitted = [name for name, entry in config.filters.items() if entry.is_fitted]
    if fitted:
        lines += ["## Fits", ""]
    for name in fitted:
        lines += _fits([fold for fold in found.folds if fold.filter == name])
    return "\n".join(lines)


def _targets(config: CrossfitConfig, found: Crossfit, rows: list[Row]) -> list[str]:
    if not config.targets:
        return []
    every = verdicts(config, found, rows)
    lines = ["## Targets", "", UNSURE, ""]
    for target, limit in config.targets.items():
        texts = {(v.filter, v.case): v.text for v in every if v.target == target}
        names = dict.fromkeys(name for name, _ in texts)
        cases = [*config.data.cases, *mean_names(config, rows)]
        head = [TARGETS[target].format(limit), *cases]
        lines += markdown_table(
            head, [[n, *(texts.get((n, c), "–") for c in cases)] for n in names]
        )
    return lines


def _fits(folds: Sequence[Fold]) -> list[str]:
    """Return a table of what the fits of a filter found: a column for each left-out case."""
    head = [folds[0].filter, "start", *(f"without {fold.case}" for fold in folds)]
    rows = [
        [name, short_text(folds[0].start[name]), *(short_text(fold.tuned[name]) for fold in folds)]
        for name in folds[0].start
    ]
    rows += [
        ["*objective before*", "", *(f"{fold.start_objective:.4g}" for fold in folds)],
        ["*objective after*", "", *(f"{fold.objective:.4g}" for fold in folds)],
        ["*found by*", "", *(fold.chosen for fold in folds)],
        ["*evaluations*", "", *(f"{fold.passes:.0f}" for fold in folds)],
        ["*CPU s*", "", *(f"{fold.cpu_seconds:.0f}" for fold in folds)],
    ]
    return markdown_table(head, rows)


def _json(config: CrossfitConfig, found: Crossfit, rows: list[Row]) -> str:
    return json_text(
        config,
        rows=[dataclasses.asdict(row) for row in rows],
        targets=[dataclasses.asdict(v) for v in verdicts(config, found, rows)],
        cut=cut_texts(config, found),
        folds=[dataclasses.asdict(fold) for fold in found.folds],
    )


def _csv(rows: Sequence[Row]) -> str:
    head = ("case", "filter", "variant", "metric", "value", "low", "high")
    lines = [
        (row.case, row.filter, row.variant, name, figure.value, figure.low, figure.high)
        for row in rows
        for name, figure in row.figures.items()
    ]
    return csv_text(head, lines)
