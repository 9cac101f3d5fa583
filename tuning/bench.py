"""Benchmarks of the filters: time (eager against compiled) and the memory of a backward pass.

::

    python -m tuning.bench [--size 1280x720] [--samples 35] [--runs 3] [--json FILE]
                           [--filters guertin2014 line] [--only speed memory notes moving]

Figures are medians, each measurement in a process of its own. CPU-seconds are what to compare:
on a machine that is not idle, wall time and multi-threaded CPU time are both inflated, and the
program says so.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

__all__ = ["main"]

_KNOWN = {
    "prototype, eager, one lookup per layer": 16.0,
    "prototype, eager, packed lookup": 2.1,
    "prototype, compiled tap": 1.1,
    "hand-written fused C++ loop": 0.6,
}
"""CPU-seconds per frame of other Guertin programs at 1280x720, N = 35, on two quiet cores."""

_MOVING = (0, 10, 50, 100)
"""Shares of the pixels that move, percent."""

_NOTES_US = {("full", "two"): 490, ("full", "one"): 355, ("half", "two"): 225, ("half", "one"): 195}
"""Microseconds of the 2025 notes' own table."""


def main() -> None:
    """Run the benchmarks and print their tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--size", default="1280x720", help="WIDTHxHEIGHT in px")
    parser.add_argument("--samples", type=int, default=35, help="taps N")
    parser.add_argument("--runs", type=int, default=3, help="timed runs of each")
    parser.add_argument("--filters", nargs="*", help="time these; all if left out")
    parser.add_argument("--only", nargs="*", choices=("speed", "memory", "notes", "moving"))
    parser.add_argument("--json", type=Path, help="write the figures here too")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(_measure(json.loads(arguments.child))))
        return
    width, height = (int(n) for n in arguments.size.split("x"))
    job = {"width": width, "height": height, "runs": arguments.runs}
    _warn_if_busy()
    tables: dict[str, Any] = {
        "speed": lambda: _speed(job | {"num_samples": arguments.samples}, arguments.filters),
        "memory": lambda: _memory(job, arguments.samples),
        "notes": lambda: _notes(job),
        "moving": lambda: _moving(job, arguments.samples, arguments.filters),
    }
    chosen = arguments.only or tuple(tables)
    figures = {name: table() for name, table in tables.items() if name in chosen}
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2))


def _warn_if_busy() -> None:
    load = os.getloadavg()[0]
    if load > 0.5:
        print(f"warning: the machine is busy (load {load:.1f}); figures are inflated\n")


def _speed(job: dict[str, Any], names: list[str] | None) -> list[dict[str, Any]]:
    """Time each filter eagerly and compiled, forward and with its backward pass."""
    print(
        f"forward and backward, {job['width']}x{job['height']}, N = {job['num_samples']}, "
        f"all pixels move, {os.cpu_count()} cores; medians of {job['runs']}"
    )
    print(
        f"{'filter':<16}{'engine':<10}{'forward CPU s':>14}{'wall s':>8}"
        f"{'fwd+bwd CPU s':>15}{'wall s':>8}{'first call s':>14}{'eager / it':>12}"
    )
    rows: list[dict[str, Any]] = []
    for name in names or _filter_names():
        for engine in ("eager", "compiled"):
            row = _child(job | {"filter": name, "engine": engine, "what": "speed"})
            rows.append(row | {"filter": name, "engine": engine})
            eager = rows[-1 if engine == "eager" else -2]
            print(
                f"{name:<16}{engine:<10}{row['cpu']:>14.2f}{row['wall']:>8.2f}"
                f"{row['backward_cpu']:>15.2f}{row['backward_wall']:>8.2f}"
                f"{row['first']:>14.1f}{eager['cpu'] / row['cpu']:>12.2f}"
            )
    print("\nfor comparison, Guertin at 1280x720, N = 35, two quiet cores, CPU s per frame:")
    for text, seconds in _KNOWN.items():
        print(f"  {text:<42}{seconds:>6.1f}")
    return rows


def _memory(job: dict[str, Any], num_samples: int) -> list[dict[str, Any]]:
    """Compare the peak memory of a backward pass with many taps and with five."""
    print(f"\npeak memory of forward and backward, guertin2014, {job['width']}x{job['height']}")
    rows: list[dict[str, Any]] = []
    for taps in (5, num_samples):
        row = _child(
            job
            | {"filter": "guertin2014", "engine": "eager", "what": "memory", "num_samples": taps}
        )
        rows.append(row | {"num_samples": taps})
        print(
            f"  N = {taps:<4} {row['peak_mib']:>8.0f} MiB above the {row['base_mib']:.0f} MiB "
            "of the loaded program and frame"
        )
    ratio = rows[1]["peak_mib"] / rows[0]["peak_mib"]
    print(f"  ratio {ratio:.2f}")
    return rows


def _notes(job: dict[str, Any]) -> list[dict[str, Any]]:
    """Time the four variants of the 2025 notes, beside the ratios of the text's own table."""
    print(f"\nnotes2025 with the text's taps, eager, {job['width']}x{job['height']}")
    rows: list[dict[str, Any]] = []
    for (resolution, directions), text in _NOTES_US.items():
        params = {"resolution": resolution, "directions": directions}
        row = _child(
            job | {"filter": "notes2025", "engine": "eager", "what": "forward", "params": params}
        )
        rows.append(row | params)
        print(
            f"  {resolution} resolution, {directions}: {row['cpu']:>6.2f} CPU s, "
            f"{row['cpu'] / rows[0]['cpu']:.2f} of the first (the text: "
            f"{text / next(iter(_NOTES_US.values())):.2f})"
        )
    return rows


