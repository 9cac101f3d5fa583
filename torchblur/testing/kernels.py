"""How often the engine compiles, counted without a C++ compiler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from torch._dynamo.utils import counters

from torchblur.ops import tap_kernels, taps
from torchblur.ops.compiling import compile_alone

__all__ = ["traced_kernels"]


def traced_kernels(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Let the engine "compiled" trace its kernels but run them eagerly; return what counts them.

    Args:
        monkeypatch: Undoes it after the test.
    """

    def trace(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        return compile_alone(function, **(options | {"backend": "eager"}))

    monkeypatch.setattr(tap_kernels, "compile_alone", trace)
    monkeypatch.setattr(taps, "compiler_works", lambda: True)
    fresh = tap_kernels.kernel_of.__wrapped__
    kernels: dict[Any, Any] = {}

    def kernel(*key: Any) -> Any:
        if key not in kernels:
            kernels[key] = fresh(*key)
        return kernels[key]

    monkeypatch.setattr(taps, "kernel_of", kernel)
    before: int = counters["stats"]["unique_graphs"]
    return lambda: int(counters["stats"]["unique_graphs"]) - before
