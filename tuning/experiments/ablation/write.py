"""What a table of claims is written to: Markdown, JSON, and a page with sliders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tuning.experiments.ablation.run import AblationConfig, Measured
from tuning.experiments.tables import check_outputs, json_text, markdown_table, write_texts
from tuning.report.page import View, make_view, render_page

__all__ = ["COLUMNS", "FILES", "RULE", "cells", "side_text", "tally", "write_ablation"]

RULE = (
    "A claim shows if FLIP and PSNR in the band at moving borders both agree: better by at least "
    "1 % and 0.05 dB; where the claim is “comparable”, not worse by more than 5 % and 0.25 dB. It "
    "does not show if neither agrees, and is mixed if they disagree. Where nothing moves, the "
    "whole image counts."
)

COLUMNS = (
    "FLIP borders off",
    "on",
    "gain",
    "PSNR borders off",
    "on",
    "gain",
    "SSIM borders gain",
    "FLIP image off",
    "on",
    "PSNR image off",
    "on",
    "time on/off",
)
"""Columns with figures, between the claim and the verdict."""

FILES = ("table.md", "table.json", "ablation.html")
"""What is refused to be replaced."""


def write_ablation(
    folder: Path, config: AblationConfig, rows: Sequence[Measured], *, overwrite: bool = False
) -> list[Path]:
    """Write `table.md`, `table.json` and `ablation.html`; all of them, or none.

    Args:
        folder: Where to; it is made if it is not there.
        config: The configuration.
        rows: What `run_ablation` returned.
        overwrite: Replace files that are there.

    Raises:
        OutputError: a file exists, or cannot be written.
    """
    check_outputs(folder, FILES, overwrite=overwrite)
    texts = (_markdown(config, rows), _json(config, rows), _page(config, rows))
    return write_texts(folder, dict(zip(FILES, texts, strict=True)), overwrite=overwrite)


def cells(measured: Measured) -> list[str]:
    """Return the figures of a row as text, in the order of `COLUMNS`."""
    off, on = measured.scores["off"], measured.scores["on"]
    ratio = measured.time_ratio
    gain = measured.gain("flip_band")
    return [
        _text(off["flip_band"], ".4f"),
        _text(on["flip_band"], ".4f"),
        _text(None if gain is None else 100 * gain, "+.1f", " %"),
        _text(off["psnr_band"], ".2f"),
        _text(on["psnr_band"], ".2f"),
        _text(measured.gain("psnr_band"), "+.2f", " dB"),
        _text(measured.gain("ssim_band"), "+.4f"),
        _text(off["flip"], ".4f"),
        _text(on["flip"], ".4f"),
        _text(off["psnr"], ".2f"),
        _text(on["psnr"], ".2f"),
        _text(ratio, ".2f", "×"),
    ]


def side_text(values: Mapping[str, Any]) -> str:
    """Return parameters as one line: "a=1, b=two"; "default" if there are none."""
    return ", ".join(f"{name}={_plain(value)}" for name, value in values.items()) or "default"


def tally(rows: Sequence[Measured]) -> str:
    """Return how many claims show, in one sentence."""
    count = [row.verdict for row in rows].count
    return (
        f"{len(rows)} claims: {count('shows')} show, {count('mixed')} mixed, "
        f"{count('does not show')} do not show"
    )


def _text(value: float | None, form: str, unit: str = "") -> str:
    return "–" if value is None else f"{value:{form}}{unit}".replace("-", "−")


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _about(measured: Measured) -> str:
    """Return where a row was measured: frame, size, shutter, filter."""
    case = measured.case
    height, width = case.frame.size
    spp = "" if measured.row.exr is not None else f", shutter {case.shutter.open:g}"
    return f"{case.name}, {width}x{height}{spp}, {measured.row.filter}"


# -- the files -------------------------------------------------------------------------------------


def _markdown(config: AblationConfig, rows: Sequence[Measured]) -> str:
    head = ("", "claim", "scene, size, filter", "off → on", *COLUMNS, "verdict")
    lines = []
    for row in rows:
        change = f"{side_text(row.row.off)} → {side_text(row.row.on)}"
        line = [row.row.name, row.row.claim, _about(row), change, *cells(row), row.verdict]
        lines.append([" ".join(cell.split()) for cell in line])
    table = markdown_table(head, lines, left=(*range(4), len(head) - 1))
    return "\n".join([f"# {config.title}", "", f"{tally(rows)}. {RULE}", "", *table])


def _json(config: AblationConfig, rows: Sequence[Measured]) -> str:
    return json_text(config, indent=2, rule=RULE, rows=[_record(row) for row in rows])


def _record(measured: Measured) -> dict[str, Any]:
    row, case = measured.row, measured.case
    height, width = case.frame.size
    return {
        "name": row.name,
        "claim": row.claim,
        "case": case.name,
        "size": f"{width}x{height}",
        "shutter": case.shutter.open,
        "filter": row.filter,
        "off": row.values("off"),
        "on": row.values("on"),
        "scores": {name: dict(scores) for name, scores in measured.scores.items()},
        "gain": {key: measured.gain(key) for key in measured.scores["off"]},
        "cpu_seconds": dict(measured.seconds),
        "time_ratio": measured.time_ratio,
        "expect": row.expect,
        "verdict": measured.verdict,
    }


def _page(config: AblationConfig, rows: Sequence[Measured]) -> str:
    return render_page(
        "ablation.html",
        title=config.title,
        subtitle=tally(rows),
        rule=RULE,
        columns=COLUMNS,
        rows=[_page_row(index, row) for index, row in enumerate(rows)],
    )


def _page_row(index: int, measured: Measured) -> dict[str, Any]:
    row = measured.row
    return {
        "name": row.name,
        "claim": row.claim,
        "about": _about(measured),
        "shared": side_text(row.params) if row.params else "",
        "off": side_text(row.off),
        "on": side_text(row.on),
        "cells": cells(measured),
        "verdict": measured.verdict,
        "expect": row.expect,
        "tone": {"shows": "good", "does not show": "bad"}.get(measured.verdict, "soft"),
        "view": _view(index, measured),
    }


def _view(index: int, measured: Measured) -> View:
    images = dict(measured.images) | {"sharp": measured.case.frame.color}
    return make_view(
        f"row{index}",
        measured.row.name,
        images,
        measured.case.reference,
        subtitle=_about(measured),
        mapped=("off", "on"),
        right="on",
    )
