"""YAML 1.2 in and out: `1e-3` is a number, `on` is a word, and a key stands once."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode
from ruamel.yaml.representer import RepresenterError

from torchblur.errors import ConfigError, FileFormatError
from torchblur.io.paths import input_file, output_file

__all__ = ["line_of", "load_yaml", "save_yaml"]


def load_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML 1.2 file that holds a mapping.

    Args:
        path: The file, in UTF-8.

    Returns:
        Plain dicts, lists and scalars.

    Raises:
        FileFormatError: if the file does not exist, is empty or a folder.
        ConfigError: if it is not YAML, a key stands twice, or the top is not a mapping; with
            file, line and column.
    """
    path = input_file(path)
    try:
        data = YAML(typ="safe", pure=True).load(_text(path))
    except DuplicateKeyError as error:
        rule = (error.problem or "a key stands twice").split(" with value")[0]
        raise ConfigError(f"{_place(path, error)}: {rule}") from error
    except MarkedYAMLError as error:
        text = " ".join(part for part in (error.context, error.problem) if part)
        raise ConfigError(f"{_place(path, error)}: not YAML: {text}") from error
    except YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: must hold a mapping (`key: value`), got {_kind(data)}")
    return data


def save_yaml(
    path: str | Path,
    data: Mapping[str, Any],
    *,
    comment: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a mapping as YAML 1.2; the file appears whole or not at all.

    Args:
        path: The file to write.
        data: Nested mappings, sequences and scalars; tuples become lists.
        comment: Text above the data; each line gets a "# ".
        overwrite: Replace an existing file.

    Raises:
        ConfigError: if a value is of a kind that YAML has no form for.
        OutputError: if the file cannot be written, or exists and `overwrite` is false.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.allow_unicode = True
    yaml.width = 100
    stream = io.StringIO()
    for line in (comment or "").splitlines():
        stream.write(f"# {line}".rstrip() + "\n")
    try:
        yaml.dump(_plain(data), stream)
    except RepresenterError as error:
        raise ConfigError(f"{path}: YAML has no form for a value: {error}") from error
    with output_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(stream.getvalue(), encoding="utf-8")


def line_of(path: str | Path, key_path: Sequence[str | int]) -> int | None:
    """Return the line of a key, counted from 1, or None if the file does not have it.

    Args:
        path: A YAML file.
        key_path: Keys and positions from the top: ("filter", "params", "gamma").
    """
    node: Node | None = YAML(typ="safe", pure=True).compose(io.StringIO(_text(Path(path))))
    line: int | None = None
    for key in key_path:
        if node is None:
            return None
        node, line = _child(node, key)
    return line


def _child(node: Node, key: str | int) -> tuple[Node | None, int | None]:
    if isinstance(node, MappingNode):
        for name, value in node.value:
            if name.value == str(key):
                return value, name.start_mark.line + 1
    elif isinstance(node, SequenceNode) and str(key).isdigit() and int(key) < len(node.value):
        item = node.value[int(key)]
        return item, item.start_mark.line + 1
    return None, None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path} is not a text file in UTF-8 (byte {error.start}): YAML is needed"
        ) from error


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _place(path: Path, error: MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return str(path) if mark is None else f"{path}:{mark.line + 1}:{mark.column + 1}"


def _kind(data: Any) -> str:
    return "nothing" if data is None else f"a {type(data).__name__}"
