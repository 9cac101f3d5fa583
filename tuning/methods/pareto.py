"""A search for the front: settings that no other one beats in both quality and cost.

It is a search of two objectives, whose rounds are populations. The cost is counted, not measured,
so it is the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from optuna.samplers import BaseSampler, NSGAIISampler, TPESampler
from optuna.trial import FrozenTrial, Trial, TrialState

from tuning.config.cost import cost_at
from tuning.config.methods import ParetoMethod
from tuning.files.run_folder import RunFolder
from tuning.methods.gradient_state import FitError, seed_of
from tuning.methods.job import MethodJob
from tuning.methods.polish import Polished, PolishStart, polish
from tuning.methods.search import Clock, Search, new_study
from tuning.objective.candidates import evaluate_candidates
from tuning.objective.problem import Problem
from tuning.objective.space import FreeParameter
from tuning.progress import Progress, Stage
from tuning.results.fit import MethodResult
from tuning.results.front import ParetoPoint, ParetoResult, front_of, make_point, pick

__all__ = ["ParetoJob", "fit_pareto"]

_OBJECTIVES = 2
_POPULATION = 20  # of nsga2, if not said otherwise
_POLISH_SEED = 1 << 43


@dataclass(frozen=True, kw_only=True, eq=False)
class ParetoJob(MethodJob):
    """What a search for the front works on; the sweep starts from the last of `first`.

    Args:
        method: Its settings.
    """

    method: ParetoMethod


def fit_pareto(
    problem: Problem,
    job: ParetoJob,
    folder: RunFolder | None = None,
    progress: Progress | None = None,
) -> MethodResult:
    """Search for the front of the objective against the cost.

    Args:
        problem: The objective.
        job: Settings, parameters, first points.
        folder: Where the journal and the log go; a journal that is there is gone on from.
        progress: Who is told of each round.

    Returns:
        The point of the best objective, and in `pareto` all points, the front and the presets.

    Raises:
        FitError: no trial has a finite loss.
    """
    search = _Search(problem, job)
    search.run(folder, progress)
    return search.result(_polished(search, folder, progress))


class _Search(Search):
    """The study, and what its next round depends on."""

    def __init__(self, problem: Problem, job: ParetoJob) -> None:
        self.job = job
        self.later_seconds = self.later_cpu_seconds = 0.0  # of what follows the trials
        super().__init__(
            problem,
            job,
            new_study(objectives=_OBJECTIVES),
            trials=job.method.trials,
            first=(*job.first, *_sweep(problem, job, job.first[-1])),
            size=_population(job.method),
            first_at_once=True,
        )

    def sampler(self, seed: int) -> BaseSampler:
        """Return the sampler of one trial."""
        method, seed = self.job.method, seed % (1 << 31)
        if method.sampler == "nsga2":
            return NSGAIISampler(population_size=_population(method), seed=seed)
        return TPESampler(seed=seed, constant_liar=True)

    def record(self, trial: FrozenTrial) -> dict[str, Any]:
        """Return what is logged of a trial."""
        known = trial.state == TrialState.COMPLETE
        return {
            "kind": "pareto",
            "step": trial.number,
            "loss": [trial.values[0] if known else None],
            "cost": trial.values[1] if known else None,
            "params": {name: [value] for name, value in trial.params.items()},
        }

    def round(self) -> list[FrozenTrial]:
        """Draw, evaluate and tell; return the finished trials in order."""
        began, trials = Clock(), self.ask_round()
        losses = self.evaluate([self._params(trial) for trial in trials])
        for trial in trials:
            trial.set_user_attr("seconds", began.wall() / len(trials))
            trial.set_user_attr("cpu_seconds", began.cpu() / len(trials))
        return [self._tell(*pair) for pair in zip(trials, losses, strict=True)]

    def points(self) -> list[ParetoPoint]:
        """Return all trials with a finite loss."""
        found = []
        for trial in self.complete():
            params = self._params(trial)
            given = trial.number < len(self.first)
            found.append(
                make_point(
                    trial.number,
                    "given" if given else "search",
                    params,
                    trial.values[0],
                    cost_at(self.problem.blur, params),
                )
            )
        return found

    def result(self, later: Sequence[ParetoPoint]) -> MethodResult:
        """Return what was found; the preset of the whole run is the best at any cost."""
        job, trials = self.job, self.study.get_trials(deepcopy=False)
        points = [*self.points(), *later]
        best = min(points, key=lambda p: (p.objective, p.cost, p.number))
        steps = 0 if job.method.polish is None else job.method.polish.steps
        polished = sum(point.origin == "polished" for point in later)
        evaluations = len(trials) + len(later) + steps * polished
        return MethodResult(
            name=job.name,
            kind="pareto",
            params=best.params,
            objective=best.objective,
            evaluations=evaluations,
            passes=evaluations,
            seconds=self.later_seconds + sum(t.user_attrs["seconds"] for t in trials),
            cpu_seconds=self.later_cpu_seconds + sum(t.user_attrs["cpu_seconds"] for t in trials),
            dropped=len(trials) - len(self.complete()),
            polished=polished,
            importances=self.importances(),
            pareto=ParetoResult(
                points=tuple(points), front=front_of(points), picks=pick(points, job.method.budgets)
            ),
        )

    def note_time(self, stored: Mapping[str, Any]) -> None:
        """Add the time of what followed the trials, as its checkpoint has it."""
        self.later_seconds += stored.get("seconds", 0.0)
        self.later_cpu_seconds += stored.get("cpu_seconds", 0.0)

    def _params(self, trial: Trial | FrozenTrial) -> dict[str, Any]:
        """Return all free parameters, as they would stand in a preset."""
        return dict(self.job.fixed) | self.job.space.rounded(trial.params)

    def evaluate(self, candidates: Sequence[Mapping[str, Any]]) -> list[float]:
        """Return the losses; what was evaluated before is not evaluated again."""
        known = {_key(self._params(t)): t.values[0] for t in self.complete()}
        new = {_key(c): c for c in candidates if _key(c) not in known}
        found = evaluate_candidates(self.problem, self.job.space, self.job.fixed, [*new.values()])
        known |= {key: float(one.losses) for key, one in zip(new, found, strict=True)}
        return [known[_key(candidate)] for candidate in candidates]

    def _tell(self, trial: Trial, loss: float) -> FrozenTrial:
        if not math.isfinite(loss):
            return self.study.tell(trial, state=TrialState.FAIL)
        cost = cost_at(self.problem.blur, self._params(trial)).relative
        return self.study.tell(trial, [loss, cost])


def _population(method: ParetoMethod) -> int:
    return method.population or (_POPULATION if method.sampler == "nsga2" else 1)


def _key(params: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(params.items()))


# -- given points ----------------------------------------------------------------------------------


def _sweep(problem: Problem, job: ParetoJob, start: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a point with other values of the parameter that costs the most.

    So the search begins at what one would have without it: the same settings with fewer taps.
    """
    start = dict(start)
    most: list[Any] = []
    chosen, widest = "", 1.0
    for parameter in job.space.parameters:
        if parameter.is_continuous or job.method.sweep == 0:
            continue
        values = _spaced(parameter, job.method.sweep)
        costs = [cost_at(problem.blur, start | {parameter.name: v}).relative for v in values]
        if max(costs) / min(costs) > widest:
            chosen, widest, most = parameter.name, max(costs) / min(costs), values
    return [start | {chosen: value} for value in most if value != start[chosen]]


