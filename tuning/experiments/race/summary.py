"""What a race says: medians over the seeds, at the end and on the way."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tuning.experiments.race.config import RaceConfig, RaceProblem
from tuning.experiments.race.run import Curve, Point

__all__ = ["NEAR", "Standing", "at", "median_curve", "standings", "target_of"]

NEAR = 1.05
"""A hold-out loss within this factor of the best median counts as reached."""

Figure = Callable[[Point], float | None]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """One entrant on one problem; medians over the seeds, of the end unless said otherwise.

    Args:
        entrant: Its name.
        passes: Evaluations of all training windows.
        cpu_seconds: Of the process.
        train: Objective on the training frames.
        holdout: Objective on the hold-out.
        worst: The worst seed's.
        best: The best seed's.
        reached: Seeds that came to the target: near the best hold-out loss, or to what was planted.
        passes_to: Evaluations until then, of those that did; None if none.
        cpu_seconds_to: CPU-seconds until then.
        distance: From what was planted, as a share of the range; None if nothing was.
        params: Median values of what was planted.
    """

    entrant: str
    passes: float
    cpu_seconds: float
    train: float
    holdout: float
    worst: float
    best: float
    reached: int
    passes_to: float | None
    cpu_seconds_to: float | None
    distance: float | None
    params: Mapping[str, Any]


def standings(
    config: RaceConfig, problem: RaceProblem, curves: Sequence[Curve]
) -> tuple[Standing, ...]:
    """Return the entrants of a problem in their order.

    Args:
        config: The race.
        problem: One of its problems.
        curves: All fits of the race.
    """
    own = [curve for curve in curves if curve.problem == problem.name]
    names = dict.fromkeys(curve.entrant for curve in own)
    by_name = {name: [c for c in own if c.entrant == name] for name in names}
    target = target_of(own)
    return tuple(_standing(config, problem, some, target) for some in by_name.values())


def target_of(curves: Sequence[Curve]) -> float:
    """Return the hold-out loss that counts as reached on a problem.

    Args:
        curves: All fits of the problem.
    """
    names = dict.fromkeys(curve.entrant for curve in curves)
    ends = [
        statistics.median(c.points[-1].holdout for c in curves if c.entrant == name)
        for name in names
    ]
    return NEAR * min(ends)


def at(curve: Curve, key: Callable[[Point], float], where: float) -> Point | None:
    """Return the last point of a fit up to some number of passes or seconds, or None.

    Args:
        curve: The fit.
        key: What is counted.
        where: How much of it.
    """
    before = [point for point in curve.points if key(point) <= where * (1 + 1e-9)]
    return before[-1] if before else None


def median_curve(
    curves: Sequence[Curve], key: Callable[[Point], float], figure: Figure, places: Sequence[float]
) -> list[tuple[float, float, float, float]]:
    """Return place, median, least and greatest figure over the seeds.

    Args:
        curves: One entrant's fits of one problem.
        key: What is counted along: passes or seconds.
        figure: What is drawn.
        places: Where; those that not all fits have reached, or that all have passed, are left out.
    """
    last = max(key(curve.points[-1]) for curve in curves)
    found = []
    for place in places:
        points = [at(curve, key, place) for curve in curves]
        values = [value for p in points if p is not None and (value := figure(p)) is not None]
        if len(values) == len(curves) and place <= last * (1 + 1e-9):
            found.append((place, statistics.median(values), min(values), max(values)))
    return found


def _standing(
    config: RaceConfig, problem: RaceProblem, curves: Sequence[Curve], target: float
) -> Standing:
    ends = [curve.points[-1] for curve in curves]
    firsts = [_first(config, problem, curve, target) for curve in curves]
    reached = [point for point in firsts if point is not None]
    distances = [end.distance for end in ends if end.distance is not None]
    return Standing(
        entrant=curves[0].entrant,
        passes=statistics.median(end.passes for end in ends),
        cpu_seconds=statistics.median(end.cpu_seconds for end in ends),
        train=statistics.median(end.train for end in ends),
        holdout=statistics.median(end.holdout for end in ends),
        worst=max(end.holdout for end in ends),
        best=min(end.holdout for end in ends),
        reached=len(reached),
        passes_to=_median([point.passes for point in reached]),
        cpu_seconds_to=_median([point.cpu_seconds for point in reached]),
        distance=_median(distances),
        params={
            name: _middle([end.params[name] for end in ends]) for name in problem.planted or ()
        },
    )


def _first(config: RaceConfig, problem: RaceProblem, curve: Curve, target: float) -> Point | None:
    """Return the first point at the target from which the fit stays there."""
    first = None
    for point in reversed(curve.points):
        is_near = (
            point.holdout <= target
            if problem.planted is None
            else point.distance is not None and point.distance <= config.tolerance
        )
        if not is_near:
            break
        first = point
    return first


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def _middle(values: Sequence[Any]) -> Any:
    is_number = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    return statistics.median(values) if is_number else statistics.mode(values)
