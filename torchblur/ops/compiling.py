"""What is needed to compile with `torch.compile`, and to go on where there is no compiler."""

from __future__ import annotations

import functools
import importlib
import warnings

__all__ = ["compiler_errors", "load_compiler", "warn_no_compiler"]


@functools.cache
def load_compiler() -> None:
    """Load torch's compiler without the warnings that it gives of itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("torch._inductor.compile_fx")


def compiler_errors() -> tuple[type[Exception], ...]:
    """Return the errors of torch.compile itself; what else goes wrong is not to be hidden."""
    from torch._dynamo.exc import BackendCompilerFailed  # imported late: it is slow to load
    from torch._inductor.exc import InductorError

    return BackendCompilerFailed, InductorError


@functools.cache
def warn_no_compiler(reason: str) -> None:
    """Warn, once per reason and process, that code runs without the compiler.

    Args:
        reason: First line of the compiler's error.
    """
    warnings.warn(
        f"torch.compile does not work here ({reason}); going on without it, which is slower",
        stacklevel=3,
    )
