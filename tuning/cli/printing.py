"""How results look in a terminal: parameters, findings about a file, plans, outcomes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from torchblur.filters import BlurFilter, get_filter, list_filters
from torchblur.io import Inspection
from torchblur.io.inspect import ChannelInfo
from torchblur.params import Param, choices, declared
from tuning.batch.run import BatchResult, Plan
from tuning.cli.console import (
    log,
    metrics_table,
    number_text,
    plain_table,
    print_error,
    print_warning,
    results,
)
from tuning.cli.reach_advice import SHUTTER, reach_advice
from tuning.experiments.ablation.run import AblationConfig, Measured
from tuning.experiments.ablation.write import RULE, tally
from tuning.experiments.study.run import FACTS, Row
from tuning.files.outputs import State
from tuning.report.front import preset_names
from tuning.results.fit import FitResult, cut_text, height_name

__all__ = [
    "print_ablation",
    "print_batch",
    "print_fit",
    "print_inspection",
    "print_parameters",
    "print_plan",
    "print_study",
    "schema_text",
]

_WIDE = 150
_SCORES = ("flip", "psnr", "ssim", "flip_band", "psnr_band", "ssim_band")
_OF_SEQUENCES = ("flip", "flip_median", "psnr", "ssim", "temporal", "flip_band")
_BOUNDS = ("ceiling", "noise")
_CLAIM_COLUMNS = (
    "claim",
    "verdict",
    "FLIP\noff, on",
    "better\nby",
    "PSNR\noff, on",
    "time\non/off",
)
_TONES = {"shows": "green", "does not show": "red", "mixed": "yellow"}
_SHOWN = ("sharp", "input", "line", "default", "start", "tuned", "ceiling", "noise")


# -- parameters --------------------------------------------------------------------------------


def print_parameters(filter_name: str | None = None) -> None:
    """Print the declared parameters of a filter, or of all.

    Raises:
        ConfigError: unknown filter.
    """
    filters = list_filters() if filter_name is None else {filter_name: get_filter(filter_name)}
    for name, kind in filters.items():
        summary = " ".join((kind.__doc__ or "").split()).split(". ")[0].rstrip(".")
        head = Text.assemble((name, "bold"), f"  {kind.__name__}: {summary}")
        results.print(head, soft_wrap=True)
        results.print(_parameters(kind))


def schema_text(filter_name: str | None = None) -> str:
    """Return the JSON Schema of a filter's parameters, or of all filters by name.

    Raises:
        ConfigError: unknown filter.
    """
    if filter_name is not None:
        schema: Any = get_filter(filter_name).config_class.model_json_schema()
    else:
        schema = {n: f.config_class.model_json_schema() for n, f in list_filters().items()}
    return json.dumps(schema, indent=2, ensure_ascii=False)


def _parameters(kind: type[BlurFilter]) -> Any:
    specs, default = declared(kind.config_class), kind.config_class()
    values = {name: _plain(getattr(default, name)) for name in specs}
    if results.width < _WIDE:
        return Group(*(_entry(kind, name, spec, values[name]) for name, spec in specs.items()))
    columns = ("name", "", "default", "range", "unit", "scale", "gradient", "meaning", "source")
    table = plain_table("", columns, right=("default",))
    for name, spec in specs.items():
        scale = spec.scale if spec.low is not None else ""
        unit = "" if spec.unit == "1" else spec.unit
        cells = (name, spec.symbol, values[name], _range(kind, name, spec), unit, scale)
        table.add_row(*map(Text, (*cells, spec.grad, _meaning(spec), spec.source)))
    return table


def _entry(kind: type[BlurFilter], name: str, spec: Param, default: str) -> Any:
    """Return a parameter as a paragraph, for narrow terminals."""
    symbol = f" ({spec.symbol})" if spec.symbol else ""
    unit = "" if spec.unit == "1" else f" {spec.unit}"
    scale = " log" if spec.scale == "log" else ""
    head = Text.assemble(
        (f"{name}{symbol}", "bold cyan"),
        f" = {default}",
        (f"   {_range(kind, name, spec)}{unit}{scale}, {spec.grad}", "green"),
    )
    text = Text.assemble(_meaning(spec), (f" ({spec.source})", "dim"))
    return Group(Padding(head, (0, 0, 0, 2)), Padding(text, (0, 0, 0, 6)))


def _meaning(spec: Param) -> str:
    return f"{spec.meaning}; acts when {spec.active_when}" if spec.active_when else spec.meaning


def _range(kind: type[BlurFilter], name: str, spec: Param) -> str:
    if spec.low is not None:
        low, high = spec.bounds
        return f"[{low:g}, {high:g}]"
    return " | ".join(_plain(value) for value in choices(kind.config_class, name))


def _plain(value: object) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


# -- a file ------------------------------------------------------------------------------------


def print_inspection(found: Inspection) -> None:
    """Print what was found about a file; warnings last, where they are seen."""
    results.print(Text(found.path, style="bold"), soft_wrap=True)
    for part in found.parts:
        name = f"part {part.name}, " if part.name else ""
        view = f"view {part.view}, " if part.view else ""
        window = part.data_window
        size = f"{window.width}x{window.height} px, {part.compression}"
        results.print(f"{name}{view}{size}", markup=False)
        results.print(_channels(part.channels))
    for name, text in _facts(found):
        results.print(Text.assemble((f"{name:<18}", "bold"), text), soft_wrap=True)
    if found.signs:
        _print_signs(found)
    for note in found.notes:
        results.print(Text(f"note: {note}"), soft_wrap=True)
    for warning in found.warnings:
        print_warning(warning)
    if not found.warnings:
        results.print(Text("nothing looks wrong", style="green"))


def _channels(channels: Sequence[ChannelInfo]) -> Table:
    has_bad = any(c.num_nan or c.num_inf for c in channels)
    columns = ["channel", "type", "least", "mean", "greatest", *(["NaN", "inf"] * has_bad)]
    table = plain_table("", columns, right=columns[2:])
    for c in channels:
        numbers = [Text(f"{value:.4g}") for value in (c.minimum, c.mean, c.maximum)]
        bad = [Text(str(n) if n else "", style="bold red") for n in (c.num_nan, c.num_inf)]
        table.add_row(Text(c.name), c.type, *numbers, *(bad if has_bad else []))
    return table


def _facts(found: Inspection) -> Iterable[tuple[str, str]]:
    if found.convention:
        yield "convention", f"{found.convention} (known from: {found.evidence})"
    for role, channels in found.recognized.items():
        yield role, ", ".join(channels)
    if found.velocity is not None:
        speed = found.velocity
        yield (
            "speed",
            f"{speed.moving_share:.1%} of the pixels move: median {speed.median:.1f}, 95 % "
            f"{speed.percentile_95:.1f}, greatest {speed.maximum:.1f} px/frame",
        )
        if speed.moving_share > 0:
            yield f"at shutter {SHUTTER:g}", reach_advice(speed.percentiles)
    if found.time is not None and found.time.is_stream:
        times = found.time
        yield (
            "a stream",
            f"times {times.minimum:.3f} to {times.maximum:.3f}, mean {times.mean:.3f}; distance "
            f"to uniform {times.distance:.3f}, correlation of neighbors {times.neighbors:.3f}",
        )
    if found.metadata:
        yield "metadata", json.dumps(dict(found.metadata), ensure_ascii=False)


def _print_signs(found: Inspection) -> None:
    table = plain_table("match with the reference", ["velocity", "PSNR dB"], right=["PSNR dB"])
    for match in found.signs:
        table.add_row(Text(match.change), f"{match.psnr:.2f}")
    results.print(table)


# -- batch runs --------------------------------------------------------------------------------


def print_plan(plan: Plan) -> None:
    """Print what a batch run would do, a line per frame."""
    for job, state in plan.states:
        what = {"to do": "make", "done": "skip", "out of date": "redo", "other": "REFUSE"}[state]
        what = "redo" if plan.overwrite and state != "to do" else what
        results.print(Text(f"{what:<6} {job.source} -> {job.output}"), soft_wrap=True)
    counts = [f"{n} {state}" for state in get_args(State) if (n := plan.count(state))]
    results.print(f"{len(plan.states)} frames: {', '.join(counts)}")


def print_batch(plan: Plan, result: BatchResult) -> None:
    """Print what became of a batch run; frames that failed last, each with its reason."""
    total = len(plan.states)
    skipped = f", {result.skipped} done before" if result.skipped else ""
    results.print(f"{len(result.written)} of {total} frames written{skipped}")
    for failure in result.failures:
        print_error(f"{failure.job.source}: {failure.reason}")
    if result.failures:
        log(f"{len(result.failures)} of {total} frames failed; the same command tries them again")
    if result.interrupted:
        left = total - result.skipped - len(result.written) - len(result.failures)
        print_error(f"stopped (Ctrl-C) with {left} frames left; the same command goes on")


# -- fits --------------------------------------------------------------------------------------


def print_fit(result: FitResult, folder: Path) -> None:
    """Print a fit's figures on training frames and hold-out, its parameters, and its files."""
    presets = preset_names(result)
    shown = [n for n in (*_SHOWN[:-3], *presets, *_SHOWN[-3:]) if n in result.variants()]
    heights = result.height_groups()
    tables = {"training frames": ("train", None)} | {
        "hold-out" if len(heights) == 1 else f"hold-out, {height_name(lines)}": ("holdout", lines)
        for lines in heights
    }
    for title, (split, lines) in tables.items():
        rows = {name: _means(result, name, split, lines) for name in shown}
        rows = {name: row for name, row in rows.items() if row["flip"] == row["flip"]}
        if rows:
            results.print(metrics_table(title, rows, highlight="tuned", unranked=_BOUNDS))
    table = plain_table("parameters", ["", "default", "tuned", "unit"], right=["default", "tuned"])
    for row in result.parameters:
        unit = "" if row.unit == "1" else row.unit
        table.add_row(Text(row.name), _plain_short(row.default), _plain_short(row.tuned), unit)
    results.print(table)
    cut = cut_text(result, "tuned")
    for note in (*result.notes, *([f"Tuned: {cut}"] if cut else [])):
        log(f"note: {note}")
    results.print(f"preset: {folder / 'preset.yaml'}", soft_wrap=True)
    if presets:
        names = ", ".join(f"{name}.yaml" for name in presets)
        results.print(f"presets by cost: {folder / 'presets'}: {names}", soft_wrap=True)
    results.print(f"report: {folder / 'report.html'}", soft_wrap=True)