def _spaced(parameter: FreeParameter, count: int) -> list[Any]:
    """Return values over the range of a parameter, in equal ratios if its scale says so."""
    if parameter.choices:
        return list(parameter.choices)
    low, high = math.ceil(parameter.spec.bounds[0]), math.floor(parameter.spec.bounds[1])
    shares = [index / max(count - 1, 1) for index in range(count)]
    if parameter.spec.scale == "log":
        return list(dict.fromkeys(round(low * (high / low) ** share) for share in shares))
    return list(dict.fromkeys(round(low + (high - low) * share) for share in shares))


# -- polish ----------------------------------------------------------------------------------------


def _polished(
    search: _Search, folder: RunFolder | None, progress: Progress | None
) -> list[ParetoPoint]:
    """Go down the gradient from each picked point: its cost stays, its objective falls.

    The best of what comes out is tried at the other costs as well.

    Returns:
        Those that became better, and those tried.
    """
    job, points = search.job, search.points()
    if not points:
        raise FitError(f"{job.name}: none of {search.drawn} trials has a finite loss")
    smooth = tuple(p.name for p in job.space.parameters if p.spec.grad == "smooth")
    if job.method.polish is None or not smooth:
        return []
    by_number = {point.number: point for point in points}
    picks = dict.fromkeys(p.number for p in pick(points, job.method.budgets))
    chosen = [by_number[number] for number in picks if number is not None]
    stage = Stage(f"{job.name}: polish", len(chosen), progress)
    name = f"polished-{job.index}.pt"
    stored = None if folder is None else folder.load_state(name)
    if stored is None:
        stage.step(0, message=f"gradient steps from {len(chosen)} presets")
        began = Clock()
        steps = _steps(search, chosen, smooth)
        stored = {
            "found": [_plain(after) for after in steps],
            "seconds": began.wall(),
            "cpu_seconds": sum(after.cpu_seconds for after in steps),
        }
        if folder is not None:
            folder.save_state(name, stored)
    search.note_time(stored)
    stage.step(len(chosen), best=min((loss for _, loss in stored["found"]), default=None))
    made = []
    for place, (point, (params, loss)) in enumerate(zip(chosen, stored["found"], strict=True)):
        if params is not None and loss < point.objective:
            cost = cost_at(search.problem.blur, params)
            made.append(make_point(search.drawn + place, "polished", params, loss, cost))
    return [*made, *_swept(search, made, folder)]


def _swept(
    search: _Search, made: Sequence[ParetoPoint], folder: RunFolder | None
) -> list[ParetoPoint]:
    """Return the best polished point with other values of what costs the most."""
    if not made:
        return []
    best = min(made, key=lambda p: (p.objective, p.cost))
    others = _sweep(search.problem, search.job, best.params)
    name = f"swept-{search.job.index}.pt"
    stored = None if folder is None else folder.load_state(name)
    if stored is None:
        began, losses = Clock(), search.evaluate(others)
        stored = {"losses": losses, "seconds": began.wall(), "cpu_seconds": began.cpu()}
        if folder is not None:
            folder.save_state(name, stored)
    search.note_time(stored)
    found = zip(others, stored["losses"], strict=True)
    first = made[-1].number + 1
    return [
        make_point(first + place, "sweep", params, loss, cost_at(search.problem.blur, params))
        for place, (params, loss) in enumerate(found)
        if math.isfinite(loss)
    ]


def _steps(
    search: _Search, chosen: Sequence[ParetoPoint], smooth: tuple[str, ...]
) -> list[Polished]:
    job, spec = search.job, search.job.method.polish
    assert spec is not None
    starts = [
        PolishStart(p.params, seed_of(job.seed, job.index, p.number, _POLISH_SEED)) for p in chosen
    ]
    task = partial(polish, spec, job.space.subset(smooth), job.fixed)
    return search.problem.map(task, starts)


def _plain(after: Polished) -> tuple[dict[str, Any] | None, float]:
    return None if after.params is None else dict(after.params), after.loss
