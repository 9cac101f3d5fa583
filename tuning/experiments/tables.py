"""What experiments write: tables as Markdown, CSV, and JSON with every figure."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from torchblur.io.paths import output_file
from tuning.files.outputs import make_folders, refuse_existing

__all__ = ["check_outputs", "csv_text", "json_text", "markdown_table", "write_texts"]


class _Titled(Protocol):
    @property
    def title(self) -> str: ...

    def model_dump(self, *, mode: str) -> dict[str, Any]: ...


def check_outputs(folder: Path, names: Sequence[str], *, overwrite: bool = False) -> None:
    """Refuse before the work what would be refused after it.

    Args:
        folder: Where the files will go; it is made.
        names: Their names.
        overwrite: Replace files that are there.

    Raises:
        OutputError: one of them exists, or the folder cannot be made.
    """
    paths = [folder / name for name in names]
    refuse_existing(paths, overwrite=overwrite)
    make_folders(paths)


def write_texts(folder: Path, texts: Mapping[str, str], *, overwrite: bool = True) -> list[Path]:
    """Write files, all of them or none.

    Args:
        folder: Where to; it is made.
        texts: Their contents by name.
        overwrite: Replace files that are there.

    Raises:
        OutputError: one of them exists, or cannot be written.
    """
    check_outputs(folder, list(texts), overwrite=overwrite)
    paths = [folder / name for name in texts]
    with ExitStack() as stack:
        for path, text in zip(paths, texts.values(), strict=True):
            temporary = stack.enter_context(output_file(path, overwrite=overwrite))
            temporary.write_text(text, encoding="utf-8")
    return paths


def markdown_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, left: Sequence[int] = (0,)
) -> list[str]:
    """Return the lines of a table, and an empty one.

    Args:
        head: Headings.
        rows: Cells.
        left: Columns that are not set flush right.
    """
    rule = ["---" if index in left else "---:" for index in range(len(head))]
    return [*map(_line, (head, rule, *rows)), ""]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a CSV file: six digits of floats, and nothing for None."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        writer.writerow([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in row])
    return buffer.getvalue()


def json_text(config: _Titled, *, indent: int = 1, **found: Any) -> str:
    """Return a JSON file: title and version, what was found, and the configuration."""
    data = {
        "title": config.title,
        "torchblur": version("torchblur"),
        **found,
        "config": config.model_dump(mode="json"),
    }
    return json.dumps(data, indent=indent, ensure_ascii=False) + "\n"
