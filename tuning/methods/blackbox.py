"""A search over the free parameters, of every class.

A round is one trial, or a population that is drawn before any of it is known, and what is polished
of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from optuna.samplers import BaseSampler
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial

from tuning.config.methods import BlackBoxMethod
from tuning.files.run_folder import RunFolder
from tuning.methods.gradient_state import FitError, seed_of
from tuning.methods.job import MethodJob
from tuning.methods.polish import Polished, PolishStart, is_promising, polish
from tuning.methods.pruning import Climb, Ladder
from tuning.methods.search import Clock, Search, make_pruner, make_sampler, new_study
from tuning.objective.candidates import evaluate_candidates
from tuning.objective.problem import Problem
from tuning.progress import Progress
from tuning.results.fit import MethodResult

__all__ = ["BlackBoxJob", "fit_blackbox"]

_POLISHED = "polish_of"
_WINDOWS_SEED, _POLISH_SEED = 1 << 41, 1 << 42


@dataclass(frozen=True, kw_only=True, eq=False)
class BlackBoxJob(MethodJob):
    """What a black-box fit works on.

    Args:
        method: Its settings.
        polished: Names of the parameters that are polished by gradient.
    """

    method: BlackBoxMethod
    polished: tuple[str, ...] = ()


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
        ConfigError: too few windows for the rungs of a pruner.
        FitError: no trial has a finite loss.
    """
    search = _Search(problem, job)
    search.run(folder, progress)
    return search.result()


