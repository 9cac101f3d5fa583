"""The objective of a fit on the workers of a cluster.

A worker builds the objective once from the configuration, which is a few lines of text, and keeps
it. The driver draws and judges; so what a run finds does not depend on the number of workers, nor
on the order in which they are done.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from torchblur.errors import TorchblurError
from torchblur.params import build
from tuning.config.fit import TuneConfig
from tuning.objective.prepare import fingerprint, is_same_data, prepare
from tuning.objective.problem import Problem
from tuning.parallel.cluster import Cluster, ClusterError, here, share_cores

__all__ = ["ClusterProblem"]

_KEPT = 2  # objectives that a worker keeps: the windows of a run may be large

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class _Order:
    """What a worker needs to build an objective.

    Args:
        config: The resolved configuration as JSON.
        windows: Fingerprint of the driver's windows.
        chosen: Positions of the windows that count; all if None.
        crop: Edge of the part of each of them that counts; all of it if None.
    """

    config: str
    windows: tuple[tuple[int, int, float], ...]
    chosen: tuple[int, ...] | None = None
    crop: float | None = None

    @property
    def key(self) -> str:
        """Hash of the configuration and the data."""
        return hashlib.sha256(f"{self.config} {self.windows}".encode()).hexdigest()


class ClusterProblem(Problem):
    """An objective whose `map` goes to workers; all else is done here.

    Args:
        cluster: The workers.
        config: The resolved configuration that it was made of.
        problem: The objective.
        chosen: Positions of the windows that count; all if left out.
        crop: As `Problem.subset` takes it.
    """

    def __init__(
        self,
        cluster: Cluster,
        config: TuneConfig,
        problem: Problem,
        chosen: Sequence[int] | None = None,
        crop: float | None = None,
    ) -> None:
        part = problem if chosen is None else problem.subset(chosen, crop)
        super().__init__(problem.blur, part.samples, problem.objective, problem.free)
        self._config, self._whole, self._cluster = config, problem, cluster
        self._order = _Order(
            config=json.dumps(config.model_dump(mode="json"), sort_keys=True),
            windows=fingerprint(problem),
            chosen=None if chosen is None else tuple(chosen),
            crop=crop,
        )

    def subset(self, chosen: Sequence[int], crop: float | None = None) -> ClusterProblem:
        """Return the objective of some of the windows, on the same workers."""
        assert self._order.crop is None  # a part has no parts
        known = self._order.chosen
        positions = chosen if known is None else [known[i] for i in chosen]
        return ClusterProblem(self._cluster, self._config, self._whole, positions, crop)

    def map(self, function: Callable[[Problem, T], R], items: Sequence[T]) -> list[R]:
        """Return `function(problem, item)` for each item, in order; workers call it.

        Raises:
            ClusterError: a worker cannot build the objective or has other data; no workers.
        """
        return self._cluster.map(partial(_work, self._order, function), items)


# -- on a worker -------------------------------------------------------------------------------


_Part = tuple[tuple[int, ...] | None, float | None]  # positions of windows, edge of each part
_BUILT: OrderedDict[str, dict[_Part, Problem]] = OrderedDict()
_BUILDING, _COMPILED = threading.Lock(), threading.Lock()


def _work(order: _Order, function: Callable[[Problem, T], R], item: T) -> R:
    share_cores()
    problem = _problem_of(order)
    # torch.compile is not made for several threads.
    with _COMPILED if problem.blur.engine == "compiled" else nullcontext():
        return function(problem, item)


def _problem_of(order: _Order) -> Problem:
    with _BUILDING:
        found = _BUILT.get(order.key)
        if found is None:
            found = _BUILT[order.key] = {(None, None): _build(order)}
        _BUILT.move_to_end(order.key)
        while len(_BUILT) > _KEPT:
            _BUILT.popitem(last=False)
        part = (order.chosen, order.crop)
        if order.chosen is not None and part not in found:
            found[part] = found[None, None].subset(order.chosen, order.crop)
        return found[part]


def _build(order: _Order) -> Problem:
    config: Any = build(TuneConfig, json.loads(order.config), "the driver's configuration")
    try:
        problem = prepare(config).problem
    except (TorchblurError, OSError) as error:
        raise ClusterError(
            f"the worker at {here()} cannot load the data: {error}; workers need the same files "
            "under the same paths"
        ) from error
    if not is_same_data(fingerprint(problem), order.windows):
        raise ClusterError(
            f"the worker at {here()} has other data under {config.data.root} than the driver; "
            "workers need the same files under the same paths, and the same version of torchblur"
        )
    return problem
