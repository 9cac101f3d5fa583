"""An objective whose windows are split between processes; each process adds up its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from tuning.objective.problem import Problem

__all__ = ["Crew", "Request", "Shard", "ShardedProblem"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """What all ranks do next, each on its share of the windows.

    Args:
        kind: "sum": weighted sum of the objective over windows, and its gradient; "each": the
            objective of each window.
        values: Parameter sets, tensors on the CPU.
        count: Number of sets, K.
        positions: The windows that count, n.
        is_whole: Whether the same windows will be asked for again.
        slopes: Names of the values whose gradient is wanted.
        weights: Of each window for each set, (n, K); None for the mean.
        unroll: As `Problem.losses` takes it.
        crop: As `Problem.subset` takes it.
    """

    kind: Literal["sum", "each"]
    values: Mapping[str, Any]
    count: int
    positions: tuple[int, ...]
    is_whole: bool
    slopes: tuple[str, ...] = ()
    weights: Tensor | None = None
    unroll: int | None = None
    crop: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the answer: windows, or the sum and each slope, by sets."""
        rows = len(self.positions) if self.kind == "each" else 1 + len(self.slopes)
        return rows, self.count


class Crew(Protocol):
    """Whoever does requests."""

    def ask(self, request: Request) -> Tensor:
        """Return the sum of the answers of all ranks."""


class Shard:
    """One rank's share of the work: every n-th of the windows that are asked for.

    Args:
        problem: The objective, with all windows.
        rank: Position of this rank.
        count: Number of ranks.
    """

    def __init__(self, problem: Problem, rank: int, count: int) -> None:
        # The cost of a filter is no window's; rank 0 adds it once.
        objective = problem.objective.model_copy(update={"cost": 0.0})
        self._problem = Problem(problem.blur, problem.samples, objective, problem.free)
        self._rank, self._count = rank, count
        self._subsets: dict[tuple[tuple[int, ...], float | None], Problem] = {}

    def answer(self, request: Request) -> Tensor:
        """Return this rank's part of the sum that answers a request, float64, on the CPU."""
        found = torch.zeros(request.shape, dtype=torch.float64)
        places = list(range(self._rank, len(request.positions), self._count))
        if not places:
            return found
        problem, chosen = self._windows(request, places)
        if request.kind == "each":
            found[places] = problem.each(request.values, request.count, chosen)
            return found
        weights = None if request.weights is None else request.weights[places]
        leaves = {name: request.values[name].clone() for name in request.slopes}
        with torch.set_grad_enabled(bool(leaves)):
            for leaf in leaves.values():
                leaf.requires_grad_(True)
            values = dict(request.values) | leaves
            parts = problem.weighted(values, request.count, weights, chosen, unroll=request.unroll)
            for part in parts:
                found[0] += part.detach().double().cpu()
                if part.requires_grad:
                    part.sum().backward()
        for row, leaf in enumerate(leaves.values(), start=1):
            if leaf.grad is not None:
                found[row] = leaf.grad.double().view(-1)
        # A mean over these windows, as a part of the mean over all.
        return found * (len(places) / len(request.positions)) if weights is None else found

    def _windows(
        self, request: Request, places: Sequence[int]
    ) -> tuple[Problem, Sequence[int] | None]:
        """Return what is asked, and of which windows: those that come again are joined."""
        mine = tuple(request.positions[place] for place in places)
        if request.crop is None and (request.count > 1 or not request.is_whole):
            return self._problem, mine
        if (mine, request.crop) not in self._subsets:
            self._subsets[mine, request.crop] = self._problem.subset(mine, request.crop)
        windows = None if request.count == 1 else range(len(mine))
        return self._subsets[mine, request.crop], windows


class ShardedProblem(Problem):
    """The objective as rank 0 sees it: what it is asked for, all ranks do together.

    Values and gradients are those of one process but for rounding: windows are added up in
    another order.

    Args:
        problem: The objective, with all windows.
        crew: The ranks.
        chosen: Positions of the windows that count; all if left out.
        crop: As `Problem.subset` takes it.
    """

    def __init__(
        self,
        problem: Problem,
        crew: Crew,
        chosen: Sequence[int] | None = None,
        crop: float | None = None,
    ) -> None:
        self._positions = tuple(range(len(problem.samples)) if chosen is None else chosen)
        samples = problem.subset(self._positions, crop).samples
        super().__init__(problem.blur, samples, problem.objective, problem.free)
        self._whole, self._crew, self._crop = problem, crew, crop

    def subset(self, chosen: Sequence[int], crop: float | None = None) -> ShardedProblem:
        """Return the objective of some of the windows, split between the same ranks."""
        assert self._crop is None  # a part has no parts
        positions = [self._positions[i] for i in chosen]
        return ShardedProblem(self._whole, self._crew, positions, crop)

    def weighted(
        self,
        values: Mapping[str, Any],
        count: int,
        weights: Tensor | None,
        chosen: Sequence[int] | None = None,
        *,
        unroll: int | None = None,
    ) -> Iterator[Tensor]:
        """Yield the sum of weight times objective over windows, (K,), in one part."""
        leaves = {
            name: value
            for name, value in values.items()
            if isinstance(value, Tensor) and value.requires_grad and torch.is_grad_enabled()
        }
        more: dict[str, Any] = {"weights": weights, "unroll": unroll, "slopes": tuple(leaves)}
        found = self._crew.ask(self._request("sum", values, count, chosen, **more))
        if leaves:
            known: Any = _Known.apply
            yield known(found[0], found[1:], *leaves.values())
        else:
            yield found[0]
        if self.objective.cost > 0:
            yield torch.full((count,), self._cost(values), dtype=torch.float64)

    @torch.no_grad()
    def each(
        self, values: Mapping[str, Any], count: int = 1, chosen: Sequence[int] | None = None
    ) -> Tensor:
        """Return the objective of each window for K parameter sets, (n, K), float64, on the CPU."""
        found = self._crew.ask(self._request("each", values, count, chosen))
        return found + self._cost(values)

    def _request(
        self,
        kind: Literal["sum", "each"],
        values: Mapping[str, Any],
        count: int,
        chosen: Sequence[int] | None,
        **more: Any,
    ) -> Request:
        plain = {n: v.detach().cpu() if isinstance(v, Tensor) else v for n, v in values.items()}
        positions = self._positions
        return Request(
            kind=kind,
            values=plain,
            count=count,
            positions=positions if chosen is None else tuple(positions[i] for i in chosen),
            is_whole=chosen is None,
            crop=self._crop,
            **more,
        )


class _Known(torch.autograd.Function):
    """A value whose gradient was computed elsewhere: row k of each input acts on loss k alone."""

    @staticmethod
    def forward(ctx: Any, losses: Tensor, slopes: Tensor, *inputs: Tensor) -> Tensor:
        ctx.save_for_backward(slopes)
        ctx.like = [(each.shape, each.dtype, each.device) for each in inputs]
        return losses.clone()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        (slopes,), (grad,) = ctx.saved_tensors, grad_outputs
        return (
            None,
            None,
            *(
                (row * grad).view(shape).to(device, dtype)
                for row, (shape, dtype, device) in zip(slopes, ctx.like, strict=True)
            ),
        )
