"""Batch runs: one filter over many frames, on a few threads, to be stopped and gone on with.

While one frame is filtered the next ones are read; a filter with a memory takes the frames of a
shot in order. Each result appears whole or not at all and says in its metadata what it was made
with, so that a second run does only what is missing.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import Field

from torchblur.errors import ConfigError, OutputError
from torchblur.filters.parts.base import TemporalBlur
from torchblur.io import load_yaml
from torchblur.params import build
from tuning.batch.apply import FilterSettings, make_filter, recipe_of, samples_beside
from tuning.batch.cluster import run_on_cluster
from tuning.batch.threads import Runner, Task
from tuning.config.overrides import apply_overrides
from tuning.files.frame_numbers import shots_of
from tuning.files.outputs import (
    Job,
    State,
    drop_results,
    find_inputs,
    make_folders,
    name_outputs,
    newest_of,
    number_of,
    numbered,
    remove_leftovers,
    state_of,
)
from tuning.objective.engine import files_engine
from tuning.parallel.cluster import Cluster
from tuning.parallel.cores import count_cores
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
    workers: int = Field(
        1, ge=1, le=256, description="frames (with a memory: shots) that are filtered at a time"
    )
    prefetch: int = Field(2, ge=0, le=64, description="frames that are read ahead")


@dataclass(frozen=True)
class Plan:
    """What a batch run will do.

    Args:
        config: The configuration.
        recipe: What goes into the metadata of each result.
        states: Each job, and whether it is done.
        overwrite: Make all results anew.
        in_order: Whether the filter has a memory: frames are filtered in order, shot by shot.
    """

    config: BatchConfig
    recipe: Mapping[str, Any]
    states: tuple[tuple[Job, State], ...]
    overwrite: bool = False
    in_order: bool = False

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
    blur = make_filter(config)
    recipe = recipe_of(config, blur, config.gbuffer is not None)
    jobs = [
        Job(source, output, _gbuffer_of(source, config), samples_beside(source, config))
        for source, output in pairs
    ]
    if isinstance(blur, TemporalBlur):
        found = _shot_states(shots_of(jobs, config.cuts), recipe)
        return Plan(config, recipe, tuple(found), overwrite, in_order=True)
    with ThreadPoolExecutor(count_cores()) as pool:
        states = list(pool.map(lambda job: state_of(job.output, job.sources, recipe), jobs))
    return Plan(config, recipe, tuple(zip(jobs, states, strict=True)), overwrite)


def run_batch(
    plan: Plan, progress: Progress | None = None, cluster: Cluster | None = None
) -> BatchResult:
    """Make all results of a plan that are not done; go on past frames that fail.

    The result is the same for any number of workers, and for a run that was stopped and started
    again. A filter with a memory takes the frames of a shot in order, on one worker: a shot that
    was left in its middle is filtered again from its first frame on, and only what is missing is
    written. After a frame that fails the rest of its shot is not made.

    On KeyboardInterrupt the frames that are being filtered are finished and written; a second one
    drops them.

    Args:
        plan: What `plan_batch` returned.
        progress: Told after each frame.
        cluster: Workers on this or other machines; left out: `plan.config.workers` threads here.

    Returns:
        In the order of the plan: what was written, what failed and why; and whether the run was
        interrupted.

    Raises:
        OutputError: results made with other settings are in the way, or a folder cannot be made.
        ClusterError: a worker does not see the files, or the scheduler or all workers are gone.
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
    blur = make_filter(plan.config)
    blur.engine = files_engine(blur, [job for job, _ in plan.states])
    config, tasks = plan.config, _tasks(plan)
    common: dict[str, Any] = {"recipe": plan.recipe, "prefetch": config.prefetch, "log": log}
    if cluster is not None:
        stopped = run_on_cluster(cluster, tasks, blur, config, **common)
    else:
        stopped = Runner(blur, config, workers=config.workers, **common).run(tasks)
    result.interrupted = stopped and len(result.written) + len(result.failures) < len(jobs)
    place = {output: index for index, output in enumerate(outputs)}
    result.written.sort(key=place.__getitem__)
    result.failures.sort(key=lambda failure: place[failure.job.output])
    return result


class _Log:
    """Writes down what becomes of each job, and tells the progress; from any thread."""

    def __init__(self, result: BatchResult, stage: Stage) -> None:
        self._result, self._stage = result, stage
        self._turn = threading.Lock()

    def written(self, job: Job) -> None:
        with self._turn:
            self._result.written.append(job.output)
            self._tell(job.output.name)

    def failed(self, job: Job, reason: str) -> None:
        with self._turn:
            self._result.failures.append(Failure(job, reason))
            self._tell(job.output.name)

    def stopping(self, count: int) -> None:
        with self._turn:
            text = f"stopping: {count} frames in flight are finished; Ctrl-C again drops them"
            self._tell(text, is_last=True)

    def _tell(self, message: str, *, is_last: bool = False) -> None:
        done = len(self._result.written) + len(self._result.failures)
        failed = len(self._result.failures)
        self._stage.step(done, message=f"{failed} failed" if failed and not is_last else message)


def _shot_states(
    shots: Sequence[Sequence[Job]], recipe: Mapping[str, Any]
) -> list[tuple[Job, State]]:
    """Return the state of each frame: one is as old as the oldest that it follows."""
    names = [(job, shot[0].source.name) for shot in shots for job in shot]
    with ThreadPoolExecutor(count_cores()) as pool:
        found = pool.map(lambda e: state_of(e[0].output, e[0].sources, recipe, e[1]), names)
        states = dict(zip([job for job, _ in names], found, strict=True))
    for shot in shots:
        newest = 0.0
        for job in shot:
            newest = max(newest, newest_of(job.sources))
            if states[job] == "done" and newest > job.output.stat().st_mtime:
                states[job] = "out of date"
    return list(states.items())


def _tasks(plan: Plan) -> list[Task]:
    """Return what is to be done: frames, or shots up to the last frame that is missing."""
    todo = plan.todo
    if not plan.in_order:
        return [Task([job], [job]) for job in todo]
    wanted = frozenset(todo)
    tasks = []
    for shot in shots_of([job for job, _ in plan.states], plan.config.cuts):
        missing = [index for index, job in enumerate(shot) if job in wanted]
        if missing:
            jobs = shot[: missing[-1] + 1]
            tasks.append(Task(jobs, wanted, shot=shot[0].source.name))
    return tasks


def _gbuffer_of(source: Path, config: BatchConfig) -> Path | None:
    if config.gbuffer is None:
        return None
    name = config.gbuffer
    if number_of(source) is None:
        name = re.sub(r"[._-]?#+", "", name)
    return source.parent / numbered(name, source)