def _moving(job: dict[str, Any], num_samples: int, names: list[str] | None) -> list[dict[str, Any]]:
    """Time filters on frames of which a share moves, all in one process, in turns."""
    print(f"\ntime by the share of moving pixels, eager, {job['width']}x{job['height']}")
    chosen = names or ["oberberger2022", "guertin2014"]
    print(
        f"{'filter':<16}{'moving':>8}{'CPU s':>9}{'wall s':>9}"
        f"{'of its 100 %':>14}{'of Guertin':>12}"
    )
    shared = {"what": "moving", "filters": chosen, "num_samples": num_samples}
    rows: list[dict[str, Any]] = _child(job | shared)["rows"]
    whole = {row["filter"]: row["cpu"] for row in rows if row["percent"] == 100}
    for row in rows:
        row["of_whole"] = row["cpu"] / whole[row["filter"]]
        row["of_guertin"] = row["cpu"] / whole["guertin2014"] if "guertin2014" in whole else None
        beside = "" if row["of_guertin"] is None else f"{row['of_guertin']:.2f}"
        print(
            f"{row['filter']:<16}{row['percent']:>6} %{row['cpu']:>9.3f}{row['wall']:>9.3f}"
            f"{row['of_whole']:>14.2f}{beside:>12}"
        )
    print(f"of Guertin: over guertin2014 with N = {num_samples}, where all pixels move")
    return rows


