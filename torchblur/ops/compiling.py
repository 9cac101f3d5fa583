"""What is needed to compile with `torch.compile`, and to go on where there is no compiler.

Compiled kernels are kept on disk, so that only the first process of all compiles them: see
`kernel_folder`.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import itertools
import os
import platform
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FunctionType
from typing import Any, Literal

import torch

__all__ = [
    "GRADIENT_CALLS",
    "EngineChoice",
    "cache_folder",
    "compile_alone",
    "compiler_errors",
    "compiler_works",
    "give_up_compiling",
    "kernel_folder",
    "load_compiler",
    "stop_compiling",
    "worth_compiling",
]

EngineChoice = Literal["auto", "eager", "compiled"]

_WORTH_COMPILING = {"cpu": 5e8, "cuda": 2.5e10}  # taps of pixels; a GPU is 50 times as fast
GRADIENT_CALLS = 4
"""How many calls without a gradient take as long as one with it."""

_CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"

_numbers = itertools.count()
_lock = threading.Lock()
_state = {"works": True, "looked": False}


def cache_folder() -> Path:
    """Return where torchblur keeps what costs time to make.

    TORCHBLUR_CACHE, or `torchblur` in XDG_CACHE_HOME, or `~/.cache/torchblur`.
    """
    if own := os.environ.get("TORCHBLUR_CACHE"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "torchblur"


def worth_compiling(work: float, device: torch.device | str = "cpu") -> bool:
    """Return whether an amount of work takes so long that compiling for it pays.

    The first compilation takes a core some 15 s for a filter, and as long again for its gradient;
    what is kept on disk is loaded in 3 s. An eager tap of a pixel takes 60 ns, so the limit is at
    30 s of eager work, or less where many pixels stand still. The answer does not depend on what
    is on disk, so that the same work is always done in the same way.

    Args:
        work: Pixels times taps times calls; a call with its gradient counts `GRADIENT_CALLS`.
        device: Where it is done.
    """
    return work > _WORTH_COMPILING.get(torch.device(device).type, _WORTH_COMPILING["cpu"])


def kernel_folder() -> Path:
    """Return where compiled kernels are kept.

    TORCHINDUCTOR_CACHE_DIR if it is set (not by torch itself, which sets it to a temporary folder
    as soon as its compiler is loaded), else `kernels` in `cache_folder`.
    """
    own = _chosen_folder()
    return Path(own) if own else cache_folder() / "kernels"


@functools.cache
def load_compiler() -> None:
    """Load torch's compiler without the warnings that it gives of itself; set its cache."""
    _keep_kernels()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("torch._inductor.compile_fx")


def compiler_errors() -> tuple[type[Exception], ...]:
    """Return the errors of torch.compile itself; what else goes wrong is not to be hidden."""
    from torch._dynamo.exc import BackendCompilerFailed  # imported late: it is slow to load
    from torch._inductor.exc import InductorError

    return BackendCompilerFailed, InductorError


def compiler_works() -> bool:
    """Return whether it makes sense to compile; if not, there was one notice in this process.

    False where there is no C++ compiler, and after `give_up_compiling`.
    """
    with _lock:
        if not _state["looked"]:
            _state["looked"] = True
            reason = _missing_compiler()
            if reason is not None:
                _stop(reason)
        return _state["works"]


def give_up_compiling(error: Exception) -> None:
    """Compile nothing more in this process, with one notice; from any thread.

    Args:
        error: What torch.compile raised.
    """
    with _lock:
        if _state["works"]:
            _stop((str(error).splitlines() or [type(error).__name__])[0])


def stop_compiling() -> None:
    """Compile nothing more in this process, because that is asked for: without a notice."""
    with _lock:
        _state.update(works=False, looked=True)


def compile_alone(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Return a function compiled by `torch.compile`, with a count of compilations of its own.

    Torch counts compilations per code object and after a few compiles no more, without an error;
    all functions that one line of code makes share theirs. Each gets a copy here.

    Args:
        function: What is compiled.
        **options: Of `torch.compile`.
    """
    load_compiler()
    _look_at_processor()
    name = f"{function.__name__}_{next(_numbers)}"
    own = FunctionType(
        function.__code__.replace(co_name=name),
        function.__globals__,
        name,
        function.__defaults__,
        function.__closure__,
    )
    return torch.compile(own, **options)


@functools.cache
def _look_at_processor() -> None:
    """Let torch find out which vectors the CPU has, beside all else that comes before a kernel.

    It compiles and loads small programs for that, one by one: 9 s once, 1.5 s in each process. Here
    they run side by side.
    """

    def look() -> None:
        with contextlib.suppress(Exception):  # torch does it again where it needs it, and tells
            torchs = importlib.import_module("torch._inductor.cpu_vec_isa")
            known = torchs.x86_isa_checker() if platform.machine() in ("x86_64", "AMD64") else []
            kinds = [k for k in torchs.supported_vec_isa_list if set(str(k).split()) <= set(known)]
            with ThreadPoolExecutor() as pool:
                list(pool.map(bool, kinds))  # each keeps its answer
            torchs.valid_vec_isa_list()

    if not torch.cuda.is_available():
        threading.Thread(target=look, name="torchblur-processor", daemon=True).start()


def _chosen_folder() -> str | None:
    """Return the folder for kernels that the user has chosen, if so."""
    own = os.environ.get(_CACHE_VARIABLE)
    if not own:
        return None
    torchs = importlib.import_module("torch._inductor.runtime.cache_dir_utils").default_cache_dir()
    return None if own == torchs else own


def _keep_kernels() -> None:
    """Tell torch where kernels are kept, if the user did not; its default is a temporary folder."""
    if _chosen_folder():
        return
    folder = kernel_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        os.environ[_CACHE_VARIABLE] = str(folder)


def _missing_compiler() -> str | None:
    """Return why the CPU's kernels cannot be compiled, or None; a GPU has a compiler of its own."""
    if torch.cuda.is_available():
        return None
    load_compiler()
    find = importlib.import_module("torch._inductor.cpp_builder").get_cpp_compiler
    try:
        find()
    except Exception:  # of several kinds, by platform
        return "no C++ compiler"
    return None


def _stop(reason: str) -> None:
    _state["works"] = False
    warnings.warn(
        f"torch.compile does not work here ({reason}); going on without it, which is 2 to 5 times "
        "slower. Install a C++ compiler (g++, clang++) or name one in CXX; `engine: eager` "
        "(--no-compile) goes without it and without this notice",
        stacklevel=4,
    )
