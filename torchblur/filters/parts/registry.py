"""Filters by name: those of torchblur, of installed packages, and of a Python file.

Making a `BlurFilter` class with a `name` registers it. A package of its own names its filters as
entry points, so that they are found wherever the package is installed::

    [project.entry-points."torchblur.filters"]
    mine = "my_package.blur:MyBlur"      # or a module whose import makes the classes

Files that the variable TORCHBLUR_PLUGINS names, as PATH names folders, are loaded likewise.
"""

from __future__ import annotations

import os
import sys
import threading
import traceback
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import SourceFileLoader
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from torchblur.deprecation import deprecated
from torchblur.errors import ConfigError, FileFormatError, nearest_name

if TYPE_CHECKING:
    from torchblur.filters.parts.base import BlurFilter

__all__ = [
    "ENTRY_POINTS",
    "PLUGINS",
    "get_filter",
    "list_filters",
    "load_plugin",
    "register_filter",
]

ENTRY_POINTS = "torchblur.filters"
"""Group of entry points by which a package offers its filters."""

PLUGINS = "TORCHBLUR_PLUGINS"
"""Environment variable with Python files that make filters, for a process and those it starts."""

FilterT = TypeVar("FilterT", bound="type[BlurFilter]")

_REGISTRY: dict[str, type[BlurFilter]] = {}
_LOCK = threading.RLock()
_searched = False  # whether the entry points have been tried


def register_filter(cls: FilterT) -> FilterT:
    """Register a filter by its `name`; a class that has one of its own is registered when made.

    A class of the same module and qualified name replaces the one before, so that a notebook's
    cell can run again and a module can be reloaded.

    Args:
        cls: A subclass of `BlurFilter`.

    Returns:
        The same class: the function is a decorator, too.

    Raises:
        ConfigError: no `name`, or another filter has it.
    """
    name, place = getattr(cls, "name", None), _place(cls)
    if not (isinstance(name, str) and name):
        raise ConfigError(f"a filter's `name` must be a text, got {name!r} ({place})")
    taken = _REGISTRY.get(name, cls)
    if _place(taken) != place:
        raise ConfigError(
            f"a filter's `name` must be its own, got `{name}`, which is {_place(taken)} ({place}); "
            "give the class another `name`"
        )
    _REGISTRY[name] = cls
    return cls


def list_filters() -> dict[str, type[BlurFilter]]:
    """Return the filters by name, those of installed packages and of plugins among them."""
    _load_installed()
    return dict(sorted(_REGISTRY.items()))


def get_filter(name: str) -> type[BlurFilter]:
    """Return a filter's class by its registered name.

    Raises:
        ConfigError: if there is none; names the nearest.
    """
    if name not in _REGISTRY:
        _load_installed()
    if name not in _REGISTRY:
        raise ConfigError(
            f"unknown filter `{name}`{nearest_name(name, _REGISTRY)}; "
            f"filters: {', '.join(sorted(_REGISTRY))}"
        )
    return _REGISTRY[name]


def load_plugin(path: str | Path) -> dict[str, type[BlurFilter]]:
    """Run a Python file that makes filters, and return them by name.

    Loading a file again replaces its filters. Other processes must load it too before they
    unpickle its filters.

    Args:
        path: The file. Like any Python file it may do anything: load only what you trust.

    Raises:
        FileFormatError: no such file.
        ConfigError: it fails, with the first cause and its line, makes no filter, or one whose
            name is taken. Then none of its filters is registered.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder; a Python file is needed" if path.is_dir() else "does not exist"
        raise FileFormatError(f"the plugin {path} {what}")
    name = f"torchblur_plugin_{path.stem}_{zlib.crc32(str(path.resolve()).encode()):08x}"
    with _all_or_nothing() as before:
        _run(path, name)
        made = {key: cls for key, cls in _REGISTRY.items() if before.get(key) is not cls}
        if not made:
            raise ConfigError(
                f"the plugin {path} makes no filter; a filter is a subclass of "
                "`torchblur.BlurFilter` with a `name`"
            )
    return made


@deprecated(since="0.2", use="list_filters()")
def registered_filters() -> dict[str, type[BlurFilter]]:
    """Return the filters by name."""
    return list_filters()


def _place(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


@contextmanager
def _all_or_nothing() -> Iterator[dict[str, type[BlurFilter]]]:
    """Give the filters as they are, to which an error in the block returns."""
    with _LOCK:
        before = dict(_REGISTRY)
        try:
            yield before
        except BaseException:
            _REGISTRY.clear()
            _REGISTRY.update(before)
            raise


def _load_installed() -> None:
    """Load all entry points and the files of `PLUGINS`, once.

    An entry point that is broken is one warning; a file that is, which somebody asked for, an
    error.
    """
    global _searched
    with _LOCK:
        if _searched:
            return
        _searched = True  # first: a package may ask for filters while it is imported
        for entry in entry_points(group=ENTRY_POINTS):
            try:
                with _all_or_nothing():
                    _load_entry(entry)
            except Exception as error:
                owner = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "a package"
                warnings.warn(
                    f"the filter `{entry.name}` of {owner} cannot be loaded and is left out: "
                    f"{type(error).__name__}: {error} (entry point {entry.value})",
                    stacklevel=3,
                )
        try:
            for path in filter(None, os.environ.get(PLUGINS, "").split(os.pathsep)):
                load_plugin(path)
        except BaseException:
            _searched = False
            raise


def _load_entry(entry: EntryPoint) -> None:
    loaded: Any = entry.load()
    if isinstance(loaded, ModuleType):
        return  # its classes were registered when they were made
    if not (isinstance(loaded, type) and hasattr(loaded, "config_class")):
        raise ConfigError(f"a filter's class or a module is needed, got {loaded!r}")
    register_filter(loaded)


def _run(path: Path, name: str) -> None:
    loader = SourceFileLoader(name, str(path))
    spec = spec_from_loader(name, loader)
    assert spec is not None
    module, old = module_from_spec(spec), sys.modules.get(name)
    sys.modules[name] = module
    try:
        loader.exec_module(module)
    except (Exception, SystemExit) as error:
        if old is None:
            del sys.modules[name]
        else:
            sys.modules[name] = old
        raise ConfigError(
            f"the plugin {path} cannot be loaded: {type(error).__name__}: {error}"
            f"{_line_in(path, error)}"
        ) from error


def _line_in(path: Path, error: BaseException) -> str:
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
    return f" (line {lines[-1]})" if lines else ""
