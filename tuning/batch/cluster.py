"""A batch run on a cluster: each frame, or with a memory each shot, is a task.

Workers read and write the files themselves, so all machines need the same files under the same
absolute paths. A frame whose worker dies is made by another one; it appears whole or not at all.
"""

from __future__ import annotations

import dataclasses
import threading
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from torchblur.errors import OutputError
from torchblur.filters import BlurFilter
from torchblur.ops.compiling import compiler_works
from torchblur.ops.gather import Engine
from tuning.batch.apply import FilterSettings, make_filter
from tuning.batch.threads import Log, Runner, Task
from tuning.files.outputs import Job
from tuning.parallel.cluster import Cluster, ClusterError, Lost, here, share_cores

__all__ = ["run_on_cluster"]


@dataclass(frozen=True)
class _Order:
    """What all tasks of a run share.

    Args:
        settings: How frames are read, filtered and written, as JSON.
        engine: How the filter runs.
        recipe: What goes into the metadata of each result.
        prefetch: Frames of a shot that are read ahead.
        probe: A file that the driver made among the results: who does not see it has other disks.
    """

    settings: str
    engine: Engine
    recipe: Mapping[str, Any]
    prefetch: int
    probe: Path


_Warned = tuple[type[Warning], str]


@dataclass
class _Told:
    """What became of a task's frames: a reason, or None, by position; and what was not seen."""

    reasons: dict[int, str | None]
    worker: str
    unseen: tuple[Path, ...]
    warnings: tuple[_Warned, ...] = ()


def run_on_cluster(
    cluster: Cluster,
    tasks: Sequence[Task],
    blur: BlurFilter,
    settings: FilterSettings,
    *,
    recipe: Mapping[str, Any],
    prefetch: int,
    log: Log,
) -> bool:
    """Run tasks on workers; return whether the user stopped them.

    On KeyboardInterrupt the frames that are being filtered are finished and written; a second one
    drops them.

    Args:
        cluster: The workers.
        tasks: Frames, or shots.
        blur: The filter, as the driver made it.
        settings: How frames are read and written.
        recipe: What goes into the metadata of each result.
        prefetch: Frames of a shot that are read ahead.
        log: Is told of each frame.

    Raises:
        ClusterError: a worker does not see the files; the scheduler is gone; there are no workers.
    """
    if not tasks:
        return False
    sent = [_absolute(task) for task in tasks]
    with _probe(sent[0].jobs[0].output.parent) as probe:
        order = _Order(
            settings=_plain(settings, blur),
            engine="compiled" if blur.engine == "compiled" and compiler_works() else "eager",
            recipe=recipe,
            prefetch=prefetch,
            probe=probe,
        )
        flight = cluster.start(partial(_make, order), sent)
        warned: dict[int, tuple[_Warned, ...]] = {}
        stopped = False
        try:
            _collect(flight, tasks, log, warned)
        except KeyboardInterrupt:
            stopped = True
            log.stopping(flight.stop())
            try:
                _collect(flight, tasks, log, warned)
            except KeyboardInterrupt:
                flight.drop()
    every = (one for position in sorted(warned) for one in warned[position])
    for category, text in dict.fromkeys(every):
        warnings.warn(text, category, stacklevel=2)
    return stopped


def _collect(
    flight: Iterable[tuple[int, _Told | Lost]],
    tasks: Sequence[Task],
    log: Log,
    warned: dict[int, tuple[_Warned, ...]],
) -> None:
    """Tell of each frame as its task ends, and keep its warnings."""
    for position, told in flight:
        task = tasks[position]
        if isinstance(told, Lost):
            for job in task.jobs:
                if job in task.wanted:
                    log.failed(job, told.reason)
            continue
        _refuse_other_disks(told)
        warned[position] = told.warnings
        for index, reason in told.reasons.items():
            if reason is None:
                log.written(task.jobs[index])
            else:
                log.failed(task.jobs[index], reason)