def _filter_names() -> list[str]:
    """Return the registered filters, from a process that loads torch in this one's place."""
    code = "from torchblur.filters import registered_filters; print(*registered_filters())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def _child(job: dict[str, Any]) -> dict[str, Any]:
    command = [sys.executable, "-m", "tuning.bench", "--child", json.dumps(job)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def _measure(job: dict[str, Any]) -> dict[str, Any]:
    import torch

    from torchblur.filters import get_filter
    from torchblur.frame import Frame

    if job["what"] == "moving":
        return {"rows": _measure_moving(job)}
    generator = torch.Generator().manual_seed(0)
    size = (job["height"], job["width"])
    coarse = torch.randn(1, 2, 9, 16, generator=generator) * 20
    frame = Frame(
        color=torch.rand(1, 3, *size, generator=generator).requires_grad_(),
        velocity=torch.nn.functional.interpolate(coarse, size, mode="bilinear"),
        depth=torch.rand(1, 1, *size, generator=generator) + 1,
        time=torch.rand(1, 1, *size, generator=generator),
    )
    kind = get_filter(job["filter"])
    has_taps = "num_samples" in kind.config_class.model_fields
    params = job.get("params") or ({"num_samples": job["num_samples"]} if has_taps else {})
    blur = kind(None, engine=job["engine"], **params)

    def forward() -> None:
        with torch.no_grad():
            blur.layers(frame)

    def backward() -> None:
        frame.color.grad = None
        blur.layers(frame)["color"].square().mean().backward()

    if job["what"] == "memory":
        base = _peak_mib()
        backward()
        return {"base_mib": base, "peak_mib": _peak_mib() - base}
    start = time.perf_counter()
    forward()
    first = time.perf_counter() - start
    cpu, wall = _median(forward, job["runs"])
    if job["what"] == "forward":
        return {"first": first, "cpu": cpu, "wall": wall}
    backward()
    backward_cpu, backward_wall = _median(backward, job["runs"])
    return {
        "first": first,
        "cpu": cpu,
        "wall": wall,
        "backward_cpu": backward_cpu,
        "backward_wall": backward_wall,
    }


def _measure_moving(job: dict[str, Any]) -> list[dict[str, Any]]:
    import torch

    from torchblur.filters import TemporalBlur, get_filter

    calls: dict[tuple[str, int], Any] = {}
    for name in job["filters"]:
        samples = {"num_samples": job["num_samples"]} if name == "guertin2014" else {}
        blur = get_filter(name)(**samples)
        for percent in _MOVING:
            frame = _moving_frame(job["height"], job["width"], percent)
            with torch.no_grad():
                # A frame in the middle of a sequence: the filter has a history.
                history = blur.step(frame)[1] if isinstance(blur, TemporalBlur) else None
                blur.layers(frame, **({} if history is None else {"history": history}))
            calls[name, percent] = (blur, frame, history)

    def call(key: tuple[str, int]) -> None:
        blur, frame, history = calls[key]
        with torch.no_grad():
            blur.layers(frame, **({} if history is None else {"history": history}))

    taken: dict[tuple[str, int], list[tuple[float, float]]] = {key: [] for key in calls}
    for _ in range(job["runs"]):
        for key in calls:
            taken[key].append(_median(functools.partial(call, key), 1))
    return [
        {
            "filter": name,
            "percent": percent,
            "cpu": statistics.median(cpu for cpu, _ in times),
            "wall": statistics.median(wall for _, wall in times),
        }
        for (name, percent), times in taken.items()
    ]


def _moving_frame(height: int, width: int, percent: int) -> Any:
    """Return a stream frame whose left `percent` of columns moves by 20 px, the rest is still."""
    import torch

    from torchblur.frame import Frame

    generator = torch.Generator().manual_seed(0)
    moves = (torch.arange(width) < round(width * percent / 100)).float().view(1, 1, 1, -1)
    velocity = torch.tensor([40.0, 0.0]).view(1, 2, 1, 1) * moves.expand(1, 1, height, width)
    return Frame(
        color=torch.rand(1, 3, height, width, generator=generator),
        velocity=velocity,
        depth=torch.ones(1, 1, height, width),
        time=torch.rand(1, 1, height, width, generator=generator),
    )


def _median(function: Any, runs: int) -> tuple[float, float]:
    cpu, wall = [], []
    for _ in range(runs):
        start = time.process_time(), time.perf_counter()
        function()
        cpu.append(time.process_time() - start[0])
        wall.append(time.perf_counter() - start[1])
    return statistics.median(cpu), statistics.median(wall)


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
