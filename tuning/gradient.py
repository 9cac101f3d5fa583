"""Adam in the unit cube, all starts as one batch of parameter sets.

The first start is at the start values, the second at the best of earlier methods if that is asked
for (a single start is at that best), the others are drawn from the cube. After each step the points
are moved back into the cube. Each step depends on the checkpoint, the seed and the step's number
alone, so that a run that was killed ends where it would have ended.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur.errors import TorchblurError
from tuning.config import GradientMethod
from tuning.job import MethodJob
from tuning.problem import Problem
from tuning.progress import Progress, Stage
from tuning.result import MethodResult, StartResult
from tuning.runfolder import RunFolder
from tuning.space import Space

__all__ = ["FitError", "GradientJob", "fit_gradient", "seed_of"]

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


def fit_gradient(
    problem: Problem,
    job: GradientJob,
    folder: RunFolder | None = None,
    progress: Progress | None = None,
) -> MethodResult:
    """Fit parameters by their gradient.

    Args:
        problem: The objective.
        job: Settings, parameters, starts.
        folder: Where the log and the checkpoints go; a checkpoint that is there is gone on from.
        progress: Who is told of each step.

    Returns:
        The best start by the objective on all windows, and all starts.

    Raises:
        FitError: no start has a finite loss.
    """
    state = _State(job)
    stored = None if folder is None else folder.load_state(job.checkpoint)
    if stored is not None:
        state.load(stored)
    if folder is not None:
        folder.drop_records(job.index, state.step)
    stage = Stage(job.name, job.method.steps, progress, done=state.step)
    began = time.monotonic() - state.seconds
    while state.step < job.method.steps:
        cpu = time.process_time()
        record = state.advance(problem)
        record["passes"] = len(record["loss"]) * _share(job.method.batch, len(problem.samples))
        record["cpu_seconds"] = time.process_time() - cpu
        state.cpu_seconds += record["cpu_seconds"]
        state.seconds = time.monotonic() - began
        if folder is not None:
            folder.log(method=job.index, kind="gradient", **record)
            folder.save_state(job.checkpoint, state.dump())
        finite = [loss for loss in record["loss"] if loss is not None]
        stage.step(state.step, loss=min(finite), best=float(state.best_loss.min()))
    return _result(problem, job, state)


def seed_of(*parts: int) -> int:
    """Return one seed for several numbers, such as a run's seed and a step."""
    seed = 0
    for part in parts:
        seed = (seed * 1_000_003 + part + 0x9E3779B9) % (1 << 62)
    return seed


