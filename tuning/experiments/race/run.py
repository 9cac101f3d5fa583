"""Races: the same problems for several methods and seeds, and how soon each of them is how good.

Each fit keeps its log in a folder of its own, so that a race that was stopped goes on within the
fit in flight. Afterwards the parameters that were the best by then, judged on the training frames
alone, are scored on the hold-out at fixed numbers of evaluations.
"""

from __future__ import annotations

import bisect
import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torchblur.errors import ConfigError
from tuning.config.fit import TuneConfig, resolve
from tuning.config.methods import GradientMethod
from tuning.data.cases import AnyCase, Case
from tuning.data.variants import Variant, render
from tuning.experiments.kept import digest_of, slug
from tuning.experiments.race.config import Entrant, RaceConfig, RaceProblem
from tuning.files.run_folder import RunFolder, open_run
from tuning.methods.run import run_methods
from tuning.objective.prepare import prepare
from tuning.objective.problem import Problem
from tuning.objective.space import Space
from tuning.objective.windows import make_samples
from tuning.progress import Progress, Stage
from tuning.results.fit import MethodResult

__all__ = ["Curve", "Point", "grid", "run_race"]

_CURVE = "curve.json"


@dataclass(frozen=True, kw_only=True)
class Point:
    """Where a fit stands at some time.

    Args:
        passes: Evaluations of all training windows so far.
        cpu_seconds: Of the process so far.
        train: Objective on the training frames of the best parameters so far.
        holdout: The same parameters' objective on the hold-out.
        distance: Of a planted problem: largest distance of a number from its planted value, as a
            share of its range; 1 if a choice is wrong.
        params: These parameters.
    """

    passes: float
    cpu_seconds: float
    train: float
    holdout: float
    distance: float | None
    params: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One fit: who fitted what with which seed, and its points; the last is its result."""

    problem: str
    entrant: str
    seed: int
    points: tuple[Point, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Track:
    """A problem with its data."""

    spec: RaceProblem
    space: Space
    train: Problem
    holdout: Problem


@dataclass(frozen=True)
class _Event:
    """One parameter set that a method evaluated."""

    passes: float
    cpu_seconds: float
    loss: float
    params: Mapping[str, Any]
    forgets: bool  # its loss is of some windows alone, and not to be compared with others


def run_race(config: RaceConfig, folder: Path, progress: Progress | None = None) -> list[Curve]:
    """Run all entrants with all seeds on all problems; what `folder` has already is kept.

    Args:
        config: What `load_race_config` returned.
        folder: Gets `fits/` with a run folder for each fit.
        progress: Told after each fit.

    Raises:
        TorchblurError: data that cannot be read; a method that finds nothing.
    """
    jobs = [(p, e, s) for p in config.problems for e in config.entrants_of(p) for s in config.seeds]
    stage = Stage("fits", len(jobs), progress)
    curves: list[Curve] = []
    tracks: dict[str, _Track] = {}
    for done, (problem, entrant, seed) in enumerate(jobs):
        fit = resolve(config.fit(problem, entrant, seed))
        path = folder / "fits" / _name(problem, entrant, fit)
        if not (path / _CURVE).is_file():
            stage.step(done, message=f"{problem.name}: {entrant.name}, seed {seed}")
            if problem.name not in tracks:
                tracks = {problem.name: _load(config, problem)}
            _run(fit, tracks[problem.name], path)
        points = json.loads((path / _CURVE).read_text(encoding="utf-8"))
        curves.append(
            Curve(
                problem=problem.name,
                entrant=entrant.name,
                seed=seed,
                points=tuple(Point(**point) for point in points),
            )
        )
    stage.step(len(jobs))
    return curves


def grid(total: float) -> list[float]:
    """Return the numbers of evaluations where fits are compared: 1, 1.5, 2, 3, 4, 6 and so on."""
    numbers = []
    power = 1.0
    while power <= total:
        numbers += [n for n in (power, 1.5 * power) if n <= total]
        power *= 2
    return numbers


# -- one fit ---------------------------------------------------------------------------------------


def _name(problem: RaceProblem, entrant: Entrant, fit: TuneConfig) -> str:
    """Return the name of a fit's folder: of all that its figures depend on."""
    digest = digest_of(fit.model_dump(mode="json"), problem.planted, version("torchblur"))
    return f"{slug(problem.name)}.{slug(entrant.name)}.{fit.seed}.{digest}"


