"""An Optuna study over the free parameters, of every class, kept in a journal in the run folder.

The sampler of each trial is seeded by the run's seed and the trial's number, so that a study that
was killed draws what it would have drawn; the trial that was in flight is taken up again with the
values that it had.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import optuna
import torch
from optuna.samplers import BaseSampler, CmaEsSampler, GPSampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, InMemoryStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from tuning.config import BlackBoxMethod
from tuning.gradient import FitError, seed_of
from tuning.problem import Problem
from tuning.progress import Progress, Stage
from tuning.result import MethodResult
from tuning.runfolder import RunFolder, trim_torn_line
from tuning.space import Space

__all__ = ["BlackBoxJob", "fit_blackbox"]

_FINISHED = (TrialState.COMPLETE, TrialState.FAIL)


@dataclass(frozen=True, kw_only=True, eq=False)
class BlackBoxJob:
    """What a black-box fit works on.

    Args:
        method: Its settings.
        index: Its position among the methods.
        name: Its name in results.
        space: The parameters that it fits.
        fixed: Values of the free parameters that it does not fit.
        first: Points to evaluate before the sampler's.
        seed: Seed of the run.
    """

    method: BlackBoxMethod
    index: int
    name: str
    space: Space
    fixed: Mapping[str, Any]
    first: tuple[Mapping[str, Any], ...]
    seed: int


def fit_blackbox(
    problem: Problem,
    job: BlackBoxJob,
    folder: RunFolder | None = None,
    progress: Progress | None = None,
) -> MethodResult:
    """Fit parameters by a search.

    Args:
        problem: The objective.
        job: Settings, parameters, first points.
        folder: Where the journal and the log go; a journal that is there is gone on from.
        progress: Who is told of each trial.

    Returns:
        The best trial.

    Raises:
        FitError: no trial has a finite loss.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = _open_study(job, folder)
    done = len(study.get_trials(deepcopy=False, states=_FINISHED))
    stage = Stage(job.name, job.method.trials, progress, done=done)
    if folder is not None:
        folder.drop_records(job.index, 0)
        for trial in study.get_trials(deepcopy=False, states=_FINISHED):
            _log(folder, job, trial)
    for number in range(done, job.method.trials):
        loss = _run_trial(study, problem, job, number)
        if folder is not None:
            _log(folder, job, study.get_trials(deepcopy=False)[number])
        stage.step(number + 1, loss=loss if math.isfinite(loss) else None, best=_best(study))
    return _result(study, problem, job)


def _open_study(job: BlackBoxJob, folder: RunFolder | None) -> optuna.Study:
    study = optuna.create_study(
        storage=InMemoryStorage() if folder is None else _journal(folder, job.index),
        study_name="fit",
        direction="minimize",
        load_if_exists=True,
    )
    points = job.first[: job.method.trials]
    for point in points[len(study.get_trials(deepcopy=False)) :]:
        study.enqueue_trial({name: point[name] for name in job.space.names})
    return study


def _journal(folder: RunFolder, index: int) -> BaseStorage:
    path = folder.path / f"study-{index}.log"
    # This process holds the run's own lock: what a killed one left here is stale.
    trim_torn_line(path)
    path.with_name(f"{path.name}.lock").unlink(missing_ok=True)
    return JournalStorage(JournalFileBackend(str(path)))


def _run_trial(study: optuna.Study, problem: Problem, job: BlackBoxJob, number: int) -> float:
    study.sampler = _sampler(job, number)
    in_flight = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
    with _one_thread(job.method.sampler == "gp"):
        trial = Trial(study, in_flight[0]._trial_id) if in_flight else study.ask()
        values = {p.name: _suggest(trial, job.space, p.name) for p in job.space.parameters}
    loss = float(problem.mean(dict(job.fixed) | values))
    if math.isfinite(loss):
        study.tell(trial, loss)
    else:
        study.tell(trial, state=TrialState.FAIL)
    return loss


def _suggest(trial: Trial, space: Space, name: str) -> Any:
    parameter = next(p for p in space.parameters if p.name == name)
    if parameter.choices:
        return trial.suggest_categorical(name, parameter.choices)
    low, high = parameter.spec.bounds
    is_log = parameter.spec.scale == "log"
    if parameter.is_integer:
        return trial.suggest_int(name, math.ceil(low), math.floor(high), log=is_log)
    return trial.suggest_float(name, low, high, log=is_log)


def _sampler(job: BlackBoxJob, number: int) -> BaseSampler:
    seed = seed_of(job.seed, job.index, number) % (1 << 31)
    kind = job.method.sampler
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if kind == "tpe":
            return TPESampler(seed=seed)
        if kind == "cmaes":
            return CmaEsSampler(seed=seed, warn_independent_sampling=False)
        return GPSampler(seed=seed) if kind == "gp" else RandomSampler(seed=seed)


def _best(study: optuna.Study) -> float | None:
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return min((t.value for t in trials if t.value is not None), default=None)


def _log(folder: RunFolder, job: BlackBoxJob, trial: FrozenTrial) -> None:
    folder.log(
        method=job.index,
        kind="blackbox",
        step=trial.number,
        loss=[trial.value],
        params={name: [value] for name, value in trial.params.items()},
    )


def _result(study: optuna.Study, problem: Problem, job: BlackBoxJob) -> MethodResult:
    finished = study.get_trials(deepcopy=False, states=_FINISHED)
    complete = [t for t in finished if t.state == TrialState.COMPLETE]
    if not complete:
        raise FitError(f"{job.name}: none of {len(finished)} trials has a finite loss")
    params = dict(job.fixed) | job.space.rounded(study.best_trial.params)
    durations = [t.duration.total_seconds() for t in finished if t.duration is not None]
    return MethodResult(
        name=job.name,
        kind="blackbox",
        params=params,
        objective=float(problem.mean(params)),
        evaluations=len(finished),
        seconds=sum(durations),
        dropped=len(finished) - len(complete),
        importances=_importances(study, len(complete)),
    )


def _importances(study: optuna.Study, complete: int) -> dict[str, float]:
    if complete < 10:  # fewer tell nothing
        return {}
    try:
        return dict(optuna.importance.get_param_importances(study))
    except (RuntimeError, ValueError):
        return {}  # all trials alike: nothing to divide the spread of


@contextmanager
def _one_thread(wanted: bool) -> Iterator[None]:
    """Run Optuna's Gaussian process on one thread: more of them make it slower, by far."""
    threads = torch.get_num_threads()
    if wanted:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
