"""The rounds of a search, one after the other, each in the journal and in the log of the run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.blackbox_study import Journal
from tuning.files.run_folder import RunFolder
from tuning.job import MethodJob
from tuning.progress import Progress, Stage

__all__ = ["Search", "run_rounds"]


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
