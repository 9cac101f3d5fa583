"""Filters that a configuration names, or gives as presets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchblur.errors import ConfigError
from torchblur.filters import get_filter, list_filters
from torchblur.presets import load_preset

__all__ = ["SHUTTER_KEYS", "named_filter"]

SHUTTER_KEYS = ("shutter", "shutter_position")
"""Parameters that belong to the data, which know how their references were made."""


def named_filter(name: str, folder: Path, place: str) -> tuple[str, dict[str, Any]]:
    """Return the name of a filter, and the parameters of its preset if one is given.

    Args:
        name: A registered name, or the path of a preset.
        folder: What the path is relative to.
        place: Key path with the file, for messages.

    Raises:
        ConfigError: neither a filter nor a preset.
    """
    if name in list_filters():
        return name, {}
    if not name.endswith((".yaml", ".yml")):
        try:
            get_filter(name)
        except ConfigError as error:
            raise ConfigError(f"{error} ({place})") from error
    preset = load_preset(folder / name)
    params = {key: v for key, v in preset.params.items() if key not in SHUTTER_KEYS}
    return preset.filter, params