def _load(config: RaceConfig, problem: RaceProblem) -> _Track:
    ready = prepare(resolve(config.fit(problem, config.entrants_of(problem)[0])))
    cases, blur, space = ready.cases, ready.blur, ready.space
    if problem.planted is not None:
        values = space.start() | problem.planted
        planted = Variant(name="planted", blur=blur, values=values, free=space.names)
        cases = [_planted(case, planted, problem) for case in cases]
    tile_size = int(getattr(blur.config, "tile_size", 16))
    sides = {}
    for split, crops in (("train", problem.data.crops), ("holdout", None)):
        some = [case for case in cases if case.split == split]
        samples = make_samples(some, crops, tile_size=tile_size, seed=0, blur=blur)
        sides[split] = Problem(blur, samples, problem.objective, space.names)
    return _Track(spec=problem, space=space, train=sides["train"], holdout=sides["holdout"])


def _planted(case: AnyCase, variant: Variant, problem: RaceProblem) -> Case:
    if not isinstance(case, Case):
        raise ConfigError(
            f"`planted` is for single frames, and {case.name!r} of {problem.name!r} is a sequence"
        )
    return dataclasses.replace(case, reference=render(variant, case), variance=None)


def _run(fit: TuneConfig, track: _Track, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_run(path, fit, resume=True) as folder:
        results = run_methods(fit, track.train, track.space, folder)
        points = _points(fit, track, folder, results)
        text = json.dumps([dataclasses.asdict(point) for point in points])
        folder.write(_CURVE, text)


def _points(
    fit: TuneConfig, track: _Track, folder: RunFolder, results: Sequence[MethodResult]
) -> list[Point]:
    events = list(_events(fit, folder.records(), results))
    ends = grid(events[-1].passes)
    scored: dict[str, tuple[float, float]] = {}
    points = []
    for passes, seconds, params in [*_best_by(events, ends), _final(events, results)]:
        rounded = track.space.rounded(params)
        key = json.dumps(rounded, sort_keys=True)
        if key not in scored:
            scored[key] = (float(track.train.mean(rounded)), float(track.holdout.mean(rounded)))
        points.append(
            Point(
                passes=passes,
                cpu_seconds=seconds,
                train=scored[key][0],
                holdout=scored[key][1],
                distance=_distance(track, rounded),
                params=rounded,
            )
        )
    return points


def _events(
    fit: TuneConfig, records: Sequence[Mapping[str, Any]], results: Sequence[MethodResult]
) -> Iterator[_Event]:
    """Yield what was evaluated, in order, with what it cost up to then."""
    passes = seconds = 0.0
    for record in records:
        if "loss" not in record:
            continue
        passes += record["passes"]
        seconds += record["cpu_seconds"]
        method = fit.methods[record["method"]]
        sampled = isinstance(method, GradientMethod) and method.is_sampled
        others = results[record["method"]].params
        for index, loss in enumerate(record["loss"]):
            params = {name: values[index] for name, values in record["params"].items()}
            known = math.inf if loss is None else loss
            yield _Event(passes, seconds, known, dict(others) | params, sampled)


def _best_by(
    events: Sequence[_Event], ends: Sequence[float]
) -> Iterator[tuple[float, float, Mapping[str, Any]]]:
    """Yield the best parameters of the events up to each number of passes."""
    best = None
    best_of: list[tuple[float, _Event]] = []
    for event in events:
        starts_anew = best is None or (event.forgets and event.passes > best.passes)
        if best is None or starts_anew or event.loss < best.loss:
            best = event
        best_of.append((event.passes, best))
    for end in ends:
        index = bisect.bisect_right(best_of, end + 1e-9, key=lambda pair: pair[0]) - 1
        if index >= 0:
            yield end, events[index].cpu_seconds, best_of[index][1].params


def _final(
    events: Sequence[_Event], results: Sequence[MethodResult]
) -> tuple[float, float, Mapping[str, Any]]:
    best = min(results, key=lambda result: result.objective)
    return events[-1].passes, events[-1].cpu_seconds, best.params


def _distance(track: _Track, params: Mapping[str, Any]) -> float | None:
    planted = track.spec.planted
    if planted is None:
        return None
    worst = 0.0
    for name in planted:
        space = track.space.subset((name,))
        if space.parameters[0].choices:
            worst = max(worst, float(params[name] != planted[name]))
        else:
            worst = max(worst, float((space.to_unit(params) - space.to_unit(planted)).abs()))
    return worst
