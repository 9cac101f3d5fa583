"""The card of a preset, in Markdown: how it was made, before and after, where it is worse.

All of it comes from the files of a run; nothing is typed by hand.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torchblur.filters import get_filter
from torchblur.params import declared
from torchblur.presets import Preset
from tuning.config.data import DataItem
from tuning.config.fit import TuneConfig
from tuning.report.fit import default_label, figures_tables
from tuning.report.front import front_section
from tuning.report.front_files import front_method
from tuning.report.page import FIGURES, Row, Table, render_page
from tuning.results.fit import FitResult, ParameterResult, cut_text, worse_text
from tuning.results.front import ParetoResult

__all__ = ["Card", "card_text"]

_SPLITS = {"holdout": "Hold-out", "train": "Training"}
_LABELS = {
    "sharp": "sharp",
    "input": "the stream as it is",
    "line": "line blur",
    "start": "where the fit began",
    "noise": "a perfect image",
}
_RIVALS = ("default", "line")
_NAMED = 2  # columns before the figures
_Figures = dict[str, dict[str, float | None]]


@dataclass(frozen=True, kw_only=True)
class Card:
    """What a card is made of.

    Args:
        name: Of the preset: "guertin2014-tuned".
        preset: The preset.
        config: The configuration of its run, resolved.
        result: The result of the run.
        variant: Its name among what the run scored: "tuned", or that of a quality level.
    """

    name: str
    preset: Preset
    config: TuneConfig
    result: FitResult
    variant: str

    @property
    def rival(self) -> str:
        """What the filter with its default values is called."""
        return default_label(self.preset.filter)

    @property
    def label(self) -> str:
        """What the preset is called in tables."""
        return f"`{self.name}`"


def card_text(card: Card, used: str, picture: str, caption: str, plot: str | None = None) -> str:
    """Return a card in Markdown.

    Args:
        card: What it is made of.
        used: Path of the preset, for the command that uses it.
        picture: Name of its picture, beside it.
        caption: What the picture shows.
        plot: Name of the plot of the front, beside it.
    """
    kind, result = get_filter(card.preset.filter), card.result
    splits = {"train": card.config.data.train, "holdout": card.config.data.holdout}
    return render_page(
        "card.md",
        card=card,
        used=used,
        picture=picture,
        caption=caption,
        plot=plot,
        worse=worse_text(result, card.variant),
        cut=cut_text(result, card.variant),
        summary=" ".join((kind.__doc__ or "").split()).split(". ")[0].rstrip("."),
        heights=_heights(result),
        time=_time(result),
        figures=[_figures(table, card) for table in figures_tables(result)],
        losses=_losses(card),
        level=_level(card),
        origin="published" if kind.published else "default",
        parameters=_parameters(card),
        lengths=_lengths(card),
        data=[
            [_SPLITS[split].lower(), item.kind, f"`{item.path}`", *_about(item)]
            for split, items in splits.items()
            for item in items
        ],
        objective=_objective(card),
        methods=[
            [
                method.name,
                method.evaluations,
                f"{method.objective:.5f}",
                f"{method.cpu_seconds:.0f}",
                "chosen" if method.name == result.chosen else "",
            ]
            for method in result.methods
        ],
        versions=", ".join(f"{name} {version}" for name, version in result.versions.items()),
    )


def _heights(result: FitResult) -> str:
    """Return at which heights of images it was fitted and held out, if the result says it."""
    return "".join(
        f" {what} {' and '.join(map(str, heights))} lines"
        for split, what in (("train", "of"), ("holdout", "and held out at"))
        if (heights := result.heights(split))
    )


def _time(result: FitResult) -> str:
    seconds = sum(method.cpu_seconds for method in result.methods)
    return f"{seconds / 60:.1f} CPU-minutes" if seconds >= 60 else f"{seconds:.0f} CPU-seconds"


# -- before and after ------------------------------------------------------------------------------


def _figures(table: Table, card: Card) -> tuple[str, list[str], list[list[str]]]:
    """Return title, headings and cells of a table of means."""
    names = _LABELS | {"default": card.rival, card.variant: card.label}
    rows = [
        Row(name=names[row.name], values=row.values, ranked=row.ranked)
        for row in table.rows
        if row.name in names
    ]
    return table.title, *_cells(Table(title="", columns=table.columns, rows=rows))


def _cells(table: Table) -> tuple[list[str], list[list[str]]]:
    rows = []
    for row in table.rows:
        cells = [table.text(row, index) for index in range(len(table.columns))]
        best = [table.is_best(row, index) for index in range(len(table.columns))]
        pairs = zip(cells, best, strict=True)
        rows.append([row.name, *(f"**{cell}**" if bold else cell for cell, bold in pairs)])
    return ["", *(column.name for column in table.columns)], rows


# -- where it is worse -----------------------------------------------------------------------------


def _losses(card: Card) -> dict[str, Any]:
    """Return the frames on which the preset is worse than what it is compared with."""
    scores: dict[tuple[str, str], _Figures] = {}
    for score in card.result.scores:
        scores.setdefault((score.split, score.case), {})[score.variant] = score.scores
    keys = [key for key in FIGURES if any(key in found[card.variant] for found in scores.values())]
    rows, counts = [], []
    for split, label in _SPLITS.items():
        cases = {case: found for (s, case), found in scores.items() if s == split}
        cells = {case: [_loss(found, card, key) for key in keys] for case, found in cases.items()}
        worse = {case: row for case, row in cells.items() if any(row)}
        rows += [[case, label.lower(), *row] for case, row in worse.items()]
        if cases:
            counts.append(f"{len(worse)} of {len(cases)} {label.lower()} frames")
    rivals = " or ".join(
        {"default": f"the filter {card.rival}", "line": "the line blur"}[name]
        for name in _RIVALS
        if name in card.result.variants()
    )
    head = ["frame", "", *(FIGURES[key].name for key in keys)]
    kept = [i for i in range(len(head)) if i < _NAMED or any(row[i] for row in rows)]
    return {
        "counts": " and ".join(counts),
        "rivals": rivals,
        "head": [head[i] for i in kept],
        "rows": [[row[i] for i in kept] for row in rows],
    }


def _loss(found: _Figures, card: Card, key: str) -> str:
    """Return a figure and those that are better, or nothing if none is."""
    digits, sign = FIGURES[key].digits, -1 if FIGURES[key].better == "low" else 1
    mine = found[card.variant].get(key)
    if mine is None:
        return ""
    names = {"default": card.rival, "line": _LABELS["line"]}
    better = [
        f"{names[name]} {value:.{digits}f}"
        for name in _RIVALS
        if name in found
        and (value := found[name].get(key)) is not None
        and sign * round(value, digits) > sign * round(mine, digits)
    ]
    return f"{mine:.{digits}f} ({', '.join(better)})" if better else ""


# -- the level, the parameters, how it was made ----------------------------------------------------


def _level(card: Card) -> dict[str, Any] | None:
    """Return how the preset stands among the others of its front, if it is one of several."""
    section, method = front_section(card.result), front_method(card.result)
    if card.variant == "tuned" or section is None or method is None or method.pareto is None:
        return None
    rows = [
        Row(name=f"**{row.name}**" if row.name == card.variant else row.name, values=row.values)
        for row in section.presets.rows
    ]
    head, cells = _cells(Table(title="", columns=section.presets.columns, rows=rows))
    budget = next(pick.budget for pick in method.pareto.picks if pick.name == card.variant)
    return {
        "tried": section.tried,
        "budget": f"{budget:g}",
        "beside_published": _beside_published(method.pareto, card.rival),
        "head": head,
        "rows": cells,
    }


def _beside_published(found: ParetoResult, label: str) -> str:
    """Return what the front pays for the quality of the filter with its default values."""
    published = next(mark for mark in found.landmarks if mark.origin == "published")
    front = [found.point(number) for number in found.front]
    costs = [point.cost for point in front if point.objective <= published.objective]
    dearer = f"{label[0].upper()}{label[1:]} the filter costs {published.cost:.3g}; "
    if not costs:
        return dearer + "no setting that was tried is as good on the training frames."
    return dearer + (
        "on the training frames the cheapest setting that was tried and is as good costs "
        f"{min(costs):.3g}."
    )


def _parameters(card: Card) -> list[list[str]]:
    of = get_filter(card.preset.filter)
    specs, default = declared(of.config_class), of.config_class()
    free = {parameter.name: parameter for parameter in card.result.parameters}
    rows = []
    for name in [n for n in specs if n in free or n in card.preset.params]:
        spec, published = specs[name], getattr(default, name)
        value = card.preset.params.get(name, published)
        unit = "" if spec.unit == "1" else spec.unit
        cells = (f"`{name}`", _value(published), _value(value), unit, _range(free.get(name)))
        rows.append([*cells, spec.meaning])
    return rows


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _range(parameter: ParameterResult | None) -> str:
    if parameter is None:
        return "fixed"
    if parameter.choices:
        return ", ".join(_value(choice) for choice in parameter.choices)
    return f"{_value(parameter.low)} to {_value(parameter.high)}"


def _lengths(card: Card) -> str:
    """Return which parameters are lengths in px, and of which sizes of images."""
    specs = declared(get_filter(card.preset.filter).config_class)
    names = [f"`{p.name}`" for p in card.result.parameters if specs[p.name].unit == "px"]
    sizes = set(map(_size, (*card.config.data.train, *card.config.data.holdout)))
    if not names or not sizes - {""}:
        return ""
    return f"{', '.join(names)}: in px, fitted to images of {' and '.join(sorted(sizes - {''}))}."


def _size(item: DataItem) -> str:
    return str(getattr(item, "size", ""))


def _about(item: DataItem) -> list[str]:
    seeds = getattr(item, "seeds", None)
    frames = getattr(item, "frames", None)
    which = "" if not frames else f"frame{'s' if len(frames) > 1 else ''} {_span(frames)}"
    if seeds is not None:
        which = f"seeds {_span(tuple(seeds))}, {which}"
    spp, weight = getattr(item, "spp", ""), "" if item.weight is None else f"{item.weight:g}"
    shutter = f"{item.shutter:g}, {item.shutter_position}"
    return [which or "all", _size(item), str(spp), shutter, weight]


def _span(numbers: Sequence[float]) -> str:
    whole = len(numbers) > 2 and all(b - a == 1 for a, b in itertools.pairwise(numbers))
    if whole:
        return f"{numbers[0]:g} to {numbers[-1]:g}"
    return ", ".join(f"{number:g}" for number in numbers)


def _objective(card: Card) -> str:
    result, spec = card.result, card.config.objective
    objective = {"terms": spec.terms} | spec.model_dump(mode="json", exclude_defaults=True)
    text = f"Objective: {', '.join(f'{name} {_flow(value)}' for name, value in objective.items())}."
    if card.variant == "tuned":
        text += f" On the training frames {result.start_objective:.5f} → {result.objective:.5f}."
    return text


def _flow(value: Any) -> str:
    if not isinstance(value, dict):
        return f"{value}"
    return "{" + ", ".join(f"{name}: {weight:g}" for name, weight in value.items()) + "}"
