"""Must parameters in pixels follow the frame's height? ``python -m tools.sizes [FILE]``.

Two scenes are rendered by cameras of 270 to 2160 lines, the same part of the image of each. Every
parameter in pixels of every filter is halved and doubled, all else left as it is. Where one value
is as good as any at all heights, the parameter need not follow.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchblur.filters import TemporalBlur, get_filter, list_filters
from torchblur.frame import Frame, Shutter
from torchblur.metrics import evaluate
from torchblur.params import declared
from torchblur.render import (
    Scene,
    draw_scene,
    load_family,
    load_scene,
    render_frame,
    render_reference,
)

__all__ = ["Row", "main", "pixel_parameters", "rows", "table"]

_CONFIGS = Path(__file__).resolve().parents[1] / "configs"
_HEIGHTS = (270, 540, 1080, 2160)
_SHARE = 4  # the middle quarter of width and height is rendered
_FACTORS = (0.5, 1.0, 2.0)
_SHUTTER = Shutter(0.3)
_SPP = 64
_OF_REACH = ("max_reach",)  # limits, which cut or do nothing


@dataclass(frozen=True)
class Row:
    """One parameter: what halving and doubling it does at each height."""

    filter: str
    parameter: str
    value: float
    """The default, px."""
    flip: Mapping[int, tuple[float, ...]]
    """FLIP by height, for half, the whole and twice the value; mean over the scenes."""

    @property
    def loss(self) -> float:
        """By how much the best single factor is worse than the best at each height, at worst."""
        return min(
            max(figures[k] / min(figures) for figures in self.flip.values()) - 1
            for k in range(len(_FACTORS))
        )


def pixel_parameters(name: str) -> dict[str, float]:
    """Return the numbers of a filter that are in px, with their defaults.

    Args:
        name: A registered filter.
    """
    kind = get_filter(name).config_class
    found = {}
    for key, spec in declared(kind).items():
        default = kind.model_fields[key].default
        if spec.unit == "px" and key not in _OF_REACH and default:
            found[key] = float(default)
    return found


def main() -> None:
    """Measure all filters and write the table."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else _CONFIGS.parent / "docs" / "sizes.md"
    windows = {lines: list(_windows(lines)) for lines in _HEIGHTS}
    names = [n for n in list_filters() if not issubclass(get_filter(n), TemporalBlur)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Tan 2022 goes without, and ReachWarning
        found = [row for name in names for row in rows(name, windows)]
    path.write_text(table(found))
    print(path)


def rows(name: str, windows: Mapping[int, list[tuple[Frame, Tensor]]]) -> Iterator[Row]:
    """Measure one filter.

    Args:
        name: A registered filter.
        windows: Frames and references by height of the camera's image.
    """
    given: dict[str, Any] = (
        {"reach": "frame"} if "reach" in get_filter(name).config_class.model_fields else {}
    )
    base = {lines: _flip(name, given, some) for lines, some in windows.items()}
    for key, value in pixel_parameters(name).items():
        flip = {}
        for lines, some in windows.items():
            lower, upper = (
                _flip(name, given | {key: _scaled(name, key, value * factor)}, some)
                for factor in _FACTORS[::2]
            )
            flip[lines] = lower, base[lines], upper
        yield Row(name, key, value, flip)


def _scaled(name: str, key: str, value: float) -> float | int:
    """Return a value within the parameter's range, whole where it is an integer."""
    kind = get_filter(name).config_class
    low, high = declared(kind)[key].bounds
    inside = min(max(value, low), high)
    return round(inside) if kind.model_fields[key].annotation is int else inside


@torch.no_grad()
def _flip(name: str, params: Mapping[str, Any], some: list[tuple[Frame, Tensor]]) -> float:
    blur = get_filter(name)(**params)
    given = {"shutter": _SHUTTER.open, "shutter_position": "centered"}
    figures = [float(evaluate(blur(f, **given), r)["flip"]) for f, r in some]
    return sum(figures) / len(figures)


def _windows(lines: int) -> Iterator[tuple[Frame, Tensor]]:
    """Return the middle of both scenes at a height, sharp and blurred."""
    whole = lines, lines * 16 // 9
    size = whole[0] // _SHARE, whole[1] // _SHARE
    box = ((whole[0] - size[0]) // 2, (whole[1] - size[1]) // 2, *size)
    for scene in _scenes():
        part = scene.window(of=whole, box=box)
        reference = render_reference(part, size, spp=_SPP, shutter=_SHUTTER, seed=1).mean
        yield render_frame(part, size, color_spp=16), reference


def _scenes() -> list[Scene]:
    family = load_family(_CONFIGS / "families" / "everyday.yaml")
    return [load_scene(_CONFIGS / "scenes" / "crossing_spheres.yaml"), draw_scene(family, 9)]


def table(found: list[Row]) -> str:
    """Return the page.

    Args:
        found: The rows.
    """
    heights = " | ".join(f"{lines} lines" for lines in _HEIGHTS)
    lines = [
        "# Parameters in pixels, at four heights",
        "",
        "Made by `python -m tools.sizes`. FLIP for half the default, the default and twice the",
        "default, mean over the middle quarter of two scenes (crossing_spheres and everyday-0009),",
        "rendered by cameras of four heights; shutter 0.3, `reach: frame`. The last column: by how",
        "much the best single factor is worse than the best one at some height. Near 0 the",
        "parameter need not follow the height.",
        "",
        f"| filter | parameter | default, px | {heights} | loss |",
        "|---|---|---|" + "---|" * len(_HEIGHTS) + "---|",
    ]
    for row in found:
        cells = " | ".join(" ".join(f"{f:.4f}"[1:] for f in row.flip[h]) for h in _HEIGHTS)
        lines.append(
            f"| `{row.filter}` | `{row.parameter}` | {row.value:g} | {cells} | {row.loss:.1%} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
