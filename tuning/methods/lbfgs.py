"""L-BFGS in the unit cube: a quasi-Newton method with a line search, each start for itself.

The objective is continued beyond the cube as what it is at the nearest point of it, and a parameter
at an end of its range whose gradient points outwards has none. So a line search that leaves the
cube goes along its face, and a point at the end of a range can stay there. After each step points
are moved back into the cube.

A checkpoint lies between two steps, never within a line search. It has the optimizer's memory, and
loss and gradient of the point where the line search ended, so that no point is evaluated twice.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tuning.methods.gradient_state import GradientJob, State, losses_and_slopes
from tuning.objective.problem import Problem

__all__ = ["LbfgsState"]

_LINE = 12  # evaluations of a line search at most
_MEMORY = 10  # steps that are remembered
_STILL = 1e-10  # least gradient that is followed, of the first
_WORSE = 10.0  # a point without a finite loss counts as so many times the first loss


class LbfgsState(State):
    """L-BFGS with a strong Wolfe line search, one optimizer for each start.

    The objective of each start is scaled so that its first gradient has the length 1 (the sum of
    its absolute values): the first step is then `learning_rate` of the ranges, all of them
    together, and tolerances mean the same for objectives of any size. A start is done when a step
    straight down its gradient makes its loss no smaller.

    Reference: Nocedal and Wright 2006, algorithms 7.5 and 3.5, as torch.optim.LBFGS has them. We
        differ: bounds.
    """

    def __init__(self, job: GradientJob) -> None:
        super().__init__(job)
        self.lines = [_Line(point, job.method.learning_rate) for point in self.first]

    @property
    def points(self) -> Tensor:
        """Where the starts are now, (K, P)."""
        return torch.stack([line.point.detach().clone() for line in self.lines])

    def dump(self) -> dict[str, Any]:
        """Return what `load` takes."""
        return super().dump() | {"lines": [line.dump() for line in self.lines]}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from what was stored."""
        super().load(state)
        for line, stored in zip(self.lines, state["lines"], strict=True):
            line.load(stored)

    def advance(self, problem: Problem) -> dict[str, Any]:
        """Do one step of each start; what is logged are losses and values after it."""
        dropped: list[int] = []
        if self.step == 0:
            dropped = self._begin(problem)
        for line, alive in zip(self.lines, self.alive.tolist(), strict=True):
            if alive:
                line.advance(problem, self)
        losses = torch.stack([line.loss for line in self.lines])
        self.keep_best(losses, self.points)
        record = self.record(losses, self.points, dropped)
        self.step += 1
        return record

    def evaluate(self, problem: Problem, point: Tensor) -> tuple[Tensor, Tensor]:
        """Return loss and gradient of one point, and count it."""
        self.evaluations += 1
        losses, slopes = losses_and_slopes(problem, self.job, point[None])
        return losses[0], slopes[0]

    def _begin(self, problem: Problem) -> list[int]:
        found = [self.evaluate(problem, point) for point in self.first]
        losses, slopes = (torch.stack(each) for each in zip(*found, strict=True))
        dropped = self.drop(losses, slopes)
        self.keep_best(losses, self.first)
        for line, loss, slope in zip(self.lines, losses, slopes, strict=True):
            line.begin(loss, slope)
        return dropped


_KNOWN = ("loss", "slope", "scale", "ceiling", "is_done")


class _Line:
    """One start: where it is, what is known there, and the optimizer.

    Args:
        point: Where it begins, (P,).
        rate: Length of the first step, as a fraction of each range.
    """

    def __init__(self, point: Tensor, rate: float) -> None:
        self.point = torch.nn.Parameter(point.clone())
        self.loss = torch.tensor(torch.inf, dtype=torch.float64)
        self.slope = torch.zeros_like(point)
        self.scale = self.ceiling = 0.0
        self.is_done = False
        self._rate = rate
        self._optimizer = self._fresh()

    def _fresh(self) -> torch.optim.LBFGS:
        return torch.optim.LBFGS(
            [self.point],
            lr=self._rate,
            max_iter=1,
            max_eval=_LINE + 1,
            tolerance_grad=_STILL,
            tolerance_change=0.0,
            history_size=_MEMORY,
            line_search_fn="strong_wolfe",
        )

    def dump(self) -> dict[str, Any]:
        """Return what `load` takes."""
        return {name: getattr(self, name) for name in _KNOWN} | {
            "point": self.point.detach(),
            "optimizer": self._optimizer.state_dict(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from what was stored."""
        for name in _KNOWN:
            setattr(self, name, state[name])
        self.point.data.copy_(state["point"])
        self._optimizer.load_state_dict(state["optimizer"])

    def begin(self, loss: Tensor, slope: Tensor) -> None:
        """Take what is known of the first point."""
        self.loss, self.slope = loss, slope
        self.ceiling = _WORSE * max(abs(float(loss)), float(slope.abs().sum()))
        self._restart()

    def advance(self, problem: Problem, state: LbfgsState) -> None:
        """Do one step: a direction, and a search along it."""
        if self.is_done:
            return
        before = self.point.detach().clone()
        known = {_mark(before): (self.loss, self.slope)}

        def closure() -> float:
            outside = self.point.detach()
            inside = outside.clamp(0, 1)
            mark = _mark(inside)
            if mark not in known:
                known[mark] = self._checked(*state.evaluate(problem, inside))
            loss, slope = known[mark]
            self.point.grad = _inwards(outside, slope) * self.scale
            return float(loss) * self.scale

        self._optimizer.step(closure)
        with torch.no_grad():
            self.point.clamp_(0, 1)
        loss, slope = known.get(_mark(self.point.detach()), (self.loss, self.slope))
        if bool(loss < self.loss):
            self.loss, self.slope = loss, slope
            self._optimizer.param_groups[0]["lr"] = 1.0
            return
        # A direction that leads nowhere: back, and down the gradient next time, if it was not that.
        self.point.data.copy_(before)
        self.is_done = self._optimizer.state_dict()["state"][0]["n_iter"] <= 1
        self._restart()

    def _restart(self) -> None:
        """Forget all directions; the next step is down the gradient, and of the first length."""
        length = float(_inwards(self.point.detach(), self.slope).abs().sum())
        self.is_done |= length == 0
        self.scale = 1 / length if length > 0 else 0.0
        self._optimizer = self._fresh()

    def _checked(self, loss: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Return a high loss, flat, where there is none: the line search goes back from there."""
        if torch.isfinite(loss) and torch.isfinite(slope).all():
            return loss, slope
        return torch.full_like(loss, self.ceiling), torch.zeros_like(slope)


def _inwards(point: Tensor, slope: Tensor) -> Tensor:
    """Return the gradient at a point, without what leads out of the cube."""
    is_held = ((point <= 0) & (slope > 0)) | ((point >= 1) & (slope < 0))
    is_outside = (point < 0) | (point > 1)
    return torch.where(is_held | is_outside, torch.zeros_like(slope), slope)


def _mark(point: Tensor) -> tuple[float, ...]:
    return tuple(point.tolist())
