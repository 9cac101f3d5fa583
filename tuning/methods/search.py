"""Optuna for a search: samplers, pruners, and the journal in the run folder.

A round is what is drawn together: one trial, or a population, with what is polished of it. The
journal holds whole rounds alone; what a killed process left of one is dropped and drawn again.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import optuna
from optuna.pruners import (
    BasePruner,
    HyperbandPruner,
    MedianPruner,
    NopPruner,
    SuccessiveHalvingPruner,
)
from optuna.samplers import BaseSampler, CmaEsSampler, GPSampler, RandomSampler, TPESampler
from optuna.storages import InMemoryStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from tuning.config.methods import BlackBoxMethod
from tuning.files.run_folder import RunFolder, trim_torn_line
from tuning.methods.job import MethodJob
from tuning.objective.space import FreeParameter
from tuning.progress import Progress, Stage

__all__ = ["Journal", "Search", "make_pruner", "make_sampler", "new_study", "run_rounds", "suggest"]

_NAME = "fit"  # Hyperband draws a trial's bracket from the study's name
_END = "round_end"


class Journal:
    """The finished trials of a search in a file, one line a trial.

    Args:
        folder: The run.
        index: Position of the method.
        objectives: How many values a trial has, all of them made small.
    """

    def __init__(self, folder: RunFolder, index: int, objectives: int = 1) -> None:
        path = folder.path / f"study-{index}.log"
        # This process holds the run's own lock: what a killed one left here is stale.
        trim_torn_line(path)
        _remove_lock(path)
        self._study = _open(path, objectives)
        trials = self._study.get_trials()
        whole = _whole_rounds(trials)
        if whole < len(trials):
            self._study = _rewritten(path, trials[:whole], objectives)

    def trials(self) -> list[FrozenTrial]:
        """Return the trials of whole rounds, in order."""
        return self._study.get_trials()

    def add(self, trial: FrozenTrial, *, ends_round: bool) -> None:
        """Append a finished trial.

        Args:
            trial: As the study in memory has it.
            ends_round: Whether it is the last of its round.
        """
        trial.user_attrs = trial.user_attrs | {_END: ends_round}
        self._study.add_trial(trial)


def new_study(pruner: BasePruner | None = None, objectives: int = 1) -> optuna.Study:
    """Return an empty study in memory.

    Args:
        pruner: Of its trials; none if left out.
        objectives: How many values a trial has, all of them made small.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna.create_study(
        storage=InMemoryStorage(),
        study_name=_NAME,
        pruner=pruner or NopPruner(),
        directions=["minimize"] * objectives,
    )


def make_sampler(method: BlackBoxMethod, seed: int) -> BaseSampler:
    """Return the sampler of one trial.

    Args:
        method: The search.
        seed: Of this trial.
    """
    seed %= 1 << 31
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if method.sampler == "tpe":
            return TPESampler(seed=seed, constant_liar=True)
        if method.sampler == "cmaes":
            return CmaEsSampler(
                seed=seed,
                warn_independent_sampling=False,
                popsize=method.population if method.population > 1 else None,
                consider_pruned_trials=method.pruning is not None,
            )
        return GPSampler(seed=seed) if method.sampler == "gp" else RandomSampler(seed=seed)


def make_pruner(method: BlackBoxMethod, rungs: int) -> BasePruner:
    """Return the pruner of a search; rung k reports at the resource `factor` to the power of k.

    Args:
        method: The search.
        rungs: Their number, the last with all windows.
    """
    spec = method.pruning
    if spec is None:
        return NopPruner()
    if spec.pruner == "median":
        return MedianPruner(n_startup_trials=spec.startup)
    if spec.pruner == "sha":
        return SuccessiveHalvingPruner(min_resource=1, reduction_factor=spec.factor)
    highest = spec.factor ** (rungs - 1)
    return HyperbandPruner(min_resource=1, max_resource=highest, reduction_factor=spec.factor)


def suggest(trial: Trial, parameter: FreeParameter) -> Any:
    """Return a trial's value of a parameter."""
    name = parameter.name
    if parameter.choices:
        return trial.suggest_categorical(name, parameter.choices)
    low, high = parameter.spec.bounds
    is_log = parameter.spec.scale == "log"
    if parameter.is_integer:
        return trial.suggest_int(name, math.ceil(low), math.floor(high), log=is_log)
    return trial.suggest_float(name, low, high, log=is_log)


def _open(path: Path, objectives: int) -> optuna.Study:
    return optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(path))),
        study_name=_NAME,
        directions=["minimize"] * objectives,
        load_if_exists=True,
    )


def _whole_rounds(trials: list[FrozenTrial]) -> int:
    """Return how many trials there are up to the end of the last whole round."""
    ends = [index for index, trial in enumerate(trials) if trial.user_attrs.get(_END, True)]
    return ends[-1] + 1 if ends else 0


def _rewritten(path: Path, trials: list[FrozenTrial], objectives: int) -> optuna.Study:
    """Replace a journal by one with these trials alone."""
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    _remove_lock(part)
    study = _open(part, objectives)
    for trial in trials:
        study.add_trial(trial)
    part.replace(path)
    return _open(path, objectives)


def _remove_lock(path: Path) -> None:
    path.with_name(f"{path.name}.lock").unlink(missing_ok=True)


class Search(Protocol):
    """A study in memory that goes on by rounds."""

    study: optuna.Study

    @property
    def drawn(self) -> int:
        """How many trials the sampler drew."""

    @property
    def best(self) -> float | None:
        """The least loss so far."""

    def round(self) -> list[FrozenTrial]:
        """Draw, evaluate and tell; return the finished trials in order."""


def run_rounds(
    search: Search,
    job: MethodJob,
    trials: int,
    record: Callable[[FrozenTrial], dict[str, Any]],
    folder: RunFolder | None = None,
    progress: Progress | None = None,
) -> None:
    """Go on with a search until it has drawn all of its trials.

    Args:
        search: An empty search; what the journal has joins it first.
        job: Whose journal and log lines these are.
        trials: How many are drawn.
        record: Returns what is logged of a trial.
        folder: Where the journal and the log go; a journal that is there is gone on from.
        progress: Who is told of each round.
    """
    journal = None
    if folder is not None:
        journal = Journal(folder, job.index, len(search.study.directions))
        for trial in journal.trials():
            search.study.add_trial(trial)
        known = search.study.trials
        logged = folder.drop_records(job.index, len(known))
        for trial in known:
            if trial.number not in logged:
                _log(folder, job, record(trial))
    stage = Stage(job.name, trials, progress, done=search.drawn)
    while search.drawn < trials:
        found = search.round()
        for position, trial in enumerate(found):
            if folder is not None and journal is not None:
                journal.add(trial, ends_round=position == len(found) - 1)
                _log(folder, job, record(trial))
        last = [t.values[0] for t in found if t.state == TrialState.COMPLETE and t.values]
        stage.step(search.drawn, loss=min(last, default=None), best=search.best)


def _log(folder: RunFolder, job: MethodJob, record: dict[str, Any]) -> None:
    folder.log(method=job.index, **record)
