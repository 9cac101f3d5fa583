"""How one call is measured: time, memory, and on a GPU events, waits and graphs."""

from __future__ import annotations

import ctypes
import gc
import statistics
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

import torchblur
from tuning.bench.machine import other_cores, read_ticks

__all__ = ["Times", "exact_allocation", "find_sync", "graph_ms", "peak_mib", "place_of", "repeat"]

Call = Callable[[], object]

_LEAST_RUNS = 3
_MMAP_THRESHOLD = -3  # glibc's M_MMAP_THRESHOLD
_EXACT_BYTES = 65536
_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")
_LIBRARY = Path(torchblur.__file__).parent


@dataclass(frozen=True, kw_only=True)
class Times:
    """Medians over the runs.

    Args:
        runs: How many.
        wall: Seconds.
        cpu: CPU-seconds of all threads.
        device: Milliseconds between CUDA events, or None.
        spread: (slowest - fastest) / median, of the wall times.
        others: Cores that others used, or None if that is not known.
        waited: Whether this process waited for a core.
    """

    runs: int
    wall: float
    cpu: float
    device: float | None
    spread: float
    others: float | None
    waited: bool


def repeat(call: Call, device: torch.device, runs: int, seconds: float) -> Times:
    """Call again and again and return medians; the caller has warmed up.

    Args:
        call: What is measured.
        device: Where it runs.
        runs: Timed runs.
        seconds: After so long no new run begins, if there are three.
    """
    walls: list[float] = []
    cpus: list[float] = []
    events: list[float] = []
    on_gpu = device.type == "cuda"
    gc.collect()
    before, own = read_ticks(), time.process_time()
    began = time.perf_counter()
    while len(walls) < runs:
        if len(walls) >= _LEAST_RUNS and time.perf_counter() - began > seconds:
            break
        start = time.process_time(), time.perf_counter()
        if on_gpu:
            events.append(_between_events(call, device))
        else:
            call()
        walls.append(time.perf_counter() - start[1])
        cpus.append(time.process_time() - start[0])
    others = other_cores(before, read_ticks(), time.process_time() - own)
    wall, cpu = statistics.median(walls), statistics.median(cpus)
    return Times(
        runs=len(walls),
        wall=wall,
        cpu=cpu,
        device=statistics.median(events) if events else None,
        spread=(max(walls) - min(walls)) / max(wall, 1e-9),
        others=others,
        # A process that only computes has at least one thread on a core all the time.
        waited=not on_gpu and sum(walls) > 0.05 and sum(cpus) < 0.9 * sum(walls),
    )


def _between_events(call: Call, device: torch.device) -> float:
    """Return the milliseconds that the device spent from before the call to after it."""
    with torch.cuda.device(device):
        first = torch.cuda.Event(enable_timing=True)
        last = torch.cuda.Event(enable_timing=True)
        torch.cuda.synchronize()
        first.record()
        call()
        last.record()
        torch.cuda.synchronize()
        return float(first.elapsed_time(last))


# -- memory ----------------------------------------------------------------------------------------


def exact_allocation() -> bool:
    """Make the allocator hand freed tensors back at once, so that peaks show; it is slower.

    Returns:
        Whether that can be done here (glibc); without it `peak_mib` returns None on the CPU.
    """
    try:
        libc = ctypes.CDLL(None)
        return bool(libc.mallopt(_MMAP_THRESHOLD, _EXACT_BYTES)) and _CLEAR.exists()
    except (OSError, AttributeError):
        return False


def peak_mib(call: Call, device: torch.device) -> float | None:
    """Return the peak of memory during a call above what was in use before, MiB.

    On a GPU that is what torch has allocated. On the CPU it is the resident memory of the
    process, whose high-water mark the kernel resets; call `exact_allocation` before, or tensors
    in memory that was used and freed before do not show.

    Args:
        call: What is measured; warmed up.
        device: Where it runs.
    """
    gc.collect()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        rest = torch.cuda.memory_allocated(device)
        call()
        torch.cuda.synchronize(device)
        return float(torch.cuda.max_memory_allocated(device) - rest) / 2**20
    try:
        ctypes.CDLL(None).malloc_trim(0)
        _CLEAR.write_text("5")
        rest = _status_kib("VmRSS")
        call()
        return (_status_kib("VmHWM") - rest) / 1024
    except (OSError, AttributeError, StopIteration):
        return None


def _status_kib(name: str) -> int:
    lines = _STATUS.read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])


# -- what only a GPU has ---------------------------------------------------------------------------


def find_sync(call: Call) -> str:
    """Return "no", or where in the source a call waits for the GPU.

    Args:
        call: What is checked; warmed up.
    """
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        call()
    except RuntimeError as error:
        return place_of(error)
    finally:
        torch.cuda.set_sync_debug_mode(before)
        torch.cuda.synchronize()
    return "no"


def place_of(error: RuntimeError) -> str:
    """Return the innermost line of the library where a call waited, or the error's message."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if _LIBRARY in Path(f.filename).parents]
    if not own or "synchron" not in str(error):
        return (str(error).splitlines() or [type(error).__name__])[0]
    return f"{Path(own[-1].filename).name}:{own[-1].lineno} {own[-1].name}"


def graph_ms(call: Call, runs: int) -> float:
    """Capture a call as a CUDA graph and return the median time of its replay, milliseconds.

    Args:
        call: What is captured; it must not wait for the GPU.
        runs: Timed replays.

    Raises:
        RuntimeError: it cannot be captured.
    """
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(_LEAST_RUNS):
            call()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        kept = call()  # its tensors belong to the graph
    device = torch.device("cuda", torch.cuda.current_device())
    graph.replay()
    times = [_between_events(graph.replay, device) for _ in range(max(runs, _LEAST_RUNS))]
    del kept
    return statistics.median(times)
