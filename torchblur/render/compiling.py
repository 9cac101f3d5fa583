"""Compile the renderer's inner functions, and go on without a compiler where there is none."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal

from torchblur.errors import ConfigError
from torchblur.ops.compiling import (
    compile_alone,
    compiler_errors,
    compiler_works,
    give_up_compiling,
)

__all__ = ["Engine", "check_engine", "execute"]

Engine = Literal["auto", "eager", "compiled"]


def check_engine(engine: str) -> None:
    """Refuse a name that is no engine.

    Raises:
        ConfigError: if it is not "auto", "eager" or "compiled".
    """
    if engine not in ("auto", "eager", "compiled"):
        raise ConfigError(f"`engine` must be 'auto', 'eager' or 'compiled', got {engine!r}")


def execute(function: Callable[..., Any], compile_it: bool, *arguments: Any) -> Any:
    """Call a function of tensors, compiled if asked for and possible.

    A function is compiled on its first call per process, and anew only for another number of
    nested motions; it must be called with one size of tensors.

    Args:
        function: Pure function of tensors.
        compile_it: Whether to compile. If that fails there is one warning per process, and all
            calls run eagerly from then on.
        arguments: Passed on.

    Returns:
        What the function returns.
    """
    if compile_it and compiler_works():
        try:
            return _compiled(function)(*arguments)
        except compiler_errors() as error:
            give_up_compiling(error)
    return function(*arguments)


@functools.cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return compile_alone(function, dynamic=False, fullgraph=True)
