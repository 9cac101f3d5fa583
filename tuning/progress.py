"""How a run tells what it is doing: one callback, so that bars and log lines live elsewhere."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

__all__ = ["Progress", "ProgressEvent", "Stage"]


@dataclass(frozen=True, kw_only=True)
class ProgressEvent:
    """One sign of life.

    Args:
        stage: "data", "gradient 1", "blackbox 2", "evaluation", "report" …: what is going on.
        done: Steps that are done.
        total: Steps of this stage.
        loss: Objective of the last step, the best of its sets.
        best: Best objective of this stage so far.
        eta: Seconds that the rest of the stage will take at the present rate.
        message: What is done next, or a warning.
    """

    stage: str
    done: int
    total: int
    loss: float | None = None
    best: float | None = None
    eta: float | None = None
    message: str = ""


class Progress(Protocol):
    """Whatever shows a run's progress."""

    def __call__(self, event: ProgressEvent) -> None:
        """Show an event; called after each step."""


class Stage:
    """Counts the steps of one stage and estimates the time that is left.

    Args:
        name: Name of the stage.
        total: Number of its steps.
        progress: Who is told, if anybody.
        done: Steps done before, by the process that was killed.
    """

    def __init__(self, name: str, total: int, progress: Progress | None, done: int = 0) -> None:
        self.name, self.total, self.progress = name, total, progress
        self._first = done
        self._began = time.monotonic()

    def step(
        self, done: int, *, loss: float | None = None, best: float | None = None, message: str = ""
    ) -> None:
        """Tell that `done` steps are done."""
        if self.progress is None:
            return
        taken = done - self._first
        elapsed = time.monotonic() - self._began
        eta = elapsed / taken * (self.total - done) if taken > 0 else None
        self.progress(
            ProgressEvent(
                stage=self.name,
                done=done,
                total=self.total,
                loss=loss,
                best=best,
                eta=eta,
                message=message,
            )
        )
