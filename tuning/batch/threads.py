"""Two pools of threads for a batch run: one reads ahead, one filters and writes.

A task is one frame, or for a filter with a memory all frames of a shot, one after the other.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from torchblur.filters import BlurFilter
from torchblur.filters.parts.base import History, TemporalBlur
from torchblur.frame import Frame
from torchblur.ops.compiling import compiler_works
from tuning.batch.apply import FilterSettings, blur_frame, blur_step, read_samples, write_job
from tuning.files.outputs import Job
from tuning.parallel.cores import count_cores

__all__ = ["Log", "Runner", "Task"]


@dataclass(frozen=True)
class Task:
    """Frames that are filtered one after the other.

    Args:
        jobs: The frames, in order.
        wanted: Those whose results are written; the others are filtered for what comes after.
        shot: Name of the first frame, for a filter with a memory.
    """

    jobs: Sequence[Job]
    wanted: Collection[Job]
    shot: str | None = None


class Log(Protocol):
    """Is told what becomes of each wanted frame, from several threads."""

    def written(self, job: Job) -> None:
        """A result is on disk."""

    def failed(self, job: Job, reason: str) -> None:
        """A result could not be made."""

    def stopping(self, count: int) -> None:
        """The user wants to stop; so many frames are finished."""


class Runner:
    """Works on tasks until they are done or the user stops it.

    Args:
        blur: The filter, on its device.
        settings: How frames are read and written.
        recipe: What goes into the metadata of each result.
        workers: Tasks at a time.
        prefetch: Frames that are read ahead.
        log: Is told of each frame.
    """

    def __init__(
        self,
        blur: BlurFilter,
        settings: FilterSettings,
        recipe: Mapping[str, Any],
        *,
        workers: int,
        prefetch: int,
        log: Log,
    ) -> None:
        self._blur, self._settings, self._recipe = blur, settings, recipe
        self._workers, self._prefetch, self._log = workers, prefetch, log
        self._stopping, self._dropped = threading.Event(), threading.Event()
        # torch.compile is not made for several threads: they take turns, with all cores each.
        is_compiled = blur.engine == "compiled" and compiler_works()
        self._turn = threading.Lock() if is_compiled else None
        self._readers: ThreadPoolExecutor

    def run(self, tasks: Iterable[Task]) -> bool:
        """Run the tasks; return whether the user stopped them."""
        threads = torch.get_num_threads()
        share = 1 if self._turn else self._workers
        torch.set_num_threads(min(threads, max(1, count_cores() // share)))
        workers = ThreadPoolExecutor(
            self._workers, "blur", torch.set_num_threads, (torch.get_num_threads(),)
        )
        self._readers = ThreadPoolExecutor(self._workers, "read")
        running: set[Future[None]] = set()
        try:
            self._feed(tasks, workers, running)
            return False
        except KeyboardInterrupt:
            self._stopping.set()
            self._readers.shutdown(wait=False, cancel_futures=True)
            workers.shutdown(wait=False, cancel_futures=True)
            self._finish(running)
            return True
        finally:
            self._stopping.set()
            self._readers.shutdown(cancel_futures=True)
            workers.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)

    def _feed(
        self, tasks: Iterable[Task], workers: ThreadPoolExecutor, running: set[Future[None]]
    ) -> None:
        limit = self._workers + self._prefetch
        for task in tasks:
            running.add(workers.submit(self._make, task, self._read(task.jobs[0])))
            while len(running) >= limit:
                _collect(running)
        while running:
            _collect(running)

    def _finish(self, running: set[Future[None]]) -> None:
        """Wait for the frames in flight; those whose turn did not come are dropped."""
        for future in [f for f in running if f.cancelled()]:
            running.remove(future)
        self._log.stopping(len(running))
        while running:
            try:
                _collect(running)
            except KeyboardInterrupt:
                self._dropped.set()

    def _read(self, job: Job) -> Future[tuple[Frame, ...]]:
        return self._readers.submit(read_samples, job, self._settings)

    def _make(self, task: Task, first: Future[tuple[Frame, ...]]) -> None:
        readings, history = deque([first]), None
        for index, job in enumerate(task.jobs):
            if index > 0 and self._stopping.is_set():
                return
            try:
                for ahead in task.jobs[index + len(readings) : index + 1 + self._prefetch]:
                    readings.append(self._read(ahead))
                samples = (
                    readings.popleft().result() if readings else read_samples(job, self._settings)
                )
                history = self._make_one(task, job, samples, history)
            except CancelledError:
                return
            except Exception as error:
                if not self._stopping.is_set() or index == 0:
                    self._give_up(task, index, error)
                return

    def _make_one(
        self, task: Task, job: Job, samples: tuple[Frame, ...], history: History | None
    ) -> History | None:
        with self._turn or nullcontext():
            color, layers, history = self._filtered(samples, history)
        if self._dropped.is_set():
            raise CancelledError
        if job in task.wanted:
            write_job(
                job,
                color,
                layers,
                settings=self._settings,
                recipe=self._recipe,
                shot=task.shot,
                overwrite=True,
            )
            self._log.written(job)
        return history

    def _filtered(
        self, samples: tuple[Frame, ...], history: History | None
    ) -> tuple[Tensor, Mapping[str, Tensor], History | None]:
        names = self._settings.layers
        if isinstance(self._blur, TemporalBlur):
            return blur_step(self._blur, samples, history, names)
        return (*blur_frame(self._blur, samples[0], names), None)

    def _give_up(self, task: Task, index: int, error: Exception) -> None:
        """Tell of a frame that failed; those after it in its shot would lack what it remembers."""
        bad, reason = task.jobs[index], _reason(error)
        after = f"not made, as {bad.source.name} before it in its shot failed"
        if bad not in task.wanted:
            after = f"{after}: {reason}"
        for job in task.jobs[index:]:
            if job in task.wanted:
                self._log.failed(job, reason if job is bad else after)


def _collect(running: set[Future[None]]) -> None:
    finished, _ = wait(running, return_when=FIRST_COMPLETED)
    running -= finished


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
