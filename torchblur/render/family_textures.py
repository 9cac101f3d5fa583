"""What surfaces, sky and light of a drawn scene look like."""

from __future__ import annotations

import colorsys
import math
from typing import Any

from torchblur.render.family_config import LightRanges, SkyRanges, TextureRanges
from torchblur.render.family_dice import Dice
from torchblur.render.family_view import plain

__all__ = ["draw_light", "draw_sky", "draw_spokes", "draw_texture"]

_SKY_BLUE = (0.6, 0.12)  # hue, and how far it varies
_SKY_SATURATION = (0.1, 0.6)


def draw_texture(ranges: TextureRanges, width: float, exposure: float, dice: Dice) -> Any:
    """Draw a texture.

    Args:
        ranges: From which.
        width: Of the image at the body's depth, scene units.
        exposure: Factor on its colors.
        dice: Random numbers.

    Returns:
        The fields of a texture.
    """
    kind = dice.pick("kind", ranges.kinds)
    color, background = _colors(ranges, exposure, dice)
    if kind == "solid":
        return {"kind": kind, "color": color}
    cell = dice.log_between("scale", ranges.scale) * width
    offset = tuple(dice.of("offset").between(axis, (-0.4, 0.4)) * cell for axis in "xyz")
    return {
        "kind": kind,
        "color": color,
        "background": background,
        "offset": plain(offset),
        "variation": plain(dice.between("variation", ranges.variation)),
        **_own(kind, cell, dice),
    }


def draw_spokes(ranges: TextureRanges, exposure: float, dice: Dice, axis: str = "y") -> Any:
    """Draw sectors of two colors about an axis; arguments as in `draw_texture`."""
    color, background = _colors(ranges, exposure, dice)
    return {
        "kind": "spokes",
        "color": color,
        "background": background,
        "count": dice.whole("count", (2, 9)),
        "axis": axis,
        "variation": plain(dice.between("variation", ranges.variation)),
    }


def draw_sky(ranges: SkyRanges, exposure: float, dice: Dice) -> Any:
    """Draw the sky: one color, or clouds of two."""
    hue = _SKY_BLUE[0] + _SKY_BLUE[1] * (dice.chance("hue") - 0.5)
    mean = dice.log_between("brightness", ranges.brightness) * exposure
    contrast = dice.between("contrast", ranges.contrast)
    saturation = dice.between("saturation", _SKY_SATURATION)
    return {
        "kind": "noise",
        "color": _color(mean * (1 - contrast), hue, saturation),
        "background": _color(mean * (1 + contrast), hue, saturation / 2),
        "size": plain(dice.log_between("scale", ranges.scale)),
    }


def draw_light(ranges: LightRanges, dice: Dice) -> Any:
    """Draw the light's direction and its ambient share."""
    elevation = math.radians(dice.between("elevation", ranges.elevation))
    azimuth = math.radians(dice.between("azimuth", ranges.azimuth))
    flat = math.cos(elevation)
    direction = (flat * math.sin(azimuth), math.sin(elevation), flat * math.cos(azimuth))
    return {
        "direction": plain(direction),
        "ambient": plain(dice.between("ambient", ranges.ambient)),
    }


def _colors(ranges: TextureRanges, exposure: float, dice: Dice) -> tuple[Any, Any]:
    mean = dice.log_between("brightness", ranges.brightness) * exposure
    contrast = dice.between("contrast", ranges.contrast) * dice.sign("order")
    pair = [
        _color(
            mean * (1 + sign * contrast),
            dice.chance(f"hue {name}"),
            dice.between(f"saturation {name}", ranges.saturation),
        )
        for name, sign in (("a", 1), ("b", -1))
    ]
    return pair[0], pair[1]


def _color(mean: float, hue: float, saturation: float) -> Any:
    """Return a color of a hue whose three channels have this mean."""
    raw = colorsys.hsv_to_rgb(hue % 1, saturation, 1.0)
    total = sum(raw)
    return plain(tuple(3 * mean * channel / total for channel in raw))


def _own(kind: str, cell: float, dice: Dice) -> dict[str, Any]:
    """Return the fields that only this kind has."""
    if kind in ("checker", "stripes"):
        fields: dict[str, Any] = {"size": plain(cell)}
        if kind == "stripes":
            across = tuple(dice.of("across").between(axis, (-1.0, 1.0)) for axis in "xyz")
            fields["direction"] = plain(across) if math.hypot(*across) > 0.1 else [1.0, 0.0, 0.0]
        return fields
    if kind == "brick":
        return {"size": plain((2.2 * cell, cell))}
    if kind == "noise":
        return {"size": plain(2 * cell), "contrast": plain(dice.between("steepness", (1.5, 5.0)))}
    if kind == "dots":
        return {"spacing": plain(2 * cell)}
    return {"spacing": plain(2.5 * cell), "length": 0.7, "width": 0.25}
