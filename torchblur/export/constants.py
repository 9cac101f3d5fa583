"""The parameters of a preset as JSON, HLSL or GLSL.

A float is written as the shortest decimal that is the same float32, which is what the filter
computes with.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from torchblur.errors import ConfigError, nearest_name
from torchblur.export.shaders import header_lines, shader_text
from torchblur.filters import get_filter
from torchblur.io.paths import output_file
from torchblur.params import build, choices, declared
from torchblur.presets import Preset
from torchblur.version import __version__

__all__ = ["Constant", "ConstantsFormat", "constants_of", "constants_text", "write_constants"]

ConstantsFormat = Literal["json", "hlsl", "glsl"]


@dataclass(frozen=True, kw_only=True)
class Constant:
    """One parameter with its value.

    Args:
        name: As in the preset.
        kind: "float", "int", "bool" or "choice".
        value: A float is that float32.
        default: The published value.
        tuned: Whether the preset has another value than the published one.
        symbol: The letter in the paper, if it has one.
        unit: As declared; "1" for a bare number.
        meaning: What it does.
        source: Paper and section.
        low: Least valid value; None for switches and choices.
        high: Greatest valid value, likewise.
        scale: "linear" or "log".
        choices: Valid values of a choice, in the order of their numbers.
    """

    name: str
    kind: Literal["float", "int", "bool", "choice"]
    value: float | bool | str
    default: float | bool | str
    tuned: bool
    symbol: str
    unit: str
    meaning: str
    source: str
    low: float | None
    high: float | None
    scale: str
    choices: tuple[str, ...]


def constants_of(preset: Preset) -> tuple[Constant, ...]:
    """Return all parameters of a preset's filter, in the order of their declaration.

    Args:
        preset: A filter's name and the parameters that differ from the published ones.

    Raises:
        ConfigError: unknown filter or parameter, value out of range.
    """
    model = get_filter(preset.filter).config_class
    config, published = build(model, preset.params, preset.filter), model()
    found = []
    for name, spec in declared(model).items():
        value, default = (_float32(getattr(c, name)) for c in (config, published))
        options = choices(model, name) if isinstance(value, str) else ()
        found.append(
            Constant(
                name=name,
                kind=_kind(value),
                value=value,
                default=default,
                tuned=value != default,
                symbol=spec.symbol,
                unit=spec.unit,
                meaning=spec.meaning,
                source=spec.source,
                low=spec.low,
                high=spec.high,
                scale=spec.scale,
                choices=options,
            )
        )
    return tuple(found)


def constants_text(
    preset: Preset, file_format: ConstantsFormat, *, prefix: str = "blur_", name: str = ""
) -> str:
    """Return the constants of a preset as a file of another language.

    HLSL and GLSL: ``static const float`` or ``const float``, the same for int and bool, and for a
    choice a number by ``#define``, with one more for each of its values. Comments have meaning,
    symbol, unit, range, source and, where it differs, the published value. Plain ASCII.

    Args:
        preset: What is written.
        file_format: "json", "hlsl" or "glsl".
        prefix: Before each name in HLSL and GLSL.
        name: Where the preset came from, for the head of the file.

    Raises:
        ConfigError: unknown format, unknown filter or parameter, value out of range, or a prefix
            that makes no valid names.
    """
    formats = get_args(ConstantsFormat)
    if file_format not in formats:
        raise ConfigError(
            f"unknown format `{file_format}`{nearest_name(file_format, formats)}; formats: "
            f"{', '.join(formats)}"
        )
    constants = constants_of(preset)
    if file_format == "json":
        return _json(preset, constants, name)
    return shader_text(
        [vars(constant) for constant in constants],
        file_format,
        head=header_lines(preset.filter, name, preset.evidence, __version__),
        guard=f"{prefix}{preset.filter}_constants",
        prefix=prefix,
    )


def write_constants(
    path: str | Path,
    preset: Preset,
    file_format: ConstantsFormat,
    *,
    prefix: str = "blur_",
    name: str = "",
    overwrite: bool = False,
) -> None:
    """Write what `constants_text` returns; the file appears whole or not at all.

    Args:
        path: Where to.
        preset: As of `constants_text`, like all others.
        file_format: "json", "hlsl" or "glsl".
        prefix: Before each name in HLSL and GLSL.
        name: Where the preset came from.
        overwrite: Replace an existing file.

    Raises:
        ConfigError: as `constants_text`.
        OutputError: the file exists and `overwrite` is off, or it cannot be written.
    """
    text = constants_text(preset, file_format, prefix=prefix, name=name)
    with output_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _json(preset: Preset, constants: tuple[Constant, ...], name: str) -> str:
    document = {
        "torchblur": __version__,
        "filter": preset.filter,
        "preset": name or None,
        "parameters": [_described(constant) for constant in constants],
        "evidence": preset.evidence,
    }
    return json.dumps(_plain(document), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _described(constant: Constant) -> dict[str, Any]:
    """Return what JSON has of a constant: no range for choices, no choices for numbers."""
    fields = dict(vars(constant))
    low, high, options = (fields.pop(key) for key in ("low", "high", "choices"))
    if low is None:
        del fields["scale"]
        return fields | ({"choices": options} if options else {})
    return fields | {"range": [low, high]}


def _plain(value: Any) -> Any:
    """Return what JSON has a form for; null for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, str | bool | int | float) else str(value)


def _float32(value: Any) -> Any:
    """Return a float as the shortest decimal of its float32, and anything else as it is."""
    return float(str(np.float32(value))) if isinstance(value, float) else value


def _kind(value: Any) -> Literal["float", "int", "bool", "choice"]:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, str):
        return "choice"
    return "int" if isinstance(value, int) else "float"
