"""`data` of a configuration as the path of a file, so that several fits have one description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchblur.errors import ConfigError, FileFormatError
from torchblur.io import load_yaml
from torchblur.params import build
from tuning.data_config import DataSpec
from tuning.overrides import apply_overrides

__all__ = ["with_shared_data"]


def with_shared_data(
    content: Mapping[str, Any], path: Path, overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Return a configuration's content with overrides, and with `data` read from its file if any.

    The file holds what would stand under `data`; its `root` is relative to itself. Overrides of
    single values (``data.train.0.spp=8``) count for what was read; ``data=other.yaml`` takes
    another file, relative to the working folder.

    Args:
        content: As the YAML file gives it; left as it is.
        path: The configuration's file.
        overrides: "key.path=value", value in YAML.

    Raises:
        ConfigError: no such file, or a mistake in it; with its name and the key.
    """
    whole = [text for text in overrides if text.startswith("data=")]
    content = apply_overrides(content, whole)
    if isinstance(content.get("data"), str):
        folder = Path.cwd() if whole else path.parent
        content = content | {"data": _read(folder / content["data"], f"{path}: data")}
    return apply_overrides(content, [text for text in overrides if text not in whole])


def _read(path: Path, where: str) -> dict[str, Any]:
    try:
        data = load_yaml(path)
    except FileFormatError as error:
        raise ConfigError(
            f"`data` must be a mapping, or the path of a YAML file with one: {error} ({where})"
        ) from error
    spec = build(DataSpec, data, str(path))
    return data | {"root": str((path.parent / spec.root).resolve())}
