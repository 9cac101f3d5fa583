"""Presets: a filter's name and parameters in a YAML file, with the evidence that made them.

::

    filter: guertin2014
    params: {kappa: 31.2, third_gain: 5.1}
    evidence: {...}          # data, metric, split, figures, command: free form
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from torchblur.errors import ConfigError
from torchblur.filters import BlurFilter, get_filter, list_filters
from torchblur.filters.base import with_shutter
from torchblur.io.yaml import load_yaml, save_yaml
from torchblur.ops.compiling import EngineChoice
from torchblur.ops.gather import Storage
from torchblur.params import Config, build

__all__ = ["DEFAULT_FILTER", "Preset", "create_filter", "load_preset", "save_preset"]

DEFAULT_FILTER = "torchblur"
"""The best on scenes that nothing was fitted to; docs/crossfit.md has the figures."""


class Preset(Config):
    """A filter with its parameters, and where they come from."""

    filter: str
    """Registered name of the filter."""
    params: dict[str, Any] = Field(default_factory=dict)
    """Parameters that differ from the paper's defaults, by name."""
    evidence: dict[str, Any] = Field(default_factory=dict)
    """What the parameters were fitted to and how good they are; nothing reads it back."""


def load_preset(path: str | Path) -> Preset:
    """Read a preset and check its parameters.

    Args:
        path: A YAML file as `save_preset` or `torchblur tune` writes it.

    Raises:
        ConfigError: no such file, unknown filter or parameter, value out of range.
    """
    place = str(path)
    preset = build(Preset, load_yaml(path), place)
    try:
        get_filter(preset.filter)
    except ConfigError as error:
        raise ConfigError(f"{error} ({place}: filter)") from error
    build(get_filter(preset.filter).config_class, preset.params, f"{place}: params")
    return preset


def save_preset(
    path: str | Path,
    preset: Preset | BlurFilter,
    *,
    comment: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a preset so that `load_preset` and `create_filter` take it.

    Args:
        path: Where to.
        preset: What to write; of a filter, the values that it has now and that differ from its
            defaults.
        comment: Lines for the head of the file.
        overwrite: Replace an existing file.

    Raises:
        OutputError: the file exists and `overwrite` is off, or it cannot be written.
        ConfigError: a value of the filter has left its range, or the filter is not registered.
    """
    if isinstance(preset, BlurFilter):
        preset.current_config()  # refuses what `load_preset` would
        get_filter(preset.name)
        preset = Preset(filter=preset.name, params=preset.changed_params())
    save_yaml(path, preset.model_dump(), comment=comment, overwrite=overwrite)


def create_filter(
    name_or_preset: str | Path = DEFAULT_FILTER,
    *,
    engine: EngineChoice = "auto",
    storage: Storage = "full",
    **params: Any,
) -> BlurFilter:
    """Make a filter from its name or from a preset file.

    Args:
        name_or_preset: A registered name ("guertin2014"), or the path of a preset; torchblur's own
            filter if left out.
        engine: "auto", "eager" or "compiled"; see `BlurFilter`.
        storage: "full" or "half"; see `BlurFilter`.
        **params: Single parameters over the preset's: ``num_samples=15, kappa=30.0``. `shutter`
            may be a `Shutter`, which brings its position.

    Returns:
        A Module: ``blur(frame) -> (B, 3, H, W)``.

    Raises:
        ConfigError: neither a filter nor a file, unknown parameter, value out of range.

    Example:
        >>> create_filter("guertin2014", num_samples=15, kappa=30.0)
        Guertin2014Blur(num_samples=15, kappa=30.0)
    """
    name, params = str(name_or_preset), with_shutter(params)
    if (Path(name).suffix or Path(name).exists()) and name not in list_filters():
        preset = load_preset(name)
        name, params = preset.filter, preset.params | params
    return get_filter(name)(None, engine=engine, storage=storage, **params)
