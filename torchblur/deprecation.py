"""How a public name goes: one minor version with a warning, then gone (docs/stability.md)."""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import typing_extensions

__all__ = ["deprecated", "old_names"]

T = TypeVar("T", bound=Callable[..., Any])


def deprecated(*, since: str, use: str) -> Callable[[T], T]:
    """Mark a public function or class as deprecated.

    A call warns with a `DeprecationWarning` at the caller's line, which Python shows once per
    line; the docstring says it too.

    Args:
        since: First version that warns, "0.2".
        use: What to use instead.

    Example:
        >>> @deprecated(since="0.2", use="list_filters()")
        ... def registered_filters(): ...
    """

    def mark(target: T) -> T:
        target.__doc__ = (
            f"{inspect.getdoc(target) or ''}\n\nDeprecated: since {since}; use `{use}`."
        )
        return typing_extensions.deprecated(_message(target.__qualname__, since, use))(target)

    return mark


def old_names(module: str, *, since: str, **names: str) -> Callable[[str], Any]:
    """Return a `__getattr__` for a module some of whose names have changed.

    Args:
        module: The module's `__name__`.
        since: First version that warns.
        **names: The new name of each old one: ``Sequence="FrameSequence"``.
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        message = _message(f"{module}.{name}", since, f"{module}.{names[name]}")
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return find


def _message(name: str, since: str, use: str) -> str:
    return f"`{name}` is deprecated since torchblur {since}; use `{use}`"
