"""What a search for the front of quality against cost finds, as it stands in result.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

from pydantic import Field

from torchblur.params import Config
from tuning.config.cost import Cost

__all__ = ["Origin", "ParetoPick", "ParetoPoint", "ParetoResult", "front_of", "make_point", "pick"]

_SLACK = 1e-9  # the budget 1 pays for the filter that defines it, whatever float64 makes of it

Origin = Literal["given", "search", "polished", "sweep", "published", "start", "line"]


class ParetoPoint(Config):
    """One setting of the free parameters, its quality and its cost."""

    number: int
    """Of the trial; settings that gradient steps found go on after the last."""
    origin: Origin
    params: dict[str, Any]
    objective: float
    """On the training frames; less is better."""
    holdout: float | None = None
    """The same on the hold-out, in whole frames; of points of the front alone."""
    cost: float
    """Over that of Guertin 2014 as published, 35 taps."""
    taps: float
    lookups: float
    passes: float


class ParetoPick(Config):
    """The preset of one budget: the best setting of the front that it pays for."""

    name: str
    budget: float
    """Cost that is allowed, over that of Guertin 2014 as published."""
    number: int | None
    """Of the point; null if nothing is that cheap."""


class ParetoResult(Config):
    """All trials, the front, and what was picked from it."""

    points: tuple[ParetoPoint, ...]
    """Settings with a finite objective, in the order of their numbers."""
    front: tuple[int, ...]
    """Numbers of the points that no other one beats in both, from the cheapest to the best."""
    picks: tuple[ParetoPick, ...]
    landmarks: tuple[ParetoPoint, ...] = Field(())
    """The filter as published, the start values if those differ, and a line blur as published."""

    def point(self, number: int) -> ParetoPoint:
        """Return a point by its number."""
        return next(point for point in self.points if point.number == number)

    def picked(self) -> dict[str, ParetoPoint]:
        """Return the points of the presets that exist, by name."""
        return {p.name: self.point(p.number) for p in self.picks if p.number is not None}


def make_point(
    number: int, origin: Origin, params: Mapping[str, Any], objective: float, cost: Cost
) -> ParetoPoint:
    """Return a point from what is known of it."""
    return ParetoPoint(
        number=number,
        origin=origin,
        params=dict(params),
        objective=objective,
        cost=cost.relative,
        taps=cost.taps,
        lookups=cost.lookups,
        passes=cost.passes,
    )


def front_of(points: Iterable[ParetoPoint]) -> tuple[int, ...]:
    """Return the numbers of the points that no other one beats, from cheap to good.

    A point is beaten by one that is no worse in both and better in one; of equal points the first
    one counts.
    """
    front: list[int] = []
    best = float("inf")
    for point in sorted(points, key=lambda p: (p.cost, p.objective, p.number)):
        if point.objective < best:
            front.append(point.number)
            best = point.objective
    return tuple(front)


def pick(points: Iterable[ParetoPoint], budgets: Mapping[str, float]) -> tuple[ParetoPick, ...]:
    """Return the best point of each budget, from the lowest budget to the highest."""
    known = list(points)
    picks = []
    for name, budget in sorted(budgets.items(), key=lambda item: item[1]):
        paid = [p for p in known if p.cost <= budget * (1 + _SLACK)]
        best = min(paid, key=lambda p: (p.objective, p.cost, p.number), default=None)
        number = None if best is None else best.number
        picks.append(ParetoPick(name=name, budget=budget, number=number))
    return tuple(picks)
