"""What the next step of a gradient fit depends on: points, their best, the optimizer.

Points lie in the unit cube of the free parameters. A state can be stored and goes on from there.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.errors import TorchblurError
from tuning.config.methods import GradientMethod
from tuning.methods.job import MethodJob
from tuning.objective.problem import Problem
from tuning.objective.space import Space
from tuning.results.fit import finite_or_none

__all__ = [
    "AdamState",
    "FitError",
    "GradientJob",
    "State",
    "losses_and_slopes",
    "scalars",
    "seed_of",
]

_LAST_RATE = 0.02  # of the first: the cosine ends there
_EPSILON = 1e-14  # objectives may be of any size, and so may their gradients


class FitError(TorchblurError):
    """A fit cannot go on: no parameter set gives a finite loss."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GradientJob(MethodJob):
    """What a gradient fit works on.

    Args:
        method: Its settings.
    """

    method: GradientMethod

    @property
    def checkpoint(self) -> str:
        """Name of the checkpoint file."""
        return f"checkpoint-{self.index}.pt"


def seed_of(*parts: int) -> int:
    """Return one seed for several numbers, such as a run's seed and a step."""
    seed = 0
    for part in parts:
        seed = (seed * 1_000_003 + part + 0x9E3779B9) % (1 << 62)
    return seed


class State(ABC):
    """Everything that the next step depends on; K points of the unit cube.

    Args:
        job: Settings, parameters, starts.
    """

    def __init__(self, job: GradientJob) -> None:
        self.job = job
        self.first = _starts(job)
        count = self.first.shape[0]
        self.alive = torch.ones(count, dtype=torch.bool)
        self.best_loss = torch.full((count,), math.inf, dtype=torch.float64)
        self.best_unit = self.first.clone()
        self.step = 0
        self.evaluations = 0
        self.seconds = 0.0
        self.cpu_seconds = 0.0
        self.spent: dict[str, float] = {}

    @property
    @abstractmethod
    def points(self) -> Tensor:
        """Where the starts are now, (K, P)."""

    @abstractmethod
    def advance(self, problem: Problem) -> dict[str, Any]:
        """Do one step.

        Args:
            problem: The objective of this step.

        Returns:
            What is logged of it: number, and losses and values of all starts.

        Raises:
            FitError: no start has a finite loss.
        """

    def dump(self) -> dict[str, Any]:
        """Return what `load` takes."""
        return {name: getattr(self, name) for name in _PLAIN}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from what was stored."""
        for name in _PLAIN:
            if name in state:
                setattr(self, name, state[name])

    def keep_best(self, losses: Tensor, points: Tensor) -> None:
        """Remember the points that are better than all before them."""
        better = self.alive & (losses < self.best_loss)
        self.best_loss = torch.where(better, losses, self.best_loss)
        self.best_unit = torch.where(better[:, None], points, self.best_unit)

    def drop(self, losses: Tensor, slopes: Tensor) -> list[int]:
        """Take starts without a finite loss and gradient out; return their positions."""
        finite = torch.isfinite(losses) & torch.isfinite(slopes).all(dim=1)
        dropped = (self.alive & ~finite).nonzero().flatten().tolist()
        self.alive &= finite
        if not bool(self.alive.any()):
            values = self.job.space.from_unit(self.points)
            at = {name: value.tolist() for name, value in values.items()}
            raise FitError(
                f"{self.job.name}: no start has a finite loss at step {self.step}; losses "
                f"{losses.tolist()} at {at}"
            )
        return dropped

    def record(self, losses: Tensor, points: Tensor, dropped: list[int]) -> dict[str, Any]:
        """Return what is logged of a step."""
        values = self.job.space.from_unit(points)
        return {
            "step": self.step,
            "loss": [finite_or_none(loss) for loss in losses.tolist()],
            "params": {name: value.tolist() for name, value in values.items()},
            **({"dropped": dropped} if dropped else {}),
        }


_PLAIN = (
    "first", "alive", "best_loss", "best_unit", "step", "evaluations", "seconds", "cpu_seconds",
    "spent",
)  # fmt: skip


class AdamState(State):
    """Adam, all starts as one batch; after each step the points are moved back into the cube."""

    def __init__(self, job: GradientJob) -> None:
        super().__init__(job)
        self.unit = torch.nn.Parameter(self.first.clone())
        self.optimizer = torch.optim.Adam([self.unit], lr=job.method.learning_rate, eps=_EPSILON)

    @property
    def points(self) -> Tensor:
        """Where the starts are now, (K, P)."""
        return self.unit.detach()

    def dump(self) -> dict[str, Any]:
        """Return what `load` takes."""
        return super().dump() | {"unit": self.points, "optimizer": self.optimizer.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from what was stored."""
        super().load(state)
        self.unit.data.copy_(state["unit"])
        self.optimizer.load_state_dict(state["optimizer"])

    def advance(self, problem: Problem) -> dict[str, Any]:
        """Do one step; what is logged are losses and values before it."""
        before = self.points.clone()
        losses, slopes = losses_and_slopes(problem, self.job, before, self._chosen(problem))
        self.evaluations += len(losses)
        dropped = self.drop(losses, slopes)
        self.keep_best(losses, before)
        rate = self._rate()
        self.unit.grad = slopes
        self.optimizer.param_groups[0]["lr"] = rate
        self.optimizer.step()
        with torch.no_grad():
            self.unit.clamp_(0, 1)
            self.unit[~self.alive] = before[~self.alive]
        record = self.record(losses, before, dropped) | {"learning_rate": rate}
        self.step += 1
        return record

    def _chosen(self, problem: Problem) -> list[int] | None:
        size, available = self.job.method.batch, len(problem.samples)
        if size is None or size >= available:
            return None
        generator = torch.Generator().manual_seed(seed_of(self.job.seed, self.job.index, self.step))
        return torch.randperm(available, generator=generator)[:size].sort().values.tolist()

    def _rate(self) -> float:
        turn = 0.5 * (1 + math.cos(math.pi * self.step / self.job.method.steps))
        return self.job.method.learning_rate * (_LAST_RATE + (1 - _LAST_RATE) * turn)


