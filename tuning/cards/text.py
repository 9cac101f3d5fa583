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
from tuning.report.page import FIGURES, Row, Table
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
    parts = [
        f"# {card.name}",
        _head(card, used),
        f"![sharp, line blur, {card.rival}, {card.name}, reference]({picture})",
        caption,
        *_figures(card),
        *_worse(card),
        *_level(card, plot),
        *_parameters(card),
        *_made(card),
    ]
    return "\n\n".join(parts) + "\n"


def _head(card: Card, used: str) -> str:
    kind = get_filter(card.preset.filter)
    summary = " ".join((kind.__doc__ or "").split()).split(". ")[0].rstrip(".")
    worse, cut = (text(card.result, card.variant) for text in (worse_text, cut_text))
    return (
        (f"**{worse}**\n\n" if worse else "")
        + f"{summary}: `{card.preset.filter}` with constants that were fitted to references"
        f"{_heights(card.result)}.{f' Mind its reach: {cut}' if cut else ''}\n\n"
        f"```\n{card.result.command}\ntorchblur filter {used} INPUT.exr -o OUTPUT.exr\n```\n\n"
        f"The first command makes it (search and gradient: {_time(card.result)}), the second uses "
        "it."
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


def _figures(card: Card) -> list[str]:
    parts = ["## Before and after"]
    for table in figures_tables(card.result):
        rows = [_named(row, card) for row in table.rows if _is_shown(row.name, card)]
        shown = Table(title="", columns=table.columns, rows=rows)
        parts += [f"{table.title}; means. The best of a column is bold.", _markdown(shown)]
    parts.append(
        "FLIP and SSIM are of display values, PSNR is in dB on linear color; “borders” is the band "
        "that moving borders sweep. “A perfect image” is what the reference's own noise leaves."
        if "noise" in card.result.variants()
        else "FLIP and SSIM are of display values, PSNR is in dB on linear color; “borders” is the "
        "band that moving borders sweep."
    )
    return parts


def _is_shown(name: str, card: Card) -> bool:
    return name in (*_LABELS, "default", card.variant)


def _named(row: Row, card: Card) -> Row:
    names = _LABELS | {"default": card.rival, card.variant: card.label}
    name = names[row.name]
    return Row(name=name, values=row.values, ranked=row.ranked)


def _markdown(table: Table) -> str:
    rows = []
    for row in table.rows:
        cells = [table.text(row, index) for index in range(len(table.columns))]
        best = [table.is_best(row, index) for index in range(len(table.columns))]
        pairs = zip(cells, best, strict=True)
        rows.append([row.name, *(f"**{cell}**" if bold else cell for cell, bold in pairs)])
    return _rows(["", *(column.name for column in table.columns)], rows)


def _rows(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# -- where it is worse -----------------------------------------------------------------------------


def _worse(card: Card) -> list[str]:
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
    title = "## Where it is worse"
    if not rows:
        return [title, f"Nowhere: on no frame is it worse than {rivals}, by any figure shown."]
    head = ["frame", "", *(FIGURES[key].name for key in keys)]
    kept = [i for i in range(len(head)) if i < _NAMED or any(row[i] for row in rows)]
    return [
        title,
        f"On {' and '.join(counts)} it is worse than {rivals} by at least one figure, as far as "
        "the digits show. Each cell has its figure and the better one of the other; where nothing "
        "stands it is not worse.",
        _rows([head[i] for i in kept], [[row[i] for i in kept] for row in rows]),
    ]


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


def _level(card: Card, plot: str | None) -> list[str]:
    section, method = front_section(card.result), front_method(card.result)
    if card.variant == "tuned" or section is None or method is None or method.pareto is None:
        return []
    pick = next(pick for pick in method.pareto.picks if pick.name == card.variant)
    rows = [
        Row(name=f"**{row.name}**" if row.name == card.variant else row.name, values=row.values)
        for row in section.presets.rows
    ]
    shown = [] if plot is None else [f"![Quality against cost, and the presets]({plot})"]
    return [
        "## Among the levels",
        f"The best of {section.tried} settings that cost at most {pick.budget:g} of Guertin 2014 "
        "with 35 taps. Cost is counted from the configuration: lookups, arithmetic and passes. "
        + _beside_published(method.pareto, card.rival),
        _markdown(Table(title="", columns=section.presets.columns, rows=rows)),
        *shown,
    ]


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


def _parameters(card: Card) -> list[str]:
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
    origin = "published" if of.published else "default"
    head = ["", origin, "here", "unit", "range of the fit", "meaning"]
    return ["## Parameters", _rows(head, rows), *_lengths(card, list(free))]


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


def _lengths(card: Card, free: Sequence[str]) -> list[str]:
    specs = declared(get_filter(card.preset.filter).config_class)
    names = [f"`{name}`" for name in free if specs[name].unit == "px"]
    sizes = {size for size in map(_size, _items(card.config)) if size}
    if not names or not sizes:
        return []
    return [f"{', '.join(names)}: in px, fitted to images of {' and '.join(sorted(sizes))}."]


def _items(config: TuneConfig) -> tuple[DataItem, ...]:
    return (*config.data.train, *config.data.holdout)


def _size(item: DataItem) -> str:
    return str(getattr(item, "size", ""))


def _made(card: Card) -> list[str]:
    result, config = card.result, card.config
    data = [
        [_SPLITS[split].lower(), item.kind, f"`{item.path}`", *_about(item)]
        for split, items in (("train", config.data.train), ("holdout", config.data.holdout))
        for item in items
    ]
    methods = [
        [
            method.name,
            str(method.evaluations),
            f"{method.objective:.5f}",
            f"{method.cpu_seconds:.0f}",
            "chosen" if method.name == result.chosen else "",
        ]
        for method in result.methods
    ]
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    return [
        "## How it was made",
        _rows(["", "data", "path", "which", "size", "samples", "shutter", "weight"], data),
        _objective(card),
        _rows(["method", "evaluations", "objective", "CPU-seconds", ""], methods),
        f"Seed {result.seed}. {versions}.",
        *(f"- {note}" for note in result.notes),
    ]


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
