"""Constants in HLSL and GLSL: declarations, names and comments that both languages take."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from torchblur.errors import ConfigError

__all__ = ["header_lines", "shader_text"]

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_CONST = {"hlsl": "static const", "glsl": "const"}
_PLAIN = {"·": "*", "×": "x", "−": "-", "–": "-", "…": "...", "²": "^2", "³": "^3", "→": "->"}
_SHOWN = ("flip", "psnr", "ssim", "flip_band", "flip_median", "temporal")

# Words of both languages that a parameter could be called; names here are lower case.
_RESERVED = frozenset(
    """active asm attribute blendstate bool break buffer case cast cbuffer centroid class coherent
    column_major common compile const continue default discard do double dword else enum export
    extern external false filter fixed flat float for fxgroup goto groupshared half highp hvec2
    if in inline inout input int interface invariant iimage2d layout line lineadj linear long
    lowp matrix mediump namespace noinline nointerpolation noperspective out output packoffset
    partition pass patch pixelfragment point precise precision public readonly register resource
    restrict return row_major sample sampler sampler1d sampler2d sampler3d samplerstate shader
    shared short signed sizeof smooth snorm stateblock static string struct subroutine superp
    switch tbuffer technique template texture texture2d this true triangle typedef uint uniform
    union unorm unsigned using varying vector vertexfragment void volatile while writeonly
    abs acos all any asin atan ceil clamp cos cross degrees distance dot exp exp2 floor fract
    fma frac inversesqrt length lerp log log2 max min mix mod mul noise normalize pow radians
    reflect refract round rsqrt saturate sign sin smoothstep sqrt step tan transpose
    trunc""".split()
)


def shader_text(
    constants: Sequence[Mapping[str, Any]],
    language: Literal["hlsl", "glsl"],
    *,
    head: Iterable[str],
    guard: str,
    prefix: str,
) -> str:
    """Return a file of constants that can be included.

    Args:
        constants: The fields of each `Constant`.
        language: "hlsl" or "glsl".
        head: Lines of the comment at its top.
        guard: Name of the definition that keeps it from being included twice.
        prefix: Before each name.

    Raises:
        ConfigError: if the prefix makes a name that one of the languages does not take.
    """
    if prefix and not _NAME.fullmatch(prefix):
        raise ConfigError(
            f"`prefix` must be letters, digits and _, and begin with no digit, got {prefix!r}"
        )
    guard = _checked(guard.upper(), prefix)
    lines = [f"// {_comment(line)}".rstrip() for line in head]
    lines += ["", f"#ifndef {guard}", f"#define {guard}"]
    for constant in constants:
        lines += ["", *_about(constant), *_declared(constant, language, prefix)]
    return "\n".join([*lines, "", f"#endif  // {guard}", ""])


def header_lines(
    filter_name: str, preset: str, evidence: Mapping[str, Any], version: str
) -> list[str]:
    """Return what stands at the top of a file: filter, preset, version, figures.

    Args:
        filter_name: Registered name of the filter.
        preset: Where the preset came from; may be empty.
        evidence: Of the preset; what `torchblur tune` writes is understood, all else left out.
        version: Of torchblur.
    """
    of = preset or "as published"
    lines = [f"Motion-blur filter {filter_name}, {of}; written by torchblur {version}."]
    figures = evidence.get("figures")
    if isinstance(figures, Mapping):
        names = {"holdout": "hold-out", "train": "training"}
        for split, label in names.items():
            text = _figures(figures.get(split))
            if text:
                lines.append(f"Evidence, {label} frames, published -> tuned: {text}.")
    if isinstance(evidence.get("command"), str):
        lines.append(f"Made by: {evidence['command']}")
    return lines


def _figures(split: Any) -> str:
    """Return "flip 0.0596 -> 0.0394, …", or nothing if the figures are of another form."""
    if not isinstance(split, Mapping):
        return ""
    others = [value for name, value in split.items() if name != "default"]
    before, after = split.get("default"), others[0] if len(others) == 1 else split.get("tuned")
    if not isinstance(before, Mapping) or not isinstance(after, Mapping):
        return ""
    both = [m for m in _SHOWN if _is_number(before.get(m)) and _is_number(after.get(m))]
    return ", ".join(f"{m} {before[m]:.4g} -> {after[m]:.4g}" for m in both)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


# -- one constant ----------------------------------------------------------------------------------


def _about(constant: Mapping[str, Any]) -> list[str]:
    """Return the comment above a constant."""
    known = [constant["symbol"]] if constant["symbol"] else []
    known += [constant["unit"]] if constant["unit"] != "1" else []
    if constant["low"] is not None:
        known.append(f"{constant['low']:g} to {constant['high']:g}")
    text = f"{constant['meaning']} [{'; '.join(known)}]" if known else constant["meaning"]
    return [f"// {_comment(text)} ({_comment(constant['source'])})"]


def _declared(constant: Mapping[str, Any], language: str, prefix: str) -> list[str]:
    name = _checked(f"{prefix}{constant['name']}", prefix)
    note = f"  // published: {_literal(constant['default'])}" if constant["tuned"] else ""
    if constant["kind"] != "choice":
        kind, literal = constant["kind"], _literal(constant["value"])
        return [f"{_CONST[language]} {kind} {name} = {literal};{note}"]
    options = constant["choices"]
    listed = ", ".join(f"{number} {option}" for number, option in enumerate(options))
    note = f"; published: {constant['default']}" if constant["tuned"] else ""
    numbers = [
        f"#define {_checked(f'{name}_{option}', prefix)} {number}"
        for number, option in enumerate(options)
    ]
    chosen = f"#define {name} {options.index(constant['value'])}"
    return [*numbers, f"{chosen}  // {constant['value']} of {listed}{note}"]


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(np.float32(value)) if isinstance(value, float) else str(value)


def _checked(name: str, prefix: str) -> str:
    """Return a name that both languages take.

    Raises:
        ConfigError: if one of them does not.
    """
    good = _NAME.fullmatch(name) and "__" not in name and not name.lower().startswith("gl_")
    if not good or name.lower() in _RESERVED:
        raise ConfigError(
            f"`{name}` is no valid name in both HLSL and GLSL; another `prefix` is needed, "
            f"got {prefix!r}"
        )
    return name


# -- comments --------------------------------------------------------------------------------------


def _comment(text: str) -> str:
    """Return a text as one line of ASCII that does not swallow the next."""
    line = " ".join(text.split())
    return "".join(_ascii(character) for character in line).rstrip("\\ ")


def _ascii(character: str) -> str:
    if character.isascii():
        return character
    if character in _PLAIN:
        return _PLAIN[character]
    words = unicodedata.name(character, "").split()
    if words[:1] == ["GREEK"]:
        return words[-1].lower() if "SMALL" in words else words[-1].title()
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return plain or "?"
