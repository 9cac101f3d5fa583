"""What a study is written to: JSON with every figure, tables, plots, and sheets of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from torchblur.io.paths import output_file
from tuning.experiments.kept import slug
from tuning.experiments.study.config import StudyConfig, StudyExr, StudyScene
from tuning.experiments.study.plot import plot_samples, plot_time
from tuning.experiments.study.run import FACTS, Row, picture_file
from tuning.experiments.study.scores import worth_of
from tuning.experiments.tables import (
    check_outputs,
    csv_text,
    json_text,
    markdown_table,
    write_texts,
)

__all__ = ["FILES", "curve_of", "worth_table", "write_study"]

FILES = ("study.json", "tables.md", "tables.csv")
"""What is refused to be replaced."""

_DIGITS = {"flip": 4, "psnr": 2, "ssim": 4, "temporal": 4, "failed": 3}
_WORTH = {"flip": False, "psnr": True}  # whether more is better
_LABEL_PX = 20
_GAP_PX = 4
_COLUMNS = 4
_LEAST_WIDTH = 320  # px to which small pictures are enlarged

NOTE = (
    "Means over the frames. FLIP: less is better, on display values; median: FLIP's weighted "
    "median. PSNR: dB, linear values, peak 1. SSIM: display values. “moving”, “band” …: over those "
    "pixels alone. temporal: mean error of the change from the frame before, display values. "
    "failed: share of failed reprojections among those tried. CPU s: median time of the filter "
    "per frame, of the process. Worth: so many raw samples per pixel have the same FLIP or PSNR. "
    "≈: estimated input."
)


def write_study(
    folder: Path, config: StudyConfig, rows: Sequence[Row], *, overwrite: bool = False
) -> list[Path]:
    """Write `study.json`, `tables.md`, `tables.csv`, plots, and a sheet of pictures per data.

    Args:
        folder: Where to.
        config: The configuration.
        rows: What `run_study` returned.
        overwrite: Replace files that are there.

    Raises:
        OutputError: a file exists, or cannot be written.
    """
    check_outputs(folder, FILES, overwrite=overwrite)
    facts = {
        row.data: {name: row.mean(name) for name in row.figures}
        for row in rows
        if row.variant == FACTS
    }
    rows = [row for row in rows if row.variant != FACTS]
    files = [*_plots(folder, config, rows), *_sheets(folder, config, rows)]
    texts = (_json(config, rows, facts), _markdown(config, rows, facts), _csv(rows))
    return files + write_texts(folder, dict(zip(FILES, texts, strict=True)), overwrite=overwrite)


def curve_of(
    config: StudyConfig, rows: Sequence[Row], data: str, reference: str, figure: str
) -> list[tuple[int, float]]:
    """Return the figures of raw samples by their number, rising."""
    samples = {
        v.name: v.samples for v in config.variants if v.filter is None and v.input == "stream"
    }
    found = {
        samples[row.variant]: row.mean(figure)
        for row in rows
        if (row.data, row.reference) == (data, reference) and row.variant in samples
    }
    return [(n, value) for n, value in sorted(found.items()) if value is not None]


def worth_table(config: StudyConfig, rows: Sequence[Row]) -> dict[tuple[str, str, str], str]:
    """Return what filters are worth, by data, reference, and "VARIANT FIGURE"."""
    found = {}
    for row in rows:
        if row.variant not in config.worth:
            continue
        for metric, rising in _WORTH.items():
            for figure in (metric, f"{metric}_moving"):
                curve = curve_of(config, rows, row.data, row.reference, figure)
                text = worth_of(row.mean(figure), curve, rising=rising)
                if text:
                    found[row.data, row.reference, f"{row.variant} {figure}"] = text
    return found


# -- tables ----------------------------------------------------------------------------------------


def _json(
    config: StudyConfig, rows: Sequence[Row], facts: Mapping[str, Mapping[str, float | None]]
) -> str:
    worth = worth_table(config, rows)
    records: list[dict[str, Any]] = []
    for row in rows:
        own = {
            key[2].rpartition(" ")[2]: text
            for key, text in worth.items()
            if key[:2] == (row.data, row.reference) and key[2].rpartition(" ")[0] == row.variant
        }
        records.append(
            {
                "data": row.data,
                "variant": row.variant,
                "reference": row.reference,
                "estimated": row.estimated,
                "means": {name: row.mean(name) for name in row.figures},
                "worth": own,
                "cpu_seconds": row.cpu_seconds,
                "per_frame": dict(row.figures),
            }
        )
    return json_text(config, note=NOTE, facts=facts, rows=records)


def _csv(rows: Sequence[Row]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row.figures))
    lines = [
        (row.data, row.reference, row.variant, *map(row.mean, names), row.cpu_seconds)
        for row in rows
    ]
    return csv_text(["data", "reference", "variant", *names, "cpu_seconds"], lines)


def _markdown(
    config: StudyConfig, rows: Sequence[Row], facts: Mapping[str, Mapping[str, float | None]]
) -> str:
    lines = [f"# {config.title}", "", NOTE, ""]
    worth = worth_table(config, rows)
    for data, reference in dict.fromkeys((row.data, row.reference) for row in rows):
        some = [row for row in rows if (row.data, row.reference) == (data, reference)]
        lines += [f"## {data}, {reference}", ""]
        lines += _table(some, worth)
        if data in facts:
            lines += [_facts_line(facts[data]), ""]
    return "\n".join(lines)


def _table(rows: Sequence[Row], worth: Mapping[tuple[str, str, str], str]) -> list[str]:
    names = list(dict.fromkeys(name for row in rows for name in row.figures))
    names.sort(key=lambda name: "_" in name and name != "flip_median")  # the whole image first
    columns = ["variant", *(_heading(name) for name in names), "worth FLIP", "worth PSNR", "CPU s"]
    lines = []
    for row in rows:
        key = (row.data, row.reference)
        cells = [_text(row.mean(name), _DIGITS[name.partition("_")[0]]) for name in names]
        cells += [worth.get((*key, f"{row.variant} {name}"), "") for name in _WORTH]
        cells.append(_text(row.cpu_seconds, 3) if row.cpu_seconds is not None else "")
        mark = "≈ " if row.estimated else ""
        lines.append([mark + row.variant, *cells])
    return markdown_table(columns, lines)


def _heading(name: str) -> str:
    metric, _, mask = name.partition("_")
    shown = {"flip": "FLIP", "psnr": "PSNR", "ssim": "SSIM"}.get(metric, metric)
    return f"{shown} {mask}".strip()


def _facts_line(facts: Mapping[str, float | None]) -> str:
    parts = [f"{name} {'–' if value is None else f'{value:.4g}'}" for name, value in facts.items()]
    return f"Ray mask: {'; '.join(parts)}"


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


# -- plots and pictures ----------------------------------------------------------------------------


def _plots(folder: Path, config: StudyConfig, rows: Sequence[Row]) -> list[Path]:
    (folder / "plots").mkdir(exist_ok=True)
    files = []
    for data, reference in dict.fromkeys((row.data, row.reference) for row in rows):
        some = {row.variant: row for row in rows if (row.data, row.reference) == (data, reference)}
        stem = f"{slug(data)}.{slug(reference)}"
        for plot in config.plots:
            drawn = [some[name] for name in plot.variants if name in some]
            if drawn and len(drawn[0].figures["flip"]) > 1:
                path = folder / "plots" / f"{stem}.{plot.name}.png"
                plot_time(path, _title(plot.title or plot.name, data, reference), drawn)
                files.append(path)
        for figure, label in (("flip", "mean FLIP"), ("psnr", "PSNR, dB")):
            curve = curve_of(config, rows, data, reference, figure)
            means = {name: some[name].mean(figure) for name in config.worth if name in some}
            levels = {name: value for name, value in means.items() if value is not None}
            if len(curve) > 1 and levels:
                path = folder / "plots" / f"{stem}.worth-{figure}.png"
                plot_samples(path, _title("worth", data, reference), curve, levels, label)
                files.append(path)
    return files


def _title(what: str, data: str, reference: str) -> str:
    return f"{what}: {data} (reference: {reference})"


def _sheets(folder: Path, config: StudyConfig, rows: Sequence[Row]) -> list[Path]:
    """Lay the pictures of each data beside each other, with the FLIP of the frame shown."""
    files = []
    for item in config.data:
        references = list(dict.fromkeys(r.reference for r in rows if r.data == item.name))
        names = [f"reference {name}" for name in references]
        names += [f"mask {name}" for name in config.masks]
        pictures = [(name, picture_file(folder, item, name)) for name in names]
        pictures = [(name, path) for name, path in pictures if path.is_file()]
        for row in rows:
            shown = not config.pictures or row.variant in config.pictures
            if row.data == item.name and row.reference == references[0] and shown:
                label = _label(row, item)
                pictures.append((label, picture_file(folder, item, row.variant)))
        if pictures and all(path.is_file() for _, path in pictures):
            path = folder / "pictures" / f"{slug(item.name)}.png"
            sheet = _sheet(pictures)
            with output_file(path, overwrite=True) as temporary:
                sheet.save(temporary, format="PNG")
            files.append(path)
    return files


def _label(row: Row, item: StudyScene | StudyExr) -> str:
    value = row.figures["flip"][item.shown]
    return f"{row.variant} · FLIP {_text(value, 4)}"


def _sheet(pictures: Sequence[tuple[str, Path]]) -> Image.Image:
    images = [Image.open(path).convert("RGB") for _, path in pictures]
    factor = max(1, round(_LEAST_WIDTH / images[0].width))
    size = (images[0].width * factor, images[0].height * factor)
    columns = min(_COLUMNS, len(images))
    lines = -(-len(images) // columns)
    cell = (size[0] + _GAP_PX, size[1] + _GAP_PX + _LABEL_PX)
    page = Image.new("RGB", (columns * cell[0] - _GAP_PX, lines * cell[1] - _GAP_PX), "white")
    draw = ImageDraw.Draw(page)
    for index, ((label, _), image) in enumerate(zip(pictures, images, strict=True)):
        left, top = index % columns * cell[0], index // columns * cell[1]
        page.paste(image.resize(size, Image.Resampling.NEAREST), (left, top + _LABEL_PX))
        draw.text((left + 2, top + 2), label, "black", ImageFont.load_default(13))
    return page
