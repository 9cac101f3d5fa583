"""Comparing images with a reference: a table, and a page with sliders and error maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from markupsafe import Markup
from torch import Tensor

from torchblur.errors import FrameError
from torchblur.frame import Shutter
from torchblur.io import read_frame
from torchblur.io.paths import output_file
from torchblur.metrics import border_band, evaluate
from tuning.files.images import read_color
from tuning.report.page import FIGURES, Row, Table, make_view, render_page

__all__ = ["Comparison", "check_size", "compare_images", "short_names", "write_page"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Images beside their reference, or sequences beside theirs.

    Args:
        reference: Scene-linear radiance, (1, 3, H, W); of a sequence that of the shown frame.
        images: The images by name, same shape.
        scores: What `evaluate` returns, by image; with "band" if the sharp frame was given. Of a
            sequence the means over its frames, with "flip_median" and "temporal".
        shown: What the images are.
        frames: How many frames there are, in words; empty for single images.
        curves: The figures of a sequence over its frames, as SVG.
    """

    reference: Tensor
    images: Mapping[str, Tensor]
    scores: Mapping[str, Mapping[str, float]]
    shown: str = "Images"
    frames: str = ""
    curves: Markup | None = None


@torch.no_grad()
def compare_images(
    paths: Sequence[Path],
    reference: Path,
    *,
    frame: Path | None = None,
    convention: str = "auto",
    shutter: Shutter | None = None,
) -> Comparison:
    """Compare image files with a reference.

    Args:
        paths: EXR or PNG files.
        reference: The same.
        frame: The sharp frame with its velocity: adds the band at moving borders, and the sharp
            image as a row of its own.
        convention: Of that frame.
        shutter: Of the reference, for the band; half a frame, centered, if left out.

    Raises:
        FileFormatError: a file that cannot be read.
        FrameError: NaN or inf, or sizes that differ; with both files.
    """
    target = read_color(reference)
    images = {name: read_color(path) for name, path in zip(short_names(paths), paths, strict=True)}
    files = dict(zip(images, paths, strict=True))
    masks = {}
    if frame is not None:
        sharp = read_frame(frame, convention)
        masks["band"] = border_band(sharp, shutter or Shutter())
        files = {"sharp": frame} | files
        images = {"sharp": sharp.color} | images
    for name, image in images.items():
        check_size(image, files[name], target, reference)
    scores = {
        name: {k: float(v) for k, v in evaluate(image, target, masks=masks).items()}
        for name, image in images.items()
    }
    return Comparison(reference=target, images=images, scores=scores)


def write_page(path: Path, comparison: Comparison, *, title: str, overwrite: bool = False) -> None:
    """Write a self-contained HTML page with the table, a slider and error maps.

    Args:
        path: Where to.
        comparison: What `compare_images` returned.
        title: Its heading.
        overwrite: Replace an existing file.

    Raises:
        OutputError: it exists, or it cannot be written.
    """
    height, width = comparison.reference.shape[-2:]
    has_band = any(key.endswith("_band") for row in comparison.scores.values() for key in row)
    subtitle = f"{len(comparison.images)} images of {width}x{height} px"
    page = render_page(
        "compare.html",
        title=title,
        subtitle=subtitle if not comparison.frames else f"{subtitle}, {comparison.frames}",
        table=_table(comparison.scores),
        borders="“Borders” counts only the band that moving borders sweep over."
        if has_band
        else "",
        curves=comparison.curves,
        view=make_view("images", comparison.shown, comparison.images, comparison.reference),
    )
    with output_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _table(scores: Mapping[str, Mapping[str, float]]) -> Table:
    keys = list(next(iter(scores.values())))
    rows = [
        Row(name=name, values=[None if math.isnan(row[key]) else row[key] for key in keys])
        for name, row in scores.items()
    ]
    return Table(title="Figures", columns=[FIGURES[key] for key in keys], rows=rows)


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return the files' names where they differ, and else as much of the path as is needed."""
    for count in range(1, max((len(path.parts) for path in paths), default=1) + 1):
        names = [str(Path(*path.parts[-count:])) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{index} {path}" for index, path in enumerate(paths, start=1)]


def check_size(image: Tensor, path: Path, reference: Tensor, reference_path: Path) -> None:
    """Refuse an image of another size than its reference; with both files.

    Raises:
        FrameError: if they differ.
    """
    if image.shape != reference.shape:
        (h, w), (rh, rw) = image.shape[-2:], reference.shape[-2:]
        raise FrameError(
            f"images and reference must have one size: {path} is {w}x{h}, {reference_path} is "
            f"{rw}x{rh}"
        )