class _Search(Search):
    """The study, and what its next round depends on."""

    def __init__(self, problem: Problem, job: BlackBoxJob) -> None:
        self.job, pruning = job, job.method.pruning
        self.ladder = (
            None
            if pruning is None
            else Ladder(problem, pruning, seed_of(job.seed, job.index, _WINDOWS_SEED))
        )
        rungs = 1 if self.ladder is None else len(self.ladder.rungs)
        super().__init__(
            problem,
            job,
            new_study(make_pruner(job.method, rungs)),
            trials=job.method.trials,
            first=job.first,
            size=job.method.population,
            first_at_once=job.method.population > 1,
        )

    def sampler(self, seed: int) -> BaseSampler:
        """Return the sampler of one trial."""
        return make_sampler(self.job.method, seed)

    def record(self, trial: FrozenTrial) -> dict[str, Any]:
        """Return what is logged of a trial."""
        is_pruned = trial.state == TrialState.PRUNED
        known = ("passes", "cpu_seconds", _POLISHED)
        extra = {name: trial.user_attrs[name] for name in known if name in trial.user_attrs}
        if is_pruned:
            extra["pruned"] = trial.value
        return {
            "kind": "blackbox",
            "step": trial.number,
            "loss": [None if is_pruned else trial.value],
            "params": {name: [value] for name, value in trial.params.items()},
            **extra,
        }

    @property
    def drawn(self) -> int:
        """How many trials the sampler drew; what was polished of them is not counted."""
        return sum(not _is_polished(t) for t in self.study.get_trials(deepcopy=False))

    def round(self) -> list[FrozenTrial]:
        """Draw, evaluate, polish and tell; return the finished trials in order."""
        began = Clock()
        trials = self.ask_round()
        drawing = began.cpu() / len(trials)
        found = self._evaluate(trials)
        polished = self._polish(trials, found)
        for trial, climb in zip(trials, found, strict=True):
            climb.cpu_seconds += drawing
            trial.set_user_attr("seconds", began.wall() / len(trials))
        told = [self._tell(*each) for each in zip(trials, found, polished, strict=True)]
        for trial, after in zip(trials, polished, strict=True):
            if after is not None and _is_new(after, trial):
                self._add(trial, after)
                told.append(self.study.get_trials()[-1])
        return told

    def _evaluate(self, trials: Sequence[Trial]) -> list[Climb]:
        candidates = [trial.params for trial in trials]
        space, fixed, together = self.job.space, self.job.fixed, self.job.method.together
        if self.ladder is not None:
            return self.ladder.climb(trials, space, fixed, candidates, together)
        found = evaluate_candidates(self.problem, space, fixed, candidates, together=together)
        return [
            Climb(loss=float(one.losses), passes=1.0, cpu_seconds=one.cpu_seconds) for one in found
        ]

    def _known_losses(self) -> list[float]:
        return [t.values[0] for t in self.complete() if not _is_polished(t)]

    def _polish(
        self, trials: Sequence[Trial], climbs: Sequence[Climb]
    ) -> Sequence[Polished | None]:
        """Return what the steps found from each promising trial, and None for the others."""
        job, spec = self.job, self.job.method.polish
        if spec is None:
            return [None] * len(trials)
        losses, points = self._known_losses(), {}
        for trial, climb in zip(trials, climbs, strict=True):
            if climb.pruned or not math.isfinite(climb.loss):
                continue
            if is_promising(climb.loss, losses, spec.quantile):
                seed = seed_of(job.seed, job.index, trial.number, _POLISH_SEED)
                points[trial.number] = PolishStart(trial.params, seed)
            losses.append(climb.loss)
        steps = partial(polish, spec, job.space.subset(job.polished), job.fixed)
        found = self.problem.map(steps, list(points.values()))
        by_number = dict(zip(points, found, strict=True))
        return [by_number.get(trial.number) for trial in trials]

    def _tell(self, trial: Trial, climb: Climb, after: Polished | None) -> FrozenTrial:
        passes, evaluations, seconds = climb.passes, 1, climb.cpu_seconds
        if after is not None and not _is_new(after, trial):  # no trial of its own has its cost
            passes += _passes(after, self.job, self.problem)
            evaluations += after.evaluations
            seconds += after.cpu_seconds
        _note(trial, passes=passes, evaluations=evaluations, cpu_seconds=seconds)
        if climb.pruned:
            return self.study.tell(trial, state=TrialState.PRUNED)
        if math.isfinite(climb.loss):
            return self.study.tell(trial, climb.loss)
        return self.study.tell(trial, state=TrialState.FAIL)

    def _add(self, trial: Trial, after: Polished) -> None:
        assert after.params is not None
        self.study.add_trial(
            create_trial(
                state=TrialState.COMPLETE,
                value=after.loss,
                params=dict(after.params),
                distributions=trial.distributions,
                user_attrs={
                    _POLISHED: trial.number,
                    "passes": _passes(after, self.job, self.problem),
                    "evaluations": after.evaluations,
                    "cpu_seconds": after.cpu_seconds,
                },
            )
        )

    def result(self) -> MethodResult:
        """Return the best trial, evaluated as it would be written to a preset."""
        job, trials = self.job, self.study.get_trials(deepcopy=False)
        count = [trial.state for trial in trials].count
        if not count(TrialState.COMPLETE):
            raise FitError(f"{job.name}: none of {len(trials)} trials has a finite loss")
        params = dict(job.fixed) | job.space.rounded(self.study.best_trial.params)
        return MethodResult(
            name=job.name,
            kind="blackbox",
            params=params,
            objective=float(self.problem.mean(params)),
            evaluations=sum(t.user_attrs.get("evaluations", 1) for t in trials),
            passes=sum(t.user_attrs.get("passes", 1.0) for t in trials),
            seconds=sum(t.user_attrs.get("seconds", 0.0) for t in trials),
            cpu_seconds=sum(t.user_attrs.get("cpu_seconds", 0.0) for t in trials),
            dropped=count(TrialState.FAIL),
            pruned=count(TrialState.PRUNED),
            polished=sum(map(_is_polished, trials)),
            importances=self.importances(),
        )


def _note(trial: Trial, **values: float) -> None:
    for name, value in values.items():
        trial.set_user_attr(name, value)


def _is_polished(trial: FrozenTrial) -> bool:
    return _POLISHED in trial.user_attrs


def _is_new(after: Polished, trial: Trial) -> bool:
    return after.params is not None and dict(after.params) != trial.params


def _passes(after: Polished, job: BlackBoxJob, problem: Problem) -> float:
    """Return the cost of polishing in evaluations of all windows."""
    total, spec = len(problem.samples), job.method.polish
    batch = total if spec is None or spec.batch is None else min(spec.batch, total)
    return 1 + (after.evaluations - 1) * batch / total
