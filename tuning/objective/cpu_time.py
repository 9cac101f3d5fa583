"""Where the CPU-seconds of a fit go: into rendering, into the filter, into the metric."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

from torch import Tensor

__all__ = ["PARTS", "Meter", "Part"]

Part = Literal["render", "filter", "metric", "other"]
PARTS: tuple[Part, ...] = ("render", "filter", "metric", "other")


class Meter:
    """A clock of this process, all threads, that knows what is being done.

    It runs inside `running` alone; outside `enter` does nothing. What goes on in other processes
    (the ranks of torchrun, the workers of a cluster) is not seen.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0)
        self._part: Part | None = None
        self._since = 0.0

    def restore(self, seconds: Mapping[str, float]) -> None:
        """Go on from what a run that was stopped had counted."""
        self.seconds = dict.fromkeys(PARTS, 0.0) | dict(seconds)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what is done inside; as "other" until something else is entered."""
        self._part, self._since = "other", time.process_time()
        try:
            yield
        finally:
            self.enter("other")
            self._part = None

    def enter(self, part: Part) -> None:
        """Count what follows to a part.

        Args:
            part: What is done from now on.
        """
        if self._part is None:
            return
        now = time.process_time()
        self.seconds[self._part] += now - self._since
        self._part, self._since = part, now

    def on_the_way_back(self, tensor: Tensor, part: Part) -> None:
        """Count the backward pass to a part from where it has come to a tensor.

        Args:
            tensor: Anything; one without a gradient changes nothing.
            part: What made it.
        """
        if tensor.requires_grad and self._part is not None:
            tensor.register_hook(lambda _: self.enter(part))
