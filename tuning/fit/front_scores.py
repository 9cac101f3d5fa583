"""What a front is worth where it was not searched: the hold-out, and the filter as published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchblur.filters import BlurFilter, get_filter
from tuning.config.cost import cost_at
from tuning.data.cases import AnyCase
from tuning.objective.problem import Problem
from tuning.objective.windows import make_samples
from tuning.progress import Progress, Stage
from tuning.results.fit import MethodResult
from tuning.results.front import Origin, ParetoPoint, make_point

__all__ = ["budget_notes", "judged"]


def judged(
    method: MethodResult,
    problem: Problem,
    start: Mapping[str, Any],
    cases: Sequence[AnyCase],
    progress: Progress | None = None,
) -> MethodResult:
    """Return a search's result with the hold-out's objective of its front, and its landmarks.

    Args:
        method: What a method found; one without a front comes back as it is.
        problem: The objective on the training frames.
        start: The start values of all free parameters.
        cases: Frames and sequences of both splits.
        progress: Who is told of each point.
    """
    found = method.pareto
    if found is None:
        return method
    holdout = _holdout(problem, problem.blur, cases)
    wanted = {*found.front, *(p.number for p in found.picks if p.number is not None)}
    stage = Stage(f"{method.name}: hold-out", len(wanted), progress if holdout else None)
    points, done = [], 0
    for point in found.points:
        if holdout is not None and point.number in wanted:
            loss = float(holdout.mean(point.params))
            point = point.model_copy(update={"holdout": loss})
            done += 1
            stage.step(done)
        points.append(point)
    landmarks = _landmarks(problem, start, cases, holdout)
    update = {"points": tuple(points), "landmarks": landmarks}
    return method.model_copy(update={"pareto": found.model_copy(update=update)})


def _holdout(problem: Problem, blur: BlurFilter, cases: Sequence[AnyCase]) -> Problem | None:
    """Return the objective on whole frames of the hold-out, if there is one."""
    chosen = [case for case in cases if case.split == "holdout"]
    if not chosen:
        return None
    samples = make_samples(chosen, None, tile_size=1, seed=0, blur=blur)
    return Problem(blur, samples, problem.objective, problem.free)


def _landmarks(
    problem: Problem, start: Mapping[str, Any], cases: Sequence[AnyCase], holdout: Problem | None
) -> tuple[ParetoPoint, ...]:
    blur = problem.blur
    marks = [_as_published(blur.name, "published", problem, cases)]
    own = type(blur.config).model_validate(blur.config.model_dump() | dict(start))
    if own != type(blur.config)():
        marks.append(_mark("start", start, problem, holdout))
    if blur.name != "line":
        marks.append(_as_published("line", "line", problem, cases))
    return tuple(marks)


def _as_published(
    name: str, origin: Origin, problem: Problem, cases: Sequence[AnyCase]
) -> ParetoPoint:
    blur = get_filter(name)(engine=problem.blur.engine).to(problem.samples[0].device)
    blur.requires_grad_(False)
    train = Problem(blur, problem.samples, problem.objective)
    return _mark(origin, {}, train, _holdout(train, blur, cases))


def _mark(
    origin: Origin, params: Mapping[str, Any], train: Problem, holdout: Problem | None
) -> ParetoPoint:
    point = make_point(-1, origin, params, float(train.mean(params)), cost_at(train.blur, params))
    if holdout is None:
        return point
    return point.model_copy(update={"holdout": float(holdout.mean(params))})


def budget_notes(methods: Sequence[MethodResult]) -> tuple[str, ...]:
    """Return what the user should know of budgets: nothing that cheap, or nothing better."""
    notes: list[str] = []
    for found in [method.pareto for method in methods if method.pareto is not None]:
        cheapest = min(point.cost for point in found.points)
        named: dict[int, str] = {}
        for pick in found.picks:
            if pick.number is None:
                notes.append(
                    f"No setting costs {pick.budget:g} or less: there is no preset `{pick.name}`; "
                    f"the cheapest that was tried costs {cheapest:.3g}."
                )
            elif pick.number in named:
                notes.append(
                    f"Preset `{pick.name}` is the same as `{named[pick.number]}`: nothing dearer "
                    "was better on the training frames."
                )
            else:
                named[pick.number] = pick.name
    return tuple(notes)
