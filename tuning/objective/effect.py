"""Which free parameters change nothing on the windows of a fit: found before it begins."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tuning.objective.problem import Problem
from tuning.objective.space import FreeParameter, Space
from tuning.progress import Progress, Stage

__all__ = ["without_effect"]


def without_effect(
    problem: Problem, space: Space, progress: Progress | None = None
) -> tuple[str, ...]:
    """Return the parameters that change the objective of no window, whatever their value.

    Each is set to the ends of its range, or to each choice, with all others at their start. One
    window usually tells; only what changes nothing is tried on all of them.

    Args:
        problem: The objective.
        space: The parameters.
        progress: Called after each parameter that is found to act.
    """
    stage = Stage("what acts", len(space.parameters), progress)
    start = space.start()
    sets = {p.name: [start | {p.name: value} for value in _others(p)] for p in space.parameters}
    waiting = list(sets)
    for place in range(len(problem.samples)):
        if not waiting:
            break
        here = float(problem.each(start, 1, [place]))
        for name in tuple(waiting):
            if any(float(problem.each(values, 1, [place])) != here for values in sets[name]):
                waiting.remove(name)
                stage.step(len(sets) - len(waiting), message=name)
    return tuple(waiting)


def _others(parameter: FreeParameter) -> Iterator[Any]:
    ends: tuple[Any, ...] = parameter.choices
    if not ends:
        ends = parameter.spec.bounds
        ends = tuple(map(round, ends)) if parameter.is_integer else ends
    yield from (value for value in ends if value != parameter.start)
