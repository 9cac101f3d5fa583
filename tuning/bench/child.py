"""The process in which cases are measured: `python -m tuning.bench.child < job.json`.

It gets a job on its standard input, and writes a line for each thing that it finds out, so that
nothing is lost if it dies: torch's compiler and CUDA graphs may end a process.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from pydantic import Field

from torchblur.ops.compiling import compiler_works
from torchblur.params import Config
from tuning.bench.calls import make_call
from tuning.bench.cases import Case
from tuning.bench.fit_step import Step, median_parts, render_parts
from tuning.bench.measure import Times, exact_allocation, find_sync, graph_ms, peak_mib, repeat

__all__ = ["MARK", "BenchJob", "run_job"]

MARK = "torchblur-bench "
"""Begins each line of results; whatever else stands on the output is not ours."""

Tell = Callable[[int, dict[str, Any]], None]


class BenchJob(Config):
    """What one process measures."""

    cases: list[Case]
    runs: int = Field(5, ge=1, description="timed runs of each")
    seconds: float = Field(4.0, gt=0, description="after so long no new run begins")
    threads: int = Field(1, ge=1, description="threads of torch on the CPU")
    memory: bool = Field(True, description="also measure the peak of memory")
    checks: bool = Field(True, description="CUDA: look for waits, try a graph")


def main() -> None:
    """Read a job and write what is found."""

    def tell(index: int, found: dict[str, Any]) -> None:
        print(MARK + json.dumps({"index": index, "found": found}), flush=True)

    run_job(BenchJob.model_validate_json(sys.stdin.read()), tell)


def run_job(job: BenchJob, tell: Tell) -> None:
    """Measure the cases of a job: times first, then memory, for which the allocator is changed.

    Args:
        job: The cases and how often each is run.
        tell: Called with the position of a case and fields of its row, as they become known.
    """
    torch.set_num_threads(job.threads)
    failed = set()
    for index, case in enumerate(job.cases):
        found = _caught(partial(_times, case, job))
        tell(index, found)
        if "error" in found:
            failed.add(index)
    left = [(i, case) for i, case in enumerate(job.cases) if i not in failed]
    if job.memory and (torch.device(job.cases[0].device).type == "cuda" or exact_allocation()):
        for index, case in left:
            if case.kind != "render":
                tell(index, _as_check("memory", _caught(partial(_peak, case))))
    if job.checks and torch.device(job.cases[0].device).type == "cuda":
        for index, case in left:
            if case.kind == "blur":
                tell(index, _as_check("checks", _caught(partial(_checks, case, job))))


def _caught(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what is measured, or the error in its place: one case must not end the others."""
    try:
        return measure()
    except Exception as error:
        first = (str(error).splitlines() or [""])[0]
        return {"error": f"{type(error).__name__}: {first}"}
    finally:
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()


def _as_check(name: str, found: dict[str, Any]) -> dict[str, Any]:
    """Return an error of a later stage as a remark: the row keeps its times."""
    return {"checks": {name: found["error"]}} if "error" in found else found


# -- times -----------------------------------------------------------------------------------------


def _times(case: Case, job: BenchJob) -> dict[str, Any]:
    device = torch.device(case.device)
    if case.kind == "render":
        render_parts(case, spp=2)
        parts = median_parts(partial(render_parts, case), 1, job.seconds)
        return {"parts": parts, "wall_s": sum(parts.values()), "runs": 1}
    if case.kind == "step":
        step = Step(case)
        first = _first(step.whole, device)
        step.parts()
        parts = median_parts(step.parts, job.runs, job.seconds)
        return _found(case, first, repeat(step.whole, device, job.runs, job.seconds)) | {
            "parts": parts
        }
    call = make_call(case)
    first = _first(call, device)
    if device.type == "cuda":
        call()  # clocks go up, and the allocator has what it needs
    return _found(case, first, repeat(call, device, job.runs, job.seconds))


def _first(call: Callable[[], object], device: torch.device) -> float:
    start = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def _found(case: Case, first: float, times: Times) -> dict[str, Any]:
    compiles = case.engine == "compiled" and case.kind != "copy"
    # Without a compiler a filter goes on eagerly, and the figures are not what they seem.
    checks = {} if not compiles or compiler_works() else {"compiled": "no: there is no compiler"}
    return {
        "checks": checks,
        "runs": times.runs,
        "wall_s": times.wall,
        "cpu_s": times.cpu,
        "device_ms": times.device,
        "spread": times.spread,
        "first_s": first,
        "compile_s": max(0.0, first - times.wall) if compiles else None,
        "others": times.others,
        "waited": times.waited,
    }


# -- memory and checks -----------------------------------------------------------------------------


def _peak(case: Case) -> dict[str, Any]:
    call = Step(case).whole if case.kind == "step" else make_call(case)
    return {"peak_mib": peak_mib(call, torch.device(case.device))}


def _checks(case: Case, job: BenchJob) -> dict[str, Any]:
    found: dict[str, Any] = {"checks": {}}
    call = make_call(case)
    call()
    found["checks"]["sync"] = find_sync(call)
    if case.what != "forward":
        return found
    try:
        found["graph_ms"] = graph_ms(call, job.runs)
        found["checks"]["graph"] = "captured"
    except Exception as error:  # CUDA raises what it likes; the row keeps its times
        found["checks"]["graph"] = (str(error).splitlines() or [type(error).__name__])[0]
    return found


if __name__ == "__main__":
    main()
