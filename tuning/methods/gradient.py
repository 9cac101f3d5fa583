"""Steps along the gradient in the unit cube, from several starts.

The first start is at the start values, the second at the best of earlier methods if that is asked
for (a single start is at that best), the others are drawn from the cube. Adam moves all starts as
one batch of parameter sets; L-BFGS moves one after the other. Each step depends on the checkpoint,
the seed and the step's number alone, so that a run that was killed ends where it would have ended.
"""

from __future__ import annotations

import math
import time
from typing import Any

from tuning.files.run_folder import RunFolder
from tuning.methods.gradient_state import AdamState, FitError, GradientJob, State, scalars
from tuning.methods.lbfgs import LbfgsState
from tuning.methods.scene_pool import Pool
from tuning.objective.problem import Problem
from tuning.progress import Progress, Stage
from tuning.results.fit import MethodResult, StartResult, finite_or_none

__all__ = ["fit_gradient"]


def fit_gradient(
    problem: Problem,
    job: GradientJob,
    folder: RunFolder | None = None,
    progress: Progress | None = None,
    pool: Pool | None = None,
) -> MethodResult:
    """Fit parameters by their gradient.

    Args:
        problem: The objective.
        job: Settings, parameters, starts.
        folder: Where the log and the checkpoints go; a checkpoint that is there is gone on from.
        progress: Who is told of each step.
        pool: Has the windows of each step; those of `problem` if left out.

    Returns:
        The best start by the objective on all windows of `problem`, and all starts.

    Raises:
        FitError: no start has a finite loss.
    """
    state = LbfgsState(job) if job.method.optimizer == "lbfgs" else AdamState(job)
    stored = None if folder is None else folder.load_state(job.checkpoint)
    if stored is not None:
        state.load(stored)
    if folder is not None:
        folder.drop_records(job.index, state.step)
    problem.meter.restore(state.spent)
    stage = Stage(job.name, job.method.steps, progress, done=state.step)
    began = time.monotonic() - state.seconds
    while state.step < job.method.steps:
        record = _advance(state, problem, pool)
        state.seconds = time.monotonic() - began
        if folder is not None:
            folder.log(method=job.index, kind="gradient", **record)
            folder.save_state(job.checkpoint, state.dump())
        finite = [loss for loss in record["loss"] if loss is not None]
        stage.step(state.step, loss=min(finite), best=float(state.best_loss.min()))
    return _result(problem, job, state)


def _advance(state: State, problem: Problem, pool: Pool | None) -> dict[str, Any]:
    """Do one step, and count what it takes."""
    cpu, evaluations = time.process_time(), state.evaluations
    with problem.meter.running():
        record = state.advance(problem if pool is None else pool.at(state.step))
    record["passes"] = (state.evaluations - evaluations) * _share(state.job, problem)
    record["cpu_seconds"] = time.process_time() - cpu
    state.spent = dict(problem.meter.seconds)
    record["spent"] = {part: round(seconds, 3) for part, seconds in state.spent.items()}
    state.cpu_seconds += record["cpu_seconds"]
    return record


def _result(problem: Problem, job: GradientJob, state: State) -> MethodResult:
    """Evaluate what each start found on all windows, as it would be written to a preset."""
    # With the same windows in each step the best is known; else the last is the best.
    same = _share(job, problem) == 1 and job.method.refresh is None
    ends = state.best_unit if same else state.points
    starts = []
    for first, end, alive in zip(state.first, ends, state.alive.tolist(), strict=True):
        params = job.space.rounded(scalars(job.space, end))
        loss = float(problem.mean(dict(job.fixed) | params)) if alive else math.nan
        starts.append(
            StartResult(
                first=job.space.rounded(scalars(job.space, first)),
                params=params,
                objective=finite_or_none(loss),
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
        evaluations=state.evaluations,
        passes=state.evaluations * _share(job, problem),
        seconds=state.seconds,
        cpu_seconds=state.cpu_seconds,
        spent=state.spent,
        starts=tuple(starts),
        dropped=int((~state.alive).sum()),
    )


def _share(job: GradientJob, problem: Problem) -> float:
    """Return the share of the windows that one evaluation of a step sees."""
    batch, total = job.method.batch, len(problem.samples)
    return 1.0 if batch is None else min(batch, total) / total
