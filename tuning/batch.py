"""Batch runs: one filter over many frames, on a few threads, to be stopped and gone on with.

While one frame is filtered the next ones are read. Each result appears whole or not at all and
says in its metadata what it was made with, so that a second run does only what is missing.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from pydantic import Field

from torchblur.errors import ConfigError, OutputError
from torchblur.filters import BlurFilter
from torchblur.frame import Frame
from torchblur.io import load_yaml
from torchblur.params import build
from tuning.apply import FilterSettings, blur_frame, make_filter, read_job, recipe_of, write_job
from tuning.config import apply_overrides
from tuning.outputs import (
    Job,
    State,
    drop_results,
    find_inputs,
    make_folders,
    name_outputs,
    number_of,
    numbered,
    remove_leftovers,
    state_of,
)
from tuning.progress import Progress, Stage

__all__ = [
    "BatchConfig",
    "BatchResult",
    "Failure",
    "Plan",
    "load_batch_config",
    "plan_batch",
    "run_batch",
]


class BatchConfig(FilterSettings):
    """One batch run: `torchblur batch CONFIG`."""

    root: str = Field(".", description="folder that all other paths are relative to")
    inputs: tuple[str, ...] = Field(
        min_length=1, description="files, folders or patterns with #### and *"
    )
    output: str = Field(
        description="a folder, or a pattern with ####, {name}, {stem}, {folder}; .exr or .png"
    )
    gbuffer: str | None = Field(
        None, description="file beside each input with its layers; #### is its frame number, if any"
    )
    workers: int = Field(1, ge=1, le=256, description="frames that are filtered at a time")
    prefetch: int = Field(2, ge=0, le=64, description="frames that are read ahead")


@dataclass(frozen=True)
class Plan:
    """What a batch run will do.

    Args:
        config: The configuration.
        recipe: What goes into the metadata of each result.
        states: Each job, and whether it is done.
        overwrite: Make all results anew.
    """

    config: BatchConfig
    recipe: Mapping[str, Any]
    states: tuple[tuple[Job, State], ...]
    overwrite: bool = False

    @property
    def todo(self) -> list[Job]:
        """The jobs that will be run."""
        return [job for job, state in self.states if self.overwrite or state != "done"]

    def count(self, state: State) -> int:
        """Return how many jobs are in a state."""
        return sum(found == state for _, found in self.states)

    def check(self) -> None:
        """Refuse to replace what was not made with these settings.

        Raises:
            OutputError: naming how many there are, the first, and what differs.
        """
        other = [job.output for job, state in self.states if state == "other"]
        if other and not self.overwrite:
            raise OutputError(
                f"{len(other)} of {len(self.states)} outputs exist and were made with other "
                f"settings or by another program, the first is {other[0]}; overwrite=True "
                "(--overwrite) replaces them"
            )


@dataclass(frozen=True)
class Failure:
    """A frame that could not be made, and why."""

    job: Job
    reason: str


@dataclass
class BatchResult:
    """What became of the jobs of a run."""

    written: list[Path] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    skipped: int = 0
    interrupted: bool = False


def load_batch_config(path: str | Path, overrides: Sequence[str] = ()) -> BatchConfig:
    """Read a configuration and check all of it, the filter's parameters as well.

    Args:
        path: A YAML file. `root`, and a preset's path, are relative to it.
        overrides: "key.path=value", value in YAML. A `root` given here is relative to the
            working folder.

    Returns:
        The configuration with an absolute `root` and, if it names a preset, an absolute path.

    Raises:
        ConfigError: each mistake in a line, with file and key path.
        FileFormatError: no such file.
    """
    path = Path(path)
    place = f"{path} and --set" if overrides else str(path)
    config = build(BatchConfig, apply_overrides(load_yaml(path), overrides), place)
    own_root = any(text.startswith("root=") for text in overrides)
    own_filter = any(text.startswith("filter=") for text in overrides)
    update = {"root": str(((Path() if own_root else path.parent) / config.root).resolve())}
    if Path(config.filter).suffix:
        folder = Path() if own_filter else path.parent
        update["filter"] = str((folder / config.filter).resolve())
    config = config.model_copy(update=update)
    try:
        make_filter(config)
    except ConfigError as error:
        raise ConfigError(f"{error} ({place})") from error
    return config


def plan_batch(config: BatchConfig, *, overwrite: bool = False) -> Plan:
    """Find the inputs, name the outputs, and see which of them are done.

    Args:
        config: The configuration.
        overwrite: Make all results anew.

    Raises:
        FileFormatError: an input pattern fits no file.
        OutputError: two inputs with one output, or a result that would replace an input.
        ConfigError: a placeholder without a value.
    """
    root = Path(config.root)
    pairs = drop_results(name_outputs(find_inputs(config.inputs, root), config.output, root))
    recipe = recipe_of(config, make_filter(config), config.gbuffer is not None)
    jobs = [Job(source, output, _gbuffer_of(source, config)) for source, output in pairs]
    with ThreadPoolExecutor(_cores()) as pool:
        states = list(pool.map(lambda job: state_of(job.output, job.sources, recipe), jobs))
    return Plan(config, recipe, tuple(zip(jobs, states, strict=True)), overwrite)


def run_batch(plan: Plan, progress: Progress | None = None) -> BatchResult:
    """Make all results of a plan that are not done; go on past frames that fail.

    The result is the same for any number of workers. On KeyboardInterrupt the frames that are
    being filtered are finished and written; a second one drops them.

    Args:
        plan: What `plan_batch` returned.
        progress: Told after each frame.

    Returns:
        What was written, what failed and why, and whether the run was interrupted.

    Raises:
        OutputError: results made with other settings are in the way, or a folder cannot be made.
    """
    plan.check()
    jobs = plan.todo
    outputs = [job.output for job in jobs]
    make_folders(outputs)
    remove_leftovers(outputs)
    result = BatchResult(skipped=len(plan.states) - len(jobs))
    stage = Stage("batch", len(jobs), progress)
    stage.step(0)
    log = _Log(result, stage)
    stopped = _Runner(plan, log).run(jobs)
    result.interrupted = stopped and len(result.written) + len(result.failures) < len(jobs)
    return result


class _Log:
    """Writes down what becomes of each job, and tells the progress."""

    def __init__(self, result: BatchResult, stage: Stage) -> None:
        self._result, self._stage = result, stage

    def record(self, job: Job, future: Future[None]) -> None:
        reason = _reason(future)
        if reason is None:
            self._result.written.append(job.output)
        else:
            self._result.failures.append(Failure(job, reason))
        failed = len(self._result.failures)
        self._tell(f"{failed} failed" if failed else job.output.name)

    def stopping(self, count: int) -> None:
        self._tell(f"stopping: {count} frames in flight are finished; Ctrl-C again drops them")

    def _tell(self, message: str) -> None:
        done = len(self._result.written) + len(self._result.failures)
        self._stage.step(done, message=message)


class _Runner:
    """Two pools of threads: one reads ahead, one filters and writes."""

    def __init__(self, plan: Plan, log: _Log) -> None:
        self._plan, self._log = plan, log
        self._config = plan.config
        self._blur: BlurFilter = make_filter(plan.config)
        self._dropped = threading.Event()
        # torch.compile is not made for several threads: they take turns, with all cores each.
        self._turn = threading.Lock() if plan.config.engine == "compiled" else None

    def run(self, jobs: Iterable[Job]) -> bool:
        """Run the jobs; return whether the user stopped them."""
        threads = torch.get_num_threads()
        share = 1 if self._turn else self._config.workers
        torch.set_num_threads(min(threads, max(1, _cores() // share)))
        workers = ThreadPoolExecutor(
            self._config.workers, "blur", torch.set_num_threads, (torch.get_num_threads(),)
        )
        readers = ThreadPoolExecutor(max(1, self._config.workers), "read")
        running: dict[Future[None], Job] = {}
        try:
            self._feed(jobs, workers, readers, running)
            return False
        except KeyboardInterrupt:
            readers.shutdown(wait=False, cancel_futures=True)
            workers.shutdown(wait=False, cancel_futures=True)
            self._finish(running)
            return True
        finally:
            readers.shutdown(cancel_futures=True)
            workers.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)

    def _feed(
        self,
        jobs: Iterable[Job],
        workers: ThreadPoolExecutor,
        readers: ThreadPoolExecutor,
        running: dict[Future[None], Job],
    ) -> None:
        limit = self._config.workers + self._config.prefetch
        for job in jobs:
            frame = readers.submit(read_job, job, self._config)
            running[workers.submit(self._make, job, frame)] = job
            while len(running) >= limit:
                self._collect(running)
        while running:
            self._collect(running)

    def _finish(self, running: dict[Future[None], Job]) -> None:
        """Wait for the frames in flight; those whose turn did not come are dropped."""
        for future in [f for f in running if f.cancelled()]:
            del running[future]
        self._log.stopping(len(running))
        while running:
            try:
                self._collect(running)
            except KeyboardInterrupt:
                self._dropped.set()

    def _collect(self, running: dict[Future[None], Job]) -> None:
        finished, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            job = running.pop(future)
            if not _was_dropped(future):
                self._log.record(job, future)

    def _make(self, job: Job, reading: Future[Frame]) -> None:
        frame = reading.result()
        if self._turn is None:
            color, layers = blur_frame(self._blur, frame, self._config.layers)
        else:
            with self._turn:
                color, layers = blur_frame(self._blur, frame, self._config.layers)
        if self._dropped.is_set():
            raise CancelledError
        write_job(
            job, color, layers, settings=self._config, recipe=self._plan.recipe, overwrite=True
        )


def _was_dropped(future: Future[None]) -> bool:
    return future.cancelled() or isinstance(future.exception(), CancelledError)


def _reason(future: Future[None]) -> str | None:
    error = future.exception()
    if error is None:
        return None
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


def _gbuffer_of(source: Path, config: BatchConfig) -> Path | None:
    if config.gbuffer is None:
        return None
    name = config.gbuffer
    if number_of(source) is None:
        name = re.sub(r"[._-]?#+", "", name)
    return source.parent / numbered(name, source)


def _cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
