"""What a crossfit's figures come to: intervals of each case, means over the cases, targets."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tuning.experiments.crossfit.bootstrap import Figure, draws_of, figures_of, summarize
from tuning.experiments.crossfit.config import CrossfitConfig, Target
from tuning.experiments.crossfit.run import Crossfit, Scored
from tuning.results.cuts import cuts_over

__all__ = [
    "MEAN",
    "Row",
    "Verdict",
    "cut_texts",
    "final_variants",
    "is_met",
    "mean_names",
    "summary_of",
    "verdicts",
]

MEAN = "mean"
"""Stands for the name of a case in the means over all of them."""

_Drawn = Mapping[tuple[str, str], Mapping[str, np.ndarray]]  # by filter and variant, by figure


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
    cases = {case: _drawn(config, found, case) for case in config.data.cases}
    rows = [
        _row(config, case, key, values)
        for case, filters in cases.items()
        for key, values in filters.items()
    ]
    heights = sorted({lines for one in found.scored for lines in one.heights}, reverse=True)
    for lines in heights if len(heights) > 1 else ():
        parts = [_drawn(config, found, case, lines) for case in config.data.cases]
        rows += _means(config, f"{MEAN}, {lines} lines", [part for part in parts if part])
    return rows + _means(config, MEAN, list(cases.values()))


def mean_names(config: CrossfitConfig, rows: Sequence[Row]) -> tuple[str, ...]:
    """Return what stands for the name of a case in means: of each height if several, then of all.

    Args:
        config: The crossfit.
        rows: What `summary_of` returned.
    """
    return tuple(dict.fromkeys(row.case for row in rows if row.case not in config.data.cases))


def cut_texts(config: CrossfitConfig, found: Crossfit) -> list[str]:
    """Return what each filter cuts short, as it is judged, a sentence each; nothing if nothing.

    Args:
        config: The crossfit.
        found: What `run_crossfit` returned.
    """
    texts = []
    for name, variant in final_variants(config, found).items():
        every = [s for s in found.scored if (s.filter, s.variant) == (name, variant)]
        cuts = cuts_over([cut for one in every for cut in one.cuts])
        if cuts is not None:
            texts.append(f"{name} {variant}: {cuts.text('frames')}.")
    return texts


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


def _drawn(config: CrossfitConfig, found: Crossfit, case: str, lines: int | None = None) -> _Drawn:
    """Return a case's figures at each draw by filter and variant; of one height's frames alone."""
    own = {
        _key(one): one.sums if lines is None else one.heights[lines]
        for one in found.scored
        if one.case == case and (lines is None or lines in one.heights)
    }
    if not own:
        return {}
    line = own["line", "default"]
    seed = [zlib.crc32(case.encode()), *([] if lines is None else [lines])]
    draws = draws_of(len(line), config.bootstrap, seed)
    return {key: figures_of(sums, line, draws) for key, sums in own.items()}


def _means(config: CrossfitConfig, name: str, cases: Sequence[_Drawn]) -> list[Row]:
    """Return the means over cases of each filter that all of them have."""
    rows = []
    for key in dict.fromkeys(key for filters in cases for key in filters):
        every = [filters[key] for filters in cases if key in filters]
        if len(every) == len(cases):
            # A case without an own figure, such as one without a band, does not count.
            known = {n: [one[n] for one in every if np.isfinite(one[n][0])] for n in every[0]}
            nothing = np.full_like(every[0]["flip"], np.nan)
            means = {n: np.mean(some, axis=0) if some else nothing for n, some in known.items()}
            rows.append(_row(config, name, key, means))
    return rows


def _key(one: Scored) -> tuple[str, str]:
    return one.filter, one.variant


def _row(
    config: CrossfitConfig, case: str, key: tuple[str, str], values: Mapping[str, np.ndarray]
) -> Row:
    level = config.bootstrap.level
    figures = {name: summarize(some, level) for name, some in values.items()}
    return Row(case=case, filter=key[0], variant=key[1], figures=figures)
