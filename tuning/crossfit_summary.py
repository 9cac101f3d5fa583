"""What a crossfit's figures come to: intervals of each case, means over the cases, targets."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tuning.crossfit import Crossfit, Scored
from tuning.crossfit_config import CrossfitConfig, Target
from tuning.crossfit_tiles import Figure, draws_of, figures_of, summarize

__all__ = ["MEAN", "Row", "Verdict", "final_variants", "is_met", "summary_of", "verdicts"]

MEAN = "mean"
"""Stands for the name of a case in the means over all of them."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Figures of a filter on a case, or their means.

    Args:
        case: Its name; `MEAN` for the mean of the cases' figures.
        filter: Name of the filter's entry.
        variant: As in `Scored`.
        figures: By the names in `METRICS` and `GAINS`.
    """

    case: str
    filter: str
    variant: str
    figures: Mapping[str, Figure]

    @property
    def label(self) -> str:
        """Name for tables."""
        return f"{self.filter} {self.variant}".strip()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether a filter meets a target on a case.

    Args:
        case: The case.
        filter: Name of the filter's entry.
        target: Name of the figure.
        met: Whether its value does.
        sure: Whether all of its interval is on that side.
    """

    case: str
    filter: str
    target: Target
    met: bool
    sure: bool

    @property
    def text(self) -> str:
        """In words."""
        return f"{'met' if self.met else 'not met'}{'' if self.sure else '?'}"


def summary_of(config: CrossfitConfig, found: Crossfit) -> list[Row]:
    """Return the rows of each case, then their means.

    All filters share the draws of a case. A mean's interval is of the mean of the cases' draws:
    it tells how far the tiles of these cases leave it open, not what other cases would give.

    Args:
        config: The crossfit.
        found: What `run_crossfit` returned.
    """
    rows, values = [], {}
    for case in config.data.cases:
        own = [one for one in found.scored if one.case == case]
        line = next(one for one in own if one.filter == "line" and one.variant == "default")
        draws = draws_of(len(line.sums), config.bootstrap, [zlib.crc32(case.encode())])
        for one in own:
            values[case, _key(one)] = figures_of(one.sums, line.sums, draws)
            rows.append(_row(config, case, _key(one), values[case, _key(one)]))
    for key in dict.fromkeys(_key(one) for one in found.scored):
        every = [values[case, key] for case in config.data.cases if (case, key) in values]
        if len(every) == len(config.data.cases):
            # A case without an own figure, such as one without a band, does not count.
            known = {
                name: [one[name] for one in every if np.isfinite(one[name][0])] for name in every[0]
            }
            nothing = np.full_like(every[0]["flip"], np.nan)
            means = {n: np.mean(some, axis=0) if some else nothing for n, some in known.items()}
            rows.append(_row(config, MEAN, key, means))
    return rows


def final_variants(config: CrossfitConfig, found: Crossfit) -> dict[str, str]:
    """Return the variant by which each filter is judged: tuned, else given, else its default."""
    last = {}
    for one in found.scored:
        if one.filter in config.filters:
            last[one.filter] = one.variant
    return last


def verdicts(config: CrossfitConfig, found: Crossfit, rows: list[Row]) -> list[Verdict]:
    """Return whether each filter but `line` meets each target, on each case and in the mean.

    Args:
        config: The crossfit.
        found: What `run_crossfit` returned.
        rows: What `summary_of` returned.
    """
    final = final_variants(config, found)
    judged = [
        row
        for row in rows
        if final.get(row.filter) == row.variant and (row.filter, row.variant) != ("line", "default")
    ]
    return [
        Verdict(
            case=row.case,
            filter=row.filter,
            target=target,
            met=is_met(target, row.figures[target].value, limit),
            sure=_is_sure(target, row.figures[target], limit),
        )
        for row in judged
        for target, limit in config.targets.items()
        if row.figures[target].value is not None
    ]


def is_met(target: Target, value: float | None, limit: float) -> bool:
    """Return whether a ratio is small enough, or a gain great enough."""
    if value is None:
        return False
    return value <= limit if target.endswith("ratio") else value >= limit


def _is_sure(target: Target, figure: Figure, limit: float) -> bool:
    if figure.low is None or figure.high is None:
        return False
    return is_met(target, figure.low, limit) == is_met(target, figure.high, limit)


def _key(one: Scored) -> tuple[str, str]:
    return one.filter, one.variant


def _row(
    config: CrossfitConfig, case: str, key: tuple[str, str], values: Mapping[str, np.ndarray]
) -> Row:
    level = config.bootstrap.level
    figures = {name: summarize(some, level) for name, some in values.items()}
    return Row(case=case, filter=key[0], variant=key[1], figures=figures)
