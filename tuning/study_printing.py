"""How a study looks in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from tuning.console import metrics_table, results
from tuning.experiments.study.run import FACTS, Row

__all__ = ["print_study"]


def print_study(rows: Sequence[Row]) -> None:
    """Print FLIP, PSNR and SSIM of all variants, a table for each data and reference."""
    rows = [row for row in rows if row.variant != FACTS]
    for data, reference in dict.fromkeys((row.data, row.reference) for row in rows):
        table = {
            row.variant: _row_means(row)
            for row in rows
            if (row.data, row.reference) == (data, reference)
        }
        results.print(metrics_table(f"{data}, {reference}", table))


def _row_means(row: Row) -> dict[str, float]:
    means = {key: row.mean(key) for key in ("flip", "flip_median", "psnr", "ssim")}
    return {key: float("nan") if value is None else value for key, value in means.items()}
