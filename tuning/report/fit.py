"""The report of a fit: one HTML page with tables, sliders, error maps, curves and the evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from markupsafe import Markup

from torchblur.filters import get_filter
from torchblur.params import Param
from tuning.config.fit import TuneConfig
from tuning.data.cases import AnyCase, SequenceCase
from tuning.data.variants import Variant, shown_image, shown_reference
from tuning.files.run_folder import RunFolder
from tuning.report.front import front_section, preset_names
from tuning.report.page import (
    FIGURES,
    OF_SEQUENCES,
    Column,
    Row,
    Table,
    View,
    make_view,
    render_page,
    short_text,
)
from tuning.report.plots import loss_curves, parameter_paths
from tuning.report.sensitivity import slope_rows
from tuning.report.sequence_plots import score_curves
from tuning.results.fit import (
    CaseScore,
    FitResult,
    MethodResult,
    ParameterResult,
    cut_text,
    height_name,
    worse_text,
)

__all__ = [
    "Verdict",
    "default_label",
    "figures_table",
    "figures_tables",
    "verdict_of",
    "write_report",
]

_MAX_VIEWS = 8
_NOTES = {
    "sharp": "no filter",
    "input": "the stream as it is",
    "line": "line blur along each pixel's own motion",
    "start": "before the fit: the fixed values of the config",
    "tuned": "after the fit",
    "ceiling": "parameters fitted to each frame alone",
    "noise": "a perfect image",
}
_UNRANKED = ("ceiling", "noise")
_CURVES = ("default", "tuned", "line", "sharp", "input")
_SPLITS = {"train": "Training", "holdout": "Hold-out"}
_EXPLAINED = {
    "line": "“line” is Rosado's line blur with its own defaults.",
    "ceiling": "“ceiling” is the best that this filter does when its smooth parameters suit one "
    "frame alone: no common set of them can be expected to be better.",
    "noise": "“noise” is what a perfect image would score against references that have this much "
    "noise of their own, an upper estimate: figures near it cannot be told from perfect.",
}


@dataclass(frozen=True)
class Verdict:
    """The result in one sentence.

    Args:
        good: Whether the fit made things better where it counts.
        text: The sentence.
    """

    good: bool
    text: str


def write_report(
    folder: RunFolder,
    config: TuneConfig,
    result: FitResult,
    cases: Sequence[AnyCase],
    variants: Sequence[Variant],
) -> Path:
    """Write `report.html` into a run folder.

    Args:
        folder: The run; its log, config.yaml and preset.yaml are read.
        config: The resolved configuration.
        result: The run's result.
        cases: Frames and sequences of both splits; of a sequence the middle one of its scored
            frames is shown, and the curves over all of them.
        variants: What was scored; sharp, input, line, default, presets and tuned are shown.

    Returns:
        Where it lies.
    """
    order = _order(result)
    shown = sorted([v for v in variants if v.name in order], key=lambda v: order.index(v.name))
    # Hold-out first: these are the frames that say something.
    ordered = sorted(cases, key=lambda case: case.split != "holdout")
    views = [_view(i, case, shown) for i, case in enumerate(ordered[:_MAX_VIEWS])]
    records = folder.records()
    importances = next((m.importances for m in result.methods if m.importances), {})
    page = render_page(
        "fit.html",
        result=result,
        train_text=_counted([case for case in cases if case.split == "train"]),
        verdict=verdict_of(result),
        notes=(*result.notes, *([f"Tuned: {cut}"] if (cut := cut_text(result, "tuned")) else [])),
        tables=figures_tables(result),
        explanations=[text for n, text in _EXPLAINED.items() if n in result.variants()],
        front=front_section(result),
        views=views,
        left_out=len(ordered) - len(views),
        curves=_curves(ordered[:_MAX_VIEWS], result),
        parameter_rows=_parameter_rows(result, importances),
        slope_rows=slope_rows(result),
        importances=importances,
        losses=loss_curves(result, records),
        method_rows=_method_rows(result),
        paths=_paths(result, records),
        case_table=_case_table(result),
        config_text=(folder.path / "config.yaml").read_text(encoding="utf-8"),
        preset_text=(folder.path / "preset.yaml").read_text(encoding="utf-8"),
    )
    return folder.write("report.html", page)


def verdict_of(result: FitResult) -> Verdict:
    """Return what came out of a fit in one sentence, judged on the hold-out if there is one."""
    split = "holdout" if result.mean("tuned", "holdout", "flip") is not None else "train"
    where = "hold-out frames, which the fit never saw" if split == "holdout" else "training frames"
    before, after = (result.mean(v, split, "flip") for v in ("default", "tuned"))
    if result.chosen == "start":
        return Verdict(False, "No method found anything better than the start values.")
    assert before is not None
    assert after is not None
    change = _percent(after / before - 1) if before > 0 else ""
    text = f"On the {where}, FLIP goes from {before:.4f} to {after:.4f} ({change})"
    psnr = [result.mean(variant, split, "psnr") for variant in ("default", "tuned")]
    if None not in psnr:
        text += f", PSNR from {psnr[0]:.2f} to {psnr[1]:.2f} dB"
    text += f". {_at_borders(result, split)}" if result.mean("tuned", split, "flip_band") else ""
    line = result.mean("line", split, "flip")
    if line is not None:
        beaten = "beats" if after < line else "does not beat"
        text += f". The tuned filter {beaten} a plain line blur (FLIP {line:.4f})"
    if len(result.heights("holdout")) > 1 and (worse := worse_text(result, "tuned")):
        text += f". {worse.removesuffix('.')}"
    return Verdict(after < before, text + ".")


def _at_borders(result: FitResult, split: str) -> str:
    figures = [result.mean(v, split, "flip_band") for v in ("default", "tuned", "line")]
    before, after, line = (math.nan if value is None else value for value in figures)
    text = f"At moving borders FLIP goes from {before:.4f} to {after:.4f}"
    return text if math.isnan(line) else f"{text}; the line blur has {line:.4f} there"


def default_label(kind: str) -> str:
    """Return what a filter with its default values is called."""
    return "as published" if get_filter(kind).published else "with its defaults"


def figures_tables(result: FitResult) -> list[Table]:
    """Return the means of all variants: over the hold-out, at each of its heights, and training."""
    groups = [("holdout", lines) for lines in result.height_groups()]
    tables = [figures_table(result, *group) for group in (*groups, ("train", None))]
    return [table for table in tables if table is not None]


def figures_table(result: FitResult, split: str, lines: int | None = None) -> Table | None:
    """Return the means of all variants over a split, or None if it has no frames.

    Args:
        result: A fit's result.
        split: "train" or "holdout".
        lines: One of the heights of its images; over all of them if left out.
    """
    scores = [s for s in result.scores if s.split == split and lines in (None, s.lines)]
    are_sequences = any(score.frames for score in scores)
    columns = {k: c for k, c in FIGURES.items() if are_sequences or k not in OF_SEQUENCES}
    rows = [
        Row(
            name=variant,
            values=[result.mean(variant, split, metric, lines) for metric in columns],
            note=default_label(result.filter) if variant == "default" else _NOTES.get(variant, ""),
            ranked=variant not in _UNRANKED,
            strong=variant == "tuned",
        )
        for variant in result.variants()
        if result.mean(variant, split, "flip", lines) is not None
    ]
    if not rows:
        return None
    counted = [
        _count(len({score.case for score in scores if bool(score.frames) == several}), name)
        for several, name in ((False, "frame"), (True, "sequence"))
    ]
    is_part = split == "holdout" and len(result.height_groups()) > 1
    where = f", {height_name(lines)}" if is_part else ""
    title = f"{_SPLITS[split]}{where}: {' and '.join(text for text in counted if text)}"
    return Table(title=title, columns=list(columns.values()), rows=rows)


def _counted(cases: Sequence[AnyCase]) -> str:
    sequences = sum(isinstance(case, SequenceCase) for case in cases)
    texts = [_count(len(cases) - sequences, "reference frame"), _count(sequences, "sequence")]
    return " and ".join(text for text in texts if text)


def _count(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}" if number else ""


def _order(result: FitResult) -> tuple[str, ...]:
    """Return the images that are shown, in order; presets from cheap to dear."""
    return (*_CURVES[:1], *preset_names(result), *_CURVES[1:])


# -- sections --------------------------------------------------------------------------------------


def _view(index: int, case: AnyCase, variants: Sequence[Variant]) -> View:
    chosen = [v for v in variants if v.fits(case)]
    title = case.name
    if isinstance(case, SequenceCase):
        title = f"{case.name}, frame {case.labels[case.middle]}"
    images = {variant.name: shown_image(variant, case).cpu() for variant in chosen}
    return make_view(
        str(index),
        title,
        images,
        shown_reference(case).cpu(),
        subtitle=f"{_SPLITS[case.split]} · shutter {case.shutter.open:g} frame, "
        f"{case.shutter.position}",
        mapped=[name for name in ("default", "tuned", "line") if name in images],
        right="tuned",
    )


def _curves(cases: Sequence[AnyCase], result: FitResult) -> list[tuple[str, Markup]]:
    """Return name and plot of each sequence."""
    return [
        (
            case.name,
            score_curves(
                [s for s in result.scores if s.case == case.name], _CURVES, f"over{index}"
            ),
        )
        for index, case in enumerate(cases)
        if isinstance(case, SequenceCase)
    ]


def _parameter_rows(result: FitResult, importances: dict[str, float]) -> list[dict[str, Any]]:
    rises = [p.sensitivity for p in result.parameters if p.sensitivity is not None]
    largest = max([rise for rise in rises if math.isfinite(rise)], default=0.0)
    return [_parameter_row(p, largest, importances) for p in result.parameters]


def _parameter_row(
    parameter: ParameterResult, largest: float, importances: dict[str, float]
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": parameter.name,
        "symbol": parameter.symbol,
        "unit": "" if parameter.unit == "1" else parameter.unit,
        "default": short_text(parameter.default),
        "tuned": short_text(parameter.tuned),
        "low": short_text(parameter.low),
        "high": short_text(parameter.high),
        "choices": ", ".join(str(choice) for choice in parameter.choices),
        "bar": _bar(parameter),
        "at_end": parameter.tuned in (parameter.low, parameter.high) and not parameter.choices,
        "meaning": parameter.meaning,
        "source": parameter.source,
        "importance": _percent(importances.get(parameter.name, 0.0), sign=""),
        "rise": "",
        "rise_width": 0.0,
    }
    if parameter.sensitivity is not None:
        share = parameter.sensitivity / largest if largest > 0 else 0.0
        row |= {
            "rise": _percent(parameter.sensitivity, digits=2),
            "rise_width": round(100 * min(max(share, 0.0), 1.0), 1),
        }
    return row


def _bar(parameter: ParameterResult) -> tuple[float, float] | None:
    """Return where default and tuned value lie in the range, in percent."""
    if parameter.low is None or parameter.high is None:
        return None
    is_log = parameter.scale == "log"
    spec = Param(
        meaning="",
        grad="smooth",
        source="",
        low=parameter.low,
        high=parameter.high,
        scale="log" if is_log else "linear",
    )
    default, tuned = (_place(spec, value) for value in (parameter.default, parameter.tuned))
    return default, tuned


def _place(spec: Param, value: float) -> float:
    unit = float(spec.to_unit(torch.tensor(float(value), dtype=torch.float64)))
    return round(100 * min(max(unit, 0.0), 1.0), 1)


def _method_rows(result: FitResult) -> list[dict[str, Any]]:
    return [
        {
            "name": method.name,
            "chosen": method.name == result.chosen,
            "objective": f"{method.objective:.5f}",
            "change": _percent(method.objective / result.start_objective - 1)
            if result.start_objective > 0
            else "–",
            "evaluations": method.evaluations,
            "passes": f"{method.passes:.0f}" if method.passes else "–",
            "found": _found(method),
            "dropped": method.dropped,
            "seconds": f"{method.seconds:.1f}",
            "cpu_seconds": f"{method.cpu_seconds:.1f}" if method.cpu_seconds else "–",
            "starts": [
                "dropped" if start.objective is None else f"{start.objective:.5f}"
                for start in method.starts
            ],
        }
        for method in result.methods
    ]


def _found(method: MethodResult) -> str:
    """Return what became of a search's trials beside those that are complete."""
    counts = {"pruned": method.pruned, "polished": method.polished}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def _paths(result: FitResult, records: Sequence[dict[str, Any]]) -> list[tuple[str, str, Markup]]:
    return [
        (method.name, method.kind, parameter_paths(result, records, index))
        for index, method in enumerate(result.methods)
    ]


def _case_table(result: FitResult) -> Table:
    by_case: dict[str, dict[str, CaseScore]] = {}
    for score in result.scores:
        by_case.setdefault(score.case, {})[score.variant] = score
    shown = {"flip": ("FLIP", 4), "psnr": ("PSNR", 2), "flip_band": ("FLIP, borders", 4)}
    both = ("default", "tuned")
    if any(result.cuts(name, split) for name in both for split in _SPLITS):
        shown["cut"] = ("cut, %", 1)
    rows = []
    for case, variants in by_case.items():
        values = [_case_figure(variants[name], metric) for metric in shown for name in both]
        note = _SPLITS[variants["tuned"].split].lower()
        rows.append(Row(name=case, values=values, note=note))
    columns = [
        Column(name=f"{label} {what}", digits=digits)
        for label, digits in shown.values()
        for what in ("before", "after")
    ]
    return Table(title="", columns=columns, rows=rows)


def _case_figure(score: CaseScore, metric: str) -> float | None:
    if metric == "cut":
        return None if score.cut is None else 100 * score.cut
    return score.scores[metric]


def _percent(value: float, *, digits: int = 1, sign: str = "+") -> str:
    return f"{100 * value:{sign}.{digits}f} %".replace("-", "−")
