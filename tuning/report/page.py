"""Pieces of self-contained HTML pages: images as data URIs, sliders, error maps, tables.

A page has no script but a few lines of its own, and asks the network for nothing. The templates
lie in `tuning/report/templates`: `base.html` has the style and the script, `parts.html` the macros.
"""

from __future__ import annotations

import base64
import functools
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from matplotlib import colormaps
from PIL import Image
from torch import Tensor

from torchblur.metrics import display_encode, flip_ldr

__all__ = [
    "FIGURES",
    "OF_SEQUENCES",
    "Column",
    "Picture",
    "Row",
    "Table",
    "View",
    "error_map",
    "image_uri",
    "make_view",
    "map_limit",
    "render_page",
    "short_text",
]

_MAX_EDGE = 1280
_NICE_LIMITS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
_COLORS = "magma"


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One image of a page.

    Args:
        name: Short label.
        uri: The image as a data URI.
        caption: A figure or two.
    """

    name: str
    uri: str
    caption: str = ""


@dataclass(frozen=True, kw_only=True)
class View:
    """Images of one case that can be laid over each other, and their error maps.

    Args:
        key: Unique name within the page, for its controls.
        title: Heading.
        subtitle: What it is.
        width: In px.
        height: In px.
        pictures: At least two; any two of them can be compared with the slider.
        left: Name of the picture that is on the left at first.
        right: Name of the picture that is on the right at first.
        maps: Error maps.
        limit: Error that the maps' brightest color stands for.
    """

    key: str
    title: str
    subtitle: str
    width: int
    height: int
    pictures: Sequence[Picture]
    left: str
    right: str
    maps: Sequence[Picture] = ()
    limit: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of figures.

    Args:
        name: Heading.
        digits: Digits after the point.
        better: "low" or "high": which figure is the better one; "" if neither.
        signed: Show a plus.
    """

    name: str
    digits: int = 4
    better: str = ""
    signed: bool = False


FIGURES = {
    f"{metric}{mask}": Column(name=f"{name}{where}", digits=digits, better=better)
    for mask, where in (("", ""), ("_band", ", borders"))
    for metric, name, digits, better in (
        ("flip", "FLIP", 4, "low"),
        ("psnr", "PSNR", 2, "high"),
        ("ssim", "SSIM", 4, "high"),
    )
} | {
    "flip_median": Column(name="FLIP, median", digits=4, better="low"),
    "temporal": Column(name="change in time", digits=4, better="low"),
}
"""Columns of the figures of an image; the last two are those of sequences alone."""

