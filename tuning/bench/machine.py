"""The machine that a benchmark ran on, and whether something else used it meanwhile."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from tuning.parallel.cores import count_cores

__all__ = [
    "BUSY",
    "CpuTicks",
    "busy_warning",
    "describe_machine",
    "other_cores",
    "read_ticks",
    "watch",
]

BUSY = 0.15
"""Cores in use by others from which on figures are marked."""

_STAT = Path("/proc/stat")
_SHORTEST = 0.3  # seconds: shorter windows have too few ticks to say anything


@dataclass(frozen=True)
class CpuTicks:
    """State of the processor's counters.

    Args:
        busy: Seconds that all cores together have worked, since boot; with what a hypervisor took.
        at: Time of reading, seconds of a steady clock.
    """

    busy: float
    at: float


def read_ticks(stat: Path = _STAT) -> CpuTicks | None:
    """Read the processor's counters; None where there are none (not Linux)."""
    try:
        words = stat.read_text().splitlines()[0].split()
        user, nice, system, _idle, _iowait, irq, softirq, steal = (int(w) for w in words[1:9])
    except (OSError, ValueError, IndexError):
        return None
    ticks = user + nice + system + irq + softirq + steal
    return CpuTicks(ticks / os.sysconf("SC_CLK_TCK"), time.monotonic())


def other_cores(before: CpuTicks | None, after: CpuTicks | None, own: float) -> float | None:
    """Return how many cores other programs used, on average; None where that is not known.

    Args:
        before: Counters at the start.
        after: Counters at the end.
        own: CPU-seconds of the program itself in between.
    """
    if before is None or after is None or after.at - before.at < _SHORTEST:
        return None
    return max(0.0, (after.busy - before.busy - own) / (after.at - before.at))


def busy_warning(cores: float | None) -> str | None:
    """Return a warning if others use the machine.

    Args:
        cores: Cores that they use, or None if that is not known.
    """
    if cores is None or cores <= BUSY:
        return None
    return (
        f"other programs use {cores:.1f} of {count_cores()} cores: figures are inflated and not "
        "fit to be quoted"
    )


def watch(seconds: float = 0.5) -> float | None:
    """Return how many cores others use while this program waits for so long."""
    own, before = time.process_time(), read_ticks()
    time.sleep(seconds)
    return other_cores(before, read_ticks(), time.process_time() - own)


def describe_machine(device: str, threads: int) -> dict[str, Any]:
    """Return what figures depend on.

    Args:
        device: The device that is measured.
        threads: Threads that torch uses on the CPU.
    """
    machine: dict[str, Any] = {
        "processor": _processor(),
        "cores": count_cores(),
        "threads": threads,
        "memory_gib": _memory(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": device,
        "commit": _commit(),
    }
    if torch.device(device).type == "cuda":
        properties = torch.cuda.get_device_properties(torch.device(device))
        machine["gpu"] = {
            "name": properties.name,
            "memory_gib": round(properties.total_memory / 2**30, 1),
            "capability": f"{properties.major}.{properties.minor}",
            "multiprocessors": properties.multi_processor_count,
            "cuda": torch.version.cuda,
            "driver": _driver(),
        }
    return machine


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _memory() -> float | None:
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1)
    except (OSError, ValueError):
        return None


def _commit() -> str | None:
    """Return the commit of the source, with "+" if files differ from it; None if it has none."""
    file = Path(__file__).resolve()
    git = ["git", "-C", str(file.parent)]
    if _output([*git, "ls-files", "--error-unmatch", file.name]) is None:
        return None  # installed in a folder of somebody else's repository
    commit = _output([*git, "rev-parse", "--short=12", "HEAD"])
    if commit is None:
        return None
    changed = _output([*git, "status", "--porcelain", "--untracked-files=no"])
    return commit + ("+" if changed else "")


def _driver() -> str | None:
    names = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    found = _output(names)
    return found.splitlines()[0] if found else None


def _output(command: list[str]) -> str | None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
