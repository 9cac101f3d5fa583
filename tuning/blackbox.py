"""An Optuna study over the free parameters, of every class, kept in a journal in the run folder.

The study is worked on in memory; each finished trial is added to the journal with one line. The
sampler of a trial is seeded by the run's seed and the trial's number. So a study that was killed
loses the trial in flight alone, draws it again with the same values, and ends as it would have.
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
from optuna.storages import InMemoryStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from tuning.config import BlackBoxMethod
from tuning.gradient import FitError, seed_of
from tuning.problem import Problem
from tuning.progress import Progress, Stage
from tuning.result import MethodResult
from tuning.runfolder import RunFolder, trim_torn_line
from tuning.space import FreeParameter, Space

__all__ = ["BlackBoxJob", "fit_blackbox"]


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
    study = optuna.create_study(storage=InMemoryStorage())
    journal = None if folder is None else _journal(folder, job.index)
    for trial in journal.get_trials() if journal is not None else ():
        study.add_trial(trial)
    done = len(study.trials)
    if folder is not None:
        folder.drop_records(job.index, 0)
        for trial in study.trials:
            _log(folder, job, trial)
    stage = Stage(job.name, job.method.trials, progress, done=done)
    for number in range(done, job.method.trials):
        trial = _run_trial(study, problem, job, number)
        if folder is not None and journal is not None:
            journal.add_trial(trial)
            _log(folder, job, trial)
        stage.step(number + 1, loss=trial.value, best=_best(study))
    return _result(study, problem, job)


def _journal(folder: RunFolder, index: int) -> optuna.Study:
    path = folder.path / f"study-{index}.log"
    # This process holds the run's own lock: what a killed one left here is stale.
    trim_torn_line(path)
    path.with_name(f"{path.name}.lock").unlink(missing_ok=True)
    storage = JournalStorage(JournalFileBackend(str(path)))
    return optuna.create_study(storage=storage, study_name="fit", load_if_exists=True)


def _run_trial(study: optuna.Study, problem: Problem, job: BlackBoxJob, number: int) -> FrozenTrial:
    study.sampler = _sampler(job, number)
    if number < len(job.first):
        study.enqueue_trial({name: job.first[number][name] for name in job.space.names})
    with _one_thread(job.method.sampler == "gp"):
        trial = study.ask()
        values = {p.name: _suggest(trial, p) for p in job.space.parameters}
    loss = float(problem.mean(dict(job.fixed) | values))
    if math.isfinite(loss):
        return study.tell(trial, loss)
    return study.tell(trial, state=TrialState.FAIL)


def _suggest(trial: Trial, parameter: FreeParameter) -> Any:
    name = parameter.name
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
    finished = study.get_trials(deepcopy=False)
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
