"""What searches share: Optuna's samplers and pruners, rounds, and the journal in the run folder.

A round is what is drawn together: one trial, or a population, with what is polished of it. The
journal holds whole rounds alone; what a killed process left of one is dropped and drawn again.
"""

from __future__ import annotations

import math
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
import torch
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
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial

from tuning.config.methods import BlackBoxMethod
from tuning.files.run_folder import RunFolder, trim_torn_line
from tuning.methods.gradient_state import seed_of
from tuning.methods.job import MethodJob
from tuning.objective.problem import Problem
from tuning.objective.space import FreeParameter
from tuning.progress import Progress, Stage

__all__ = ["Clock", "Journal", "Search", "make_pruner", "make_sampler", "new_study"]

_NAME = "fit"  # Hyperband draws a trial's bracket from the study's name
_END = "round_end"
_ENOUGH = 10  # trials; the importances of fewer tell nothing


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


def _suggest(trial: Trial, parameter: FreeParameter) -> Any:
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


class Clock:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def wall(self) -> float:
        """Return the time that has passed."""
        return time.monotonic() - self._wall

    def cpu(self) -> float:
        """Return that of this process."""
        return time.process_time() - self._cpu


class Search(ABC):
    """An Optuna study that is worked on in memory, round by round.

    Each finished trial is a line of the journal. The sampler of a trial is seeded by the run's
    seed and the trial's number. So a study that was killed loses the round in flight alone, draws
    it again with the same values, and ends as it would have.

    Args:
        problem: The objective.
        job: Parameters, seed, whose journal and log lines these are.
        study: An empty one.
        trials: How many are drawn.
        first: Points that are tried before any is drawn.
        size: How many trials are a round.
        first_at_once: Whether the first points are a round of their own, so that populations are
            whole.
    """

    def __init__(
        self,
        problem: Problem,
        job: MethodJob,
        study: optuna.Study,
        *,
        trials: int,
        first: Sequence[Mapping[str, Any]],
        size: int,
        first_at_once: bool,
    ) -> None:
        self.problem, self.study = problem, study
        self._job, self._trials = job, trials
        self.first, self._size, self._first_at_once = first, size, first_at_once

    @abstractmethod
    def round(self) -> list[FrozenTrial]:
        """Draw, evaluate and tell; return the finished trials in order."""

    @abstractmethod
    def sampler(self, seed: int) -> BaseSampler:
        """Return the sampler of one trial."""

    @abstractmethod
    def record(self, trial: FrozenTrial) -> dict[str, Any]:
        """Return what is logged of a trial."""

    @property
    def drawn(self) -> int:
        """How many trials the sampler drew."""
        return len(self.study.get_trials(deepcopy=False))

    @property
    def best(self) -> float | None:
        """The least loss so far."""
        return min((t.values[0] for t in self.complete()), default=None)

    def complete(self) -> list[FrozenTrial]:
        """Return the trials with a finite loss."""
        return self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))

    def run(self, folder: RunFolder | None, progress: Progress | None) -> None:
        """Go on until all trials are drawn.

        Args:
            folder: Where the journal and the log go; what the journal has joins the study first.
            progress: Who is told of each round.
        """
        journal = None if folder is None else self._journal(folder)
        stage = Stage(self._job.name, self._trials, progress, done=self.drawn)
        while self.drawn < self._trials:
            found = self.round()
            for position, trial in enumerate(found):
                if folder is not None and journal is not None:
                    journal.add(trial, ends_round=position == len(found) - 1)
                    folder.log(method=self._job.index, **self.record(trial))
            last = [t.values[0] for t in found if t.state == TrialState.COMPLETE and t.values]
            stage.step(self.drawn, loss=min(last, default=None), best=self.best)

    def ask_round(self) -> list[Trial]:
        """Draw the next round."""
        drawn, given = self.drawn, min(len(self.first), self._trials)
        end = min(drawn + self._size, self._trials)
        if self._first_at_once and drawn < given:
            end = given
        return [self._ask(number) for number in range(drawn, end)]

    def importances(self) -> dict[str, float]:
        """Return the share of each parameter in the spread of the loss."""
        trials = self.complete()
        if len(trials) < _ENOUGH:
            return {}
        alone = new_study()
        for trial in trials:
            alone.add_trial(
                create_trial(
                    value=trial.values[0], params=trial.params, distributions=trial.distributions
                )
            )
        try:
            return dict(optuna.importance.get_param_importances(alone))
        except (RuntimeError, ValueError):
            return {}  # all trials alike: nothing to divide the spread of

    def _ask(self, drawn: int) -> Trial:
        job, number = self._job, len(self.study.get_trials(deepcopy=False))
        self.study.sampler = self.sampler(seed_of(job.seed, job.index, number))
        if drawn < len(self.first):
            self.study.enqueue_trial({name: self.first[drawn][name] for name in job.space.names})
        with _one_thread(isinstance(self.study.sampler, GPSampler)):
            trial = self.study.ask()
            for parameter in job.space.parameters:
                _suggest(trial, parameter)
        return trial

    def _journal(self, folder: RunFolder) -> Journal:
        journal = Journal(folder, self._job.index, len(self.study.directions))
        for trial in journal.trials():
            self.study.add_trial(trial)
        known = self.study.trials
        logged = folder.drop_records(self._job.index, len(known))
        for trial in known:
            if trial.number not in logged:
                folder.log(method=self._job.index, **self.record(trial))
        return journal


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