OF_SEQUENCES = ("flip_median", "temporal")
"""Figures that sequences alone have."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of figures.

    Args:
        name: Its label.
        values: Figures, None where there is none.
        note: What the label means.
        ranked: Whether it takes part in the choice of the best of a column.
        strong: Whether it is set apart.
    """

    name: str
    values: Sequence[float | None]
    note: str = ""
    ranked: bool = True
    strong: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """Figures of several images; the best of each column is set in bold.

    Args:
        title: Caption.
        columns: Headings.
        rows: Rows, each with as many values as there are columns.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]

    def text(self, row: Row, index: int) -> str:
        """Return a figure as it is shown."""
        value, column = row.values[index], self.columns[index]
        if value is None:
            return "–"
        if math.isinf(value):
            return "∞"
        sign = "+" if column.signed else ""
        return f"{value:{sign}.{column.digits}f}".replace("-", "−")

    def is_best(self, row: Row, index: int) -> bool:
        """Return whether a figure is the best of its column, as far as its digits show."""
        column = self.columns[index]
        figures = [r.values[index] for r in self.rows if r.ranked]
        known = [round(v, column.digits) for v in figures if v is not None]
        value = row.values[index]
        if not column.better or not row.ranked or value is None or not known:
            return False
        best = min(known) if column.better == "low" else max(known)
        return round(value, column.digits) == best


def image_uri(color: Tensor, *, exposure: float = 0.0) -> str:
    """Return an image as a lossless WebP data URI, as a display shows it.

    Args:
        color: Scene-linear radiance, (1, 3, H, W) or (3, H, W); clipped and sRGB-encoded.
            Images longer than 1280 px are averaged down by a whole factor.
        exposure: In stops; each doubles the radiance.
    """
    color = color.detach().float().cpu().reshape(1, *color.shape[-3:])
    return _encode(display_encode(_reduced(color) * 2.0**exposure)[0])


def error_map(
    image: Tensor, reference: Tensor, *, limit: float = 1.0, error: Tensor | None = None
) -> str:
    """Return the FLIP error of each pixel in magma colors, as a data URI.

    Args:
        image: Scene-linear radiance, (1, 3, H, W).
        reference: Scene-linear radiance, (1, 3, H, W).
        limit: Error that the brightest color stands for, above 0.
        error: The errors, (1, 1, H, W), if they are known already.
    """
    values = flip_ldr(image, reference) if error is None else error
    level = _reduced(values.detach().float().cpu())[0, 0] / limit
    colors = colormaps[_COLORS](level.clamp(0, 1).numpy())[..., :3]
    return _encode(torch.from_numpy(np.ascontiguousarray(colors)).permute(2, 0, 1))


def map_limit(errors: Sequence[Tensor]) -> float:
    """Return a round limit for error maps that are shown together.

    Args:
        errors: Errors in [0, 1], any shape. All but 0.5 % of the pixels lie below the limit.
    """
    largest = max(float(np.quantile(e.detach().cpu().numpy(), 0.995)) for e in errors)
    return next(limit for limit in _NICE_LIMITS if limit >= min(largest, 1.0))


def make_view(
    key: str,
    title: str,
    images: Mapping[str, Tensor],
    reference: Tensor,
    *,
    subtitle: str = "",
    mapped: Sequence[str] = (),
    right: str = "reference",
) -> View:
    """Return the comparison of several images with a reference.

    Args:
        key: Unique name within the page.
        title: Heading.
        images: Scene-linear radiance by label, (1, 3, H, W) each; the first is on the left.
        reference: Scene-linear radiance, (1, 3, H, W); labeled "reference".
        subtitle: What it is.
        mapped: Labels of the images whose error maps are shown; all if left out.
        right: Label of what is on the right at first.
    """
    errors = {name: flip_ldr(image, reference) for name, image in images.items()}
    shown = list(mapped) or list(images)
    limit = map_limit([errors[name] for name in shown])
    means = {name: f"FLIP {float(error.mean()):.4f}" for name, error in errors.items()}
    pictures = [
        Picture(name=name, uri=image_uri(image), caption=means[name])
        for name, image in images.items()
    ]
    pictures.append(Picture(name="reference", uri=image_uri(reference)))
    maps = [
        Picture(
            name=name,
            uri=error_map(images[name], reference, limit=limit, error=errors[name]),
            caption=means[name],
        )
        for name in shown
    ]
    height, width = _reduced(reference).shape[-2:]
    return View(
        key=key,
        title=title,
        subtitle=subtitle,
        width=width,
        height=height,
        pictures=pictures,
        left=pictures[0].name,
        right=right,
        maps=maps,
        limit=limit,
    )


def short_text(value: object) -> str:
    """Return a parameter's value in four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def render_page(template: str, **context: object) -> str:
    """Return a page, or a card in Markdown.

    Args:
        template: File in `tuning/report/templates`; pages extend `base.html`.
        **context: What the template names. In HTML text is escaped; only `Markup` is not.
    """
    return _environment().get_template(template).render(**context)


@functools.lru_cache(maxsize=1)
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("tuning.report", "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["map_gradient"] = _gradient()
    return environment


def _gradient() -> Markup:
    """Return the error maps' colors as a CSS gradient."""
    stops = colormaps[_COLORS](np.linspace(0, 1, 9))[:, :3]
    colors = ", ".join("#" + "".join(f"{round(c * 255):02x}" for c in stop) for stop in stops)
    return Markup(f"linear-gradient(to right, {colors})")


def _reduced(image: Tensor) -> Tensor:
    factor = math.ceil(max(image.shape[-2:]) / _MAX_EDGE)
    return image if factor == 1 else F.avg_pool2d(image, factor, ceil_mode=True)


def _encode(display: Tensor) -> str:
    """Return display values in [0, 1], (3, H, W), as a data URI."""
    levels = (display * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, "WEBP", lossless=True, quality=60, method=4)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