def _refuse_other_disks(told: _Told) -> None:
    """Refuse a worker to which a file is missing that the driver sees."""
    for path in told.unseen:
        if path.exists():
            raise ClusterError(
                f"the worker at {told.worker} does not see {path}; inputs and results must lie on "
                "a file system that all workers share, under the same paths"
            )


def _absolute(task: Task) -> Task:
    """Return a task that means the same files in any working folder."""
    jobs = [
        Job(
            source=job.source.absolute(),
            output=job.output.absolute(),
            gbuffer=None if job.gbuffer is None else job.gbuffer.absolute(),
            samples=tuple(path.absolute() for path in job.samples),
        )
        for job in task.jobs
    ]
    wanted = [new for old, new in zip(task.jobs, jobs, strict=True) if old in task.wanted]
    return dataclasses.replace(task, jobs=jobs, wanted=frozenset(wanted))


def _plain(settings: FilterSettings, blur: BlurFilter) -> str:
    """Return settings without reference to a preset's file."""
    params = blur.current_config().model_dump(mode="json")
    known = {name: getattr(settings, name) for name in FilterSettings.model_fields}
    plain = FilterSettings(**(known | {"filter": blur.name, "params": params}))
    return plain.model_dump_json(exclude_unset=True)


@contextmanager
def _probe(folder: Path) -> Iterator[Path]:
    path = folder / f".{uuid.uuid4().hex[:8]}.probe"
    try:
        path.touch()
    except OSError as error:
        raise OutputError(f"cannot write into the folder {folder}: {error.strerror}") from error
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


# -- on a worker -------------------------------------------------------------------------------


_COMPILED, _HEARING = threading.Lock(), threading.Lock()
_HEARERS: list[list[_Warned]] = []
_CATCHER = ExitStack()


class _Notes:
    """Keeps what became of the frames of a task."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._positions = {job: index for index, job in enumerate(jobs)}
        self.reasons: dict[int, str | None] = {}

    def written(self, job: Job) -> None:
        self.reasons[self._positions[job]] = None

    def failed(self, job: Job, reason: str) -> None:
        self.reasons[self._positions[job]] = reason

    def stopping(self, count: int) -> None:
        pass


def _make(order: _Order, task: Task) -> _Told:
    share_cores()
    unseen = [] if order.probe.exists() else [order.probe]
    unseen += [path for job in task.jobs for path in job.sources if not path.exists()]
    if unseen == [order.probe]:  # nothing is to be written to another disk
        return _Told({}, here(), tuple(unseen))
    notes = _Notes(task.jobs)
    settings, blur = _filter_of(order.settings, order.engine)
    runner = Runner(blur, settings, order.recipe, workers=1, prefetch=order.prefetch, log=notes)
    # torch.compile is not made for several threads.
    with _COMPILED if order.engine == "compiled" else nullcontext():
        with _heard() as heard:
            runner.run([task])
    return _Told(notes.reasons, here(), tuple(unseen), tuple(dict.fromkeys(heard)))


@contextmanager
def _heard() -> Iterator[list[_Warned]]:
    """Collect the warnings of this process; `warnings.catch_warnings` is not for threads."""
    heard: list[_Warned] = []
    with _HEARING:
        if not _HEARERS:
            _CATCHER.enter_context(warnings.catch_warnings())
            warnings.simplefilter("always")
            warnings.showwarning = _hear
        _HEARERS.append(heard)
    try:
        yield heard
    finally:
        with _HEARING:
            _HEARERS[:] = [other for other in _HEARERS if other is not heard]
            if not _HEARERS:
                _CATCHER.close()


def _hear(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    for heard in list(_HEARERS):
        heard.append((category, str(message)))


@lru_cache(maxsize=4)
def _filter_of(settings: str, engine: Engine) -> tuple[FilterSettings, BlurFilter]:
    made = FilterSettings.model_validate_json(settings)
    blur = make_filter(made)
    blur.engine = engine
    return made, blur
