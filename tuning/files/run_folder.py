"""The folder of a run: nothing half-written, one process at a time, ready to go on after a kill."""

from __future__ import annotations

import fcntl
import io
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from torchblur.errors import ConfigError, OutputError
from torchblur.io import load_yaml, save_yaml
from tuning.config.fit import TuneConfig

__all__ = ["RunFolder", "open_run", "trim_torn_line"]

_LOCK = "run.lock"


class RunFolder:
    """Files of one run.

    Args:
        path: The folder; it exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def log_path(self) -> Path:
        """One JSON object per step, trial or event."""
        return self.path / "log.jsonl"

    def write(self, name: str, content: bytes | str) -> Path:
        """Write a file whole or not at all, over an older one.

        Args:
            name: Its name in the folder.
            content: Bytes, or text in UTF-8.

        Raises:
            OutputError: if it cannot be written.
        """
        path = self.path / name
        temporary = self.path / f".{name}.part"
        try:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
            temporary.replace(path)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        return path

    def save_state(self, name: str, state: dict[str, Any]) -> None:
        """Write a checkpoint: tensors, numbers, and dicts and lists of them."""
        buffer = io.BytesIO()
        torch.save(state, buffer)
        self.write(name, buffer.getvalue())

    def load_state(self, name: str) -> dict[str, Any] | None:
        """Return a checkpoint, or None if there is none yet."""
        path = self.path / name
        if not path.is_file():
            return None
        state: dict[str, Any] = torch.load(path, weights_only=True)
        return state

    def log(self, **record: Any) -> None:
        """Append a line to the log."""
        try:
            with self.log_path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
        except OSError as error:
            raise OutputError(f"cannot write {self.log_path}: {error.strerror}") from error

    def records(self) -> list[dict[str, Any]]:
        """Return the lines of the log."""
        if not self.log_path.is_file():
            return []
        lines = self.log_path.read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines if line.strip()]

    def drop_records(self, method: int, first_step: int) -> set[int]:
        """Remove what was logged after the checkpoint that a method goes on from.

        Args:
            method: Position of the method. Later ones, which only follow a finished one, stay.
            first_step: First step that will be done again.

        Returns:
            The steps of this method that are in the log.
        """
        kept = [r for r in self.records() if _is_kept(r, method, first_step)]
        self.write("log.jsonl", "".join(json.dumps(record) + "\n" for record in kept))
        return {record["step"] for record in kept if record.get("method") == method}


@contextmanager
def open_run(
    path: Path, config: TuneConfig, *, resume: bool = False, overwrite: bool = False
) -> Iterator[RunFolder]:
    """Make or reopen the folder of a run and keep other processes out of it.

    Args:
        path: The folder.
        config: The resolved configuration.
        resume: Go on with what is there; start if nothing is.
        overwrite: Remove a run that is there.

    Raises:
        OutputError: it exists and neither is asked for, it is no run, it cannot be written to,
            or another process works in it.
        ConfigError: it was begun with another configuration; the keys that differ are named.
    """
    begun = (path / "config.yaml").is_file()
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file; a folder for the run is needed")
    if begun and not resume and not overwrite:
        raise OutputError(
            f"{path} has a run already; resume=True (--resume) goes on with it, overwrite=True "
            "(--overwrite) removes it"
        )
    foreign = path.is_dir() and not begun and any(_is_foreign(f) for f in path.iterdir())
    if foreign:
        raise OutputError(f"{path} has files that are no run; give a new or an empty folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = (path / _LOCK).open("w")
    except OSError as error:
        raise OutputError(f"cannot write into {path}: {error.strerror}") from error
    with lock:
        _lock_or_refuse(lock.fileno(), path)
        if begun and not resume:
            _empty(path)
            begun = False
        if begun:
            _refuse_other_config(path / "config.yaml", config)
        else:
            save_yaml(path / "config.yaml", config.model_dump(mode="json"), overwrite=True)
        trim_torn_line(path / "log.jsonl")
        yield RunFolder(path)


def trim_torn_line(path: Path) -> None:
    """Cut off a last line without its end, which a killed process may leave in a log."""
    if not path.is_file():
        return
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        os.truncate(path, len(whole))


def _is_kept(record: dict[str, Any], method: int, step: int) -> bool:
    return record.get("method") != method or bool(record["step"] < step)


def _lock_or_refuse(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise OutputError(f"another process works in {path}") from error


def _empty(path: Path) -> None:
    for entry in path.iterdir():
        if entry.name == _LOCK:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _refuse_other_config(path: Path, config: TuneConfig) -> None:
    old = _flat(load_yaml(path))
    new = _flat(config.model_dump(mode="json"))
    keys = sorted(k for k in old.keys() | new.keys() if old.get(k) != new.get(k))
    if keys:
        lines = [f"  {k}: was {old.get(k)!r}, now {new.get(k)!r}" for k in keys]
        raise ConfigError(
            f"{path.parent} was begun with another configuration and cannot be resumed with this "
            "one:\n" + "\n".join(lines)
        )


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        items = [(str(key), item) for key, item in value.items()]
    elif isinstance(value, list):
        items = [(str(index), item) for index, item in enumerate(value)]
    else:
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in items:
        flat |= _flat(item, f"{prefix}.{key}" if prefix else key)
    return flat


def _is_foreign(path: Path) -> bool:
    """Return whether a file is none that a run killed at its very start leaves behind."""
    return path.name != _LOCK and not path.name.startswith(".")