class _State:
    """Everything that the next step depends on; (K, P) points of the unit cube."""

    def __init__(self, job: GradientJob) -> None:
        self.job = job
        self.unit = torch.nn.Parameter(_starts(job))
        self.first = self.unit.detach().clone()
        self.optimizer = torch.optim.Adam([self.unit], lr=job.method.learning_rate, eps=_EPSILON)
        self.alive = torch.ones(self.unit.shape[0], dtype=torch.bool)
        self.best_loss = torch.full((self.unit.shape[0],), math.inf, dtype=torch.float64)
        self.best_unit = self.first.clone()
        self.step = 0
        self.seconds = 0.0
        self.cpu_seconds = 0.0

    def dump(self) -> dict[str, Any]:
        names = ("first", "alive", "best_loss", "best_unit", "step", "seconds", "cpu_seconds")
        state = {name: getattr(self, name) for name in names}
        return state | {"unit": self.unit.detach(), "optimizer": self.optimizer.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            if name == "unit":
                self.unit.data.copy_(value)
            elif name == "optimizer":
                self.optimizer.load_state_dict(value)
            else:
                setattr(self, name, value)

    def advance(self, problem: Problem) -> dict[str, Any]:
        """Do one step; return what is logged of it: losses and values before the step."""
        before = self.unit.detach().clone()
        losses = self._losses_and_gradient(problem)
        dropped = self._drop(losses)
        better = self.alive & (losses < self.best_loss)
        self.best_loss = torch.where(better, losses, self.best_loss)
        self.best_unit = torch.where(better[:, None], before, self.best_unit)
        rate = self._rate()
        self.optimizer.param_groups[0]["lr"] = rate
        self.optimizer.step()
        with torch.no_grad():
            self.unit.clamp_(0, 1)
            self.unit[~self.alive] = before[~self.alive]
        self.step += 1
        values = self.job.space.from_unit(before)
        return {
            "step": self.step - 1,
            "loss": [_finite_or_none(loss) for loss in losses.tolist()],
            "params": {name: value.tolist() for name, value in values.items()},
            "learning_rate": rate,
            **({"dropped": dropped} if dropped else {}),
        }

    def _losses_and_gradient(self, problem: Problem) -> Tensor:
        self.optimizer.zero_grad()
        count = self.unit.shape[0]
        total = torch.zeros(count, dtype=torch.float64)
        values = self.job.space.from_unit(self.unit)
        leaves = {name: v.detach().requires_grad_(True) for name, v in values.items()}
        fixed = dict(self.job.fixed)
        chosen, unroll = self._chosen(problem), self.job.method.unroll
        for part in problem.losses(fixed | leaves, count, chosen, unroll=unroll):
            total += part.detach().double().cpu()
            if part.requires_grad:
                part.sum().backward()
        # Through the scale of each parameter once, not once per window.
        grads = [_or_zero(leaf) for leaf in leaves.values()]
        torch.autograd.backward(list(values.values()), grads)
        return total

    def _chosen(self, problem: Problem) -> list[int] | None:
        size, available = self.job.method.batch, len(problem.samples)
        if size is None or size >= available:
            return None
        generator = torch.Generator().manual_seed(seed_of(self.job.seed, self.job.index, self.step))
        return torch.randperm(available, generator=generator)[:size].sort().values.tolist()

    def _drop(self, losses: Tensor) -> list[int]:
        """Take starts without a finite loss and gradient out; return their positions."""
        grad = self.unit.grad
        assert grad is not None
        finite = torch.isfinite(losses) & torch.isfinite(grad).all(dim=1)
        dropped = (self.alive & ~finite).nonzero().flatten().tolist()
        self.alive &= finite
        if not bool(self.alive.any()):
            values = self.job.space.from_unit(self.unit.detach())
            at = {name: value.tolist() for name, value in values.items()}
            raise FitError(
                f"{self.job.name}: no start has a finite loss at step {self.step}; losses "
                f"{losses.tolist()} at {at}"
            )
        return dropped

    def _rate(self) -> float:
        turn = 0.5 * (1 + math.cos(math.pi * self.step / self.job.method.steps))
        return self.job.method.learning_rate * (_LAST_RATE + (1 - _LAST_RATE) * turn)


def _starts(job: GradientJob) -> Tensor:
    """Return the first points, (K, P): the given ones (if too many, the last), then random ones."""
    count = max(job.method.starts, 1)
    given = [job.space.to_unit(point) for point in job.first][-count:]
    generator = torch.Generator().manual_seed(seed_of(job.seed, job.index, 1 << 40))
    drawn = torch.rand(
        (count - len(given), len(job.space.names)), generator=generator, dtype=torch.float64
    )
    return torch.cat([torch.stack(given), drawn])


def _result(problem: Problem, job: GradientJob, state: _State) -> MethodResult:
    """Evaluate what each start found on all windows, as it would be written to a preset."""
    # With all windows in each step the best is known; with some of them the last is the best.
    sampled = job.method.batch is not None and job.method.batch < len(problem.samples)
    ends = state.unit.detach() if sampled else state.best_unit
    starts = []
    for first, end, alive in zip(state.first, ends, state.alive.tolist(), strict=True):
        params = job.space.rounded(_scalars(job.space, end))
        loss = float(problem.mean(dict(job.fixed) | params)) if alive else math.nan
        starts.append(
            StartResult(
                first=job.space.rounded(_scalars(job.space, first)),
                params=params,
                objective=_finite_or_none(loss),
            )
        )
    scored = [(s.objective, i) for i, s in enumerate(starts) if s.objective is not None]
    if not scored:
        raise FitError(f"{job.name}: no start has a finite loss on all training frames")
    objective, best = min(scored)
    return MethodResult(
        name=job.name,
        kind="gradient",
        params=dict(job.fixed) | starts[best].params,
        objective=objective,
        evaluations=state.step * len(starts),
        passes=state.step * len(starts) * _share(job.method.batch, len(problem.samples)),
        seconds=state.seconds,
        cpu_seconds=state.cpu_seconds,
        starts=tuple(starts),
        dropped=int((~state.alive).sum()),
    )


def _share(batch: int | None, total: int) -> float:
    return 1.0 if batch is None else min(batch, total) / total


def _scalars(space: Space, point: Tensor) -> dict[str, float]:
    return {name: float(value) for name, value in space.from_unit(point[None]).items()}


def _or_zero(leaf: Tensor) -> Tensor:
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