def losses_and_slopes(
    problem: Problem, job: GradientJob, points: Tensor, chosen: list[int] | None = None
) -> tuple[Tensor, Tensor]:
    """Return the objective at points of the unit cube, (K,), and its gradient, (K, P), float64.

    Args:
        problem: The objective.
        job: Which parameters the points have, and the values of the others.
        points: (K, P).
        chosen: Positions of the windows that count; all if left out.
    """
    unit = points.clone().requires_grad_(True)
    count = unit.shape[0]
    total = torch.zeros(count, dtype=torch.float64)
    values = job.space.from_unit(unit)
    leaves = {name: v.detach().requires_grad_(True) for name, v in values.items()}
    fixed = dict(job.fixed)
    for part in problem.losses(fixed | leaves, count, chosen, unroll=job.method.unroll):
        total += part.detach().double().cpu()
        if part.requires_grad:
            part.sum().backward()
    # Through the scale of each parameter once, not once per window.
    grads = [_or_zero(leaf) for leaf in leaves.values()]
    torch.autograd.backward(list(values.values()), grads)
    assert unit.grad is not None
    return total, unit.grad


def _starts(job: GradientJob) -> Tensor:
    """Return the first points, (K, P): the given ones (if too many, the last), then random ones."""
    count = max(job.method.starts, 1)
    given = [job.space.to_unit(point) for point in job.first][-count:]
    generator = torch.Generator().manual_seed(seed_of(job.seed, job.index, 1 << 40))
    drawn = torch.rand(
        (count - len(given), len(job.space.names)), generator=generator, dtype=torch.float64
    )
    return torch.cat([torch.stack(given), drawn])


def scalars(space: Space, point: Tensor) -> dict[str, float]:
    """Return the values at one point of the unit cube."""
    return {name: float(value) for name, value in space.from_unit(point[None]).items()}


def _or_zero(leaf: Tensor) -> Tensor:
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
