"""Single values of a configuration replaced from the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from torchblur.errors import ConfigError

__all__ = ["apply_overrides"]


def apply_overrides(data: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return nested data with single values replaced.

    Args:
        data: As a YAML file gives it; left as it is.
        overrides: "key.path=value"; positions in lists count from 0.

    Raises:
        ConfigError: not of this form, or the path leads through a value or past a list's end.
    """
    result: Any = YAML(typ="safe", pure=True).load("{}") | _copied(data)
    for text in overrides:
        keys, equals, value = text.partition("=")
        if not equals or not keys:
            raise ConfigError(f"an override must be KEY.PATH=VALUE, got {text!r} (--set)")
        try:
            parsed = YAML(typ="safe", pure=True).load(value)
        except YAMLError as error:
            raise ConfigError(f"the value of {text!r} is not YAML (--set)") from error
        _put(result, keys.split("."), parsed, text)
    return dict(result)


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copied(item) for key, item in value.items()}
    return [_copied(item) for item in value] if isinstance(value, (list, tuple)) else value


def _put(target: Any, keys: list[str], value: Any, text: str) -> None:
    for key in keys[:-1]:
        target = _inside(target, key, text)
    last = keys[-1]
    if isinstance(target, dict):
        target[last] = value
    else:
        _inside(target, last, text)
        target[int(last)] = value


def _inside(target: Any, key: str, text: str) -> Any:
    if isinstance(target, dict):
        return target.setdefault(key, {})
    if isinstance(target, list) and key.isdigit() and int(key) < len(target):
        return target[int(key)]
    kind = f"a list of {len(target)}" if isinstance(target, list) else f"the value {target!r}"
    raise ConfigError(f"`{key}` leads into {kind}, got {text!r} (--set)")