def _means(result: FitResult, variant: str, split: str, lines: int | None) -> dict[str, float]:
    keys = _OF_SEQUENCES if any(score.frames for score in result.scores) else _SCORES
    means = {key: result.mean(variant, split, key, lines) for key in keys}
    return {key: float("nan") if value is None else value for key, value in means.items()}


def _plain_short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else _plain(value)


# -- claims ------------------------------------------------------------------------------------


def print_ablation(config: AblationConfig, rows: Sequence[Measured]) -> None:
    """Print the claims, each with its figures at moving borders and whether it shows."""
    table = plain_table(config.title, _CLAIM_COLUMNS, right=_CLAIM_COLUMNS[2:])
    table.columns[1].min_width = len("does not")
    for row in rows:
        off, on = row.scores["off"], row.scores["on"]
        share, ratio = row.gain("flip_band"), row.time_ratio
        table.add_row(
            Text.assemble(row.row.name, (f"\n  {row.case.name}", "dim")),
            Text(row.verdict, style=_TONES[row.verdict]),
            f"{_figure('flip', off)}\n{_figure('flip', on)}",
            "–" if share is None else f"{share:+.1%}",
            f"{_figure('psnr', off)}\n{_figure('psnr', on)}",
            "–" if ratio is None else f"{ratio:.2f}",
        )
    results.print(table)
    results.print(Text(tally(rows), style="bold"))
    results.print(Text(RULE, style="dim"))


def _figure(metric: str, scores: Mapping[str, float | None]) -> str:
    value = scores.get(f"{metric}_band")
    return number_text(metric, float("nan") if value is None else value)


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
