"""The benchmark: plans cases, measures them in processes of their own, and reports.

Each filter and engine has one process, which starts without anything compiled: the first call
includes compiling, all later ones do not. While a process measures, this one waits.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from subprocess import PIPE, Popen
from typing import IO, Any

from torchblur.errors import ConfigError, OutputError
from torchblur.io.paths import output_file
from torchblur.params import Config
from tuning.batch.apply import device_named
from tuning.bench.cases import Case, Report, Row, Table
from tuning.bench.child import MARK, BenchJob
from tuning.bench.machine import busy_warning, describe_machine, watch
from tuning.bench.plan import BenchOptions, TablePlan, plan_tables, unique_cases
from tuning.bench.ratios import fits_of, with_ratios
from tuning.bench.targets import judge_targets, targets_for
from tuning.files.outputs import refuse_existing
from tuning.parallel.cores import count_cores
from tuning.progress import Progress, Stage

__all__ = ["Limits", "check_output", "measure_cases", "run_bench", "write_report"]

_COMMAND = (sys.executable, "-m", "tuning.bench.child")
_TARGET_THREADS = 2  # the targets of the CPU are for two cores
_NOT_WITH_TARGETS = ("filters", "sizes", "num_samples", "what", "only", "engines", "full", "params")


class Limits(Config):
    """How long each measurement may take."""

    runs: int = 5
    seconds: float = 4.0
    threads: int = 1
    memory: bool = True
    checks: bool = True


def run_bench(
    options: BenchOptions,
    *,
    progress: Progress | None = None,
    output: Path | None = None,
    overwrite: bool = False,
    warn: Callable[[str], None] | None = None,
) -> Report:
    """Measure what the options ask for.

    Args:
        options: The selection.
        progress: Told after each case.
        output: JSON file; it is written again after each process, so that what is measured stays.
        overwrite: Replace an older file.
        warn: Told at once that the machine is busy.

    Returns:
        Tables or targets, with the machine.

    Raises:
        ConfigError: unknown filters or tables, options that contradict each other, or a device
            that is not here.
        OutputError: the file exists, or cannot be written.
    """
    options = options.model_copy(update={"device": str(device_named(options.device))})
    _refuse_contradictions(options)
    plans = _target_plan(options) if options.targets else plan_tables(options)
    if output is not None:
        check_output(output, overwrite=overwrite)
    limits = _limits(options)
    report = Report(
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=describe_machine(options.device, limits.threads),
        settings=options.model_dump(),
    )
    busy = busy_warning(watch())
    if busy is not None:
        report = report.model_copy(update={"warnings": [busy]})
        if warn is not None:
            warn(busy)
    cases = unique_cases(plans)
    stage = Stage("bench", len(cases), progress)
    measured: dict[str, Row] = {}
    for rows in measure_cases(cases, limits, stage):
        measured |= rows
        if output is not None:
            write_report(output, _filled(report, plans, measured, options))
    report = _filled(report, plans, measured, options).model_copy(update={"complete": True})
    if output is not None:
        write_report(output, report)
    return report


def _refuse_contradictions(options: BenchOptions) -> None:
    if options.quick and options.full:
        raise ConfigError("`quick` and `full` contradict each other")
    for name in _NOT_WITH_TARGETS:
        if options.targets and getattr(options, name):
            raise ConfigError(
                f"`targets` are measured as they are defined, without `{name}`, got "
                f"{getattr(options, name)!r}"
            )


def _limits(options: BenchOptions) -> Limits:
    cores = count_cores()
    on_gpu = options.device.startswith("cuda")
    threads = min(cores, _TARGET_THREADS) if options.targets and not on_gpu else cores
    return Limits(
        runs=options.runs or (2 if options.quick else 50 if on_gpu else 5),
        seconds=2.0 if options.quick else 4.0,
        threads=options.threads or int(os.environ.get("OMP_NUM_THREADS") or threads),
    )


def _target_plan(options: BenchOptions) -> list[TablePlan]:
    cases = [
        case for target in targets_for(options.device, quick=options.quick) for case in target.cases
    ]
    unique = list({case.key: case for case in cases}.values())
    return [TablePlan("targets", "what the targets are made of", unique)]


def _filled(
    report: Report, plans: Sequence[TablePlan], measured: Mapping[str, Row], options: BenchOptions
) -> Report:
    """Return the report with the tables, as far as they are measured."""
    tables = []
    for plan in plans:
        rows = [measured[case.key] for case in plan.cases if case.key in measured]
        if rows:
            rows = with_ratios(rows, measured)
            fits = fits_of(plan.name, rows)
            tables.append(Table(name=plan.name, title=plan.title, rows=rows, fits=fits))
    targets = []
    if options.targets:
        wanted = targets_for(options.device, quick=options.quick)
        targets = judge_targets(wanted, measured, judged=not options.quick)
    return report.model_copy(update={"tables": tables, "targets": targets})


# -- processes -------------------------------------------------------------------------------------


def measure_cases(
    cases: Sequence[Case], limits: Limits, stage: Stage | None = None
) -> Iterator[dict[str, Row]]:
    """Measure cases, those with a common `process` in one process; yield the rows of each.

    Args:
        cases: What to measure, those of one process together.
        limits: Runs, seconds, threads.
        stage: Counts the cases.
    """
    done = 0
    with tempfile.TemporaryDirectory(prefix="torchblur-bench-") as folder:
        for name in dict.fromkeys(case.process for case in cases):
            some = [case for case in cases if case.process == name]
            found: dict[int, dict[str, Any]] = {i: {} for i in range(len(some))}
            for index, part in _child_lines(some, limits, Path(folder)):
                if stage is not None and not found[index]:
                    done += 1
                    stage.step(done, message=some[index].label)
                found[index] = _merged(found[index], part)
            yield {case.key: Row(case=case, **found[index]) for index, case in enumerate(some)}


def _merged(found: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    if "checks" in part:
        part = part | {"checks": found.get("checks", {}) | part["checks"]}
    return found | part


def _child_lines(
    cases: list[Case], limits: Limits, folder: Path
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Run a process, yield what it finds, and say for each case left why there is nothing."""
    job = BenchJob(cases=cases, **limits.model_dump())
    # A compiler cache of its own: what is reported as compiling is compiling, not reading.
    env = os.environ | {"TORCHINDUCTOR_CACHE_DIR": str(folder / "inductor")}
    seen = set()
    with (folder / "stderr.txt").open("w+") as errors:
        with Popen(_COMMAND, stdin=PIPE, stdout=PIPE, stderr=errors, env=env, text=True) as process:
            try:
                assert process.stdin is not None
                assert process.stdout is not None
                process.stdin.write(job.model_dump_json())
                process.stdin.close()
                for index, found in _results(process.stdout):
                    seen.add(index)
                    yield index, found
                code = process.wait()
            finally:
                process.kill()
        errors.seek(0)
        last = (errors.read().strip().splitlines() or ["no message"])[-1]
    for index in range(len(cases)):
        if index not in seen:
            yield index, {"error": f"the process ended with code {code}: {last}"}


def _results(lines: IO[str]) -> Iterator[tuple[int, dict[str, Any]]]:
    for line in lines:
        if line.startswith(MARK):
            data = json.loads(line.removeprefix(MARK))
            yield data["index"], data["found"]


# -- files -----------------------------------------------------------------------------------------


def check_output(path: Path, *, overwrite: bool) -> None:
    """Refuse a file that cannot be written, before anything is measured.

    Raises:
        OutputError: it exists and `overwrite` is off, or its folder is not there.
    """
    refuse_existing([path], overwrite=overwrite)
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise OutputError(f"cannot write {path}: its folder does not exist, or it is a folder")


def write_report(path: Path, report: Report) -> None:
    """Write a report as JSON, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    with output_file(path, overwrite=True) as temporary:
        temporary.write_text(report.model_dump_json(indent=2) + "\n")
