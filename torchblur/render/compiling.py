"""Compile the renderer's inner functions, and go on without a compiler where there is none."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import FunctionType
from typing import Any, Literal

import torch

from torchblur.errors import ConfigError
from torchblur.ops.compiling import compiler_errors, load_compiler, warn_no_compiler

__all__ = ["Engine", "check_engine", "execute"]

Engine = Literal["auto", "eager", "compiled"]

_state = {"works": True}


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
    if compile_it and _state["works"]:
        try:
            return _compiled(function)(*arguments)
        except compiler_errors() as error:
            _state["works"] = False
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            warn_no_compiler(reason)
    return function(*arguments)


@functools.cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    # Closures of one factory share their code, and torch counts compilations per code object:
    # with a copy of the code each kind of body and texture has a count of its own.
    code = function.__code__.replace(co_name=function.__name__)
    own = FunctionType(
        code, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    load_compiler()
    return torch.compile(own, dynamic=False, fullgraph=True)
