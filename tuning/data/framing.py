"""Windows of a larger image: where they lie, and the scene as seen through one."""

from __future__ import annotations

import functools
import hashlib
import itertools
from pathlib import Path
from typing import TypeAlias

import torch

from torchblur.frame import Shutter
from torchblur.metrics import border_band
from torchblur.render import Renderer, Scene
from tuning.config.framing import Framed
from tuning.data.cache import cache_key, cached

__all__ = ["MOVING", "Box", "busiest_box", "cached_box", "find_box", "seen_through", "view_of"]

Box: TypeAlias = tuple[int, int, int, int]
"""Top, left, height and width of a window, px of the whole image."""

MOVING = 0.5
"""Least motion over the open shutter that counts, px; less is not seen as blur."""

_MAP = 128  # px of the map's longer edge
_STEPS = 8  # the map is searched at this many steps along each axis


def find_box(scene: Scene, framed: Framed, frame: float, shutter: Shutter) -> Box | None:
    """Return the window that is to be rendered, or None for the whole image.

    Args:
        scene: The scene.
        framed: Size and place of the window.
        frame: When motion decides the place: the frame's time.
        shutter: When it does: open time.
    """
    if framed.whole is None:
        return None
    if framed.at == "motion":
        return busiest_box(scene, framed.height_width, framed.whole, frame, shutter)
    return _box_at(framed.at or (0.5, 0.5), framed.height_width, framed.whole)


def cached_box(scene: Scene, framed: Framed, frame: float, shutter: Shutter) -> Box | None:
    """Do as `find_box`, and keep what had to be rendered for it in the cache."""
    if framed.at != "motion":
        return find_box(scene, framed, frame, shutter)
    settings = {
        "window": [framed.height_width, framed.whole],
        "shutter": [shutter.open, shutter.position],
        "rule": _rule(),
    }
    key = cache_key(scene.fingerprint(), settings, frame)

    def find() -> dict[str, torch.Tensor]:
        return {"box": torch.tensor(find_box(scene, framed, frame, shutter))}

    top, left, height, width = cached(key, find)["box"].tolist()
    return top, left, height, width


def seen_through(scene: Scene, framed: Framed, box: Box | None) -> Scene:
    """Return the scene whose camera's image is the window, or the scene itself.

    Args:
        scene: The scene.
        framed: Size of the whole image.
        box: From `find_box`.
    """
    if box is None or framed.whole is None:
        return scene
    return scene.window(of=framed.whole, box=box)


def view_of(framed: Framed, box: Box | None) -> str:
    """Return the window as text, such as "480x270+720+405 of 1920x1080"; "" for a whole image."""
    if box is None:
        return ""
    top, left, height, width = box
    return f"{width}x{height}+{left}+{top} of {framed.of}"


def busiest_box(
    scene: Scene, size: tuple[int, int], of: tuple[int, int], frame: float, shutter: Shutter
) -> Box:
    """Return the window with the most moving pixels and borders of what moves.

    Both are counted in a small G-buffer of the whole image, at 9 x 9 places from edge to edge. A
    pixel of such a border counts twice, as it moves, too. Of equals the place nearest to the
    middle wins.

    Args:
        scene: The scene.
        size: Height and width of the window, px.
        of: Height and width of the whole image, px.
        frame: The frame's time.
        shutter: Open time.
    """
    scale = min(1.0, _MAP / max(of))
    rows, columns = (max(1, round(edge * scale)) for edge in of)
    small = Renderer(scene, engine="eager").frame((rows, columns), frame=frame, color_spp=1)
    least = MOVING * scale
    moves = small.require("velocity").norm(dim=1)[0] * shutter.open > least
    borders = border_band(small, shutter, margin=0, min_blur=least)[0, 0]
    counts = moves.long() + borders.long()
    height, width = (max(1, round(edge * scale)) for edge in size)

    def rank(place: tuple[float, float]) -> tuple[int, float]:
        x, y = place
        top, left = round(y * (rows - height)), round(x * (columns - width))
        found = int(counts[top : top + height, left : left + width].sum())
        return found, -((x - 0.5) ** 2) - (y - 0.5) ** 2

    grid = [step / _STEPS for step in range(_STEPS + 1)]
    x, y = max(itertools.product(grid, grid), key=rank)
    return round(y * (of[0] - size[0])), round(x * (of[1] - size[1])), *size


def _box_at(place: tuple[float, float], size: tuple[int, int], of: tuple[int, int]) -> Box:
    """Return the window around a place, moved inwards where it would leave the image."""
    top, left = (
        min(max(round(share * edge - length / 2), 0), edge - length)
        for share, edge, length in zip((place[1], place[0]), of, size, strict=True)
    )
    return top, left, *size


@functools.cache
def _rule() -> str:
    """Return the hash of how a place is found."""
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]
