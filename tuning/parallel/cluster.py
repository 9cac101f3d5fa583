"""Independent tasks on the workers of a Dask cluster.

A task is a function of this package and an item, both of which are pickled. Workers need the same
version of torchblur, and the same files under the same absolute paths. A task whose worker dies is
given to another one. Dask is imported where it is used alone: it comes with the extra `cluster`.
"""

from __future__ import annotations

import asyncio
import logging
import queue
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch

from torchblur.errors import TorchblurError
from tuning.parallel.cores import count_cores

if TYPE_CHECKING:
    import distributed

__all__ = ["Cluster", "ClusterError", "Flight", "Lost", "here", "open_cluster", "share_cores"]

_RETRIES = 2  # of a task that raises; one whose worker dies is limited by Dask's allowed-failures
_POLL = 2.0  # seconds between looks at whether there are workers
_CONNECT = 15.0  # seconds

T = TypeVar("T")
R = TypeVar("R")


class ClusterError(TorchblurError):
    """The scheduler, a worker or another process of a run is not there or not as it must be."""


@dataclass(frozen=True)
class Lost:
    """Stands for the result of a task that took several workers down with it."""

    reason: str


@contextmanager
def open_cluster(
    scheduler: str | None = None, *, workers: int | None = None, patience: float = 60.0
) -> Iterator[Cluster]:
    """Connect to a Dask scheduler, or start workers on this machine.

    Args:
        scheduler: Its address, such as "tcp://host:8786".
        workers: In its place, so many processes on this machine; the cores are shared out.
        patience: So many seconds a run waits while there is no worker at all.

    Yields:
        The cluster; what was started here ends with the block.

    Raises:
        ClusterError: Dask is not installed, or no scheduler or worker answers.
    """
    if scheduler is not None and workers is not None:
        raise ClusterError(
            f"give the address of a scheduler or a number of workers to start, got both: "
            f"{scheduler} and {workers}"
        )
    dask = _load_dask()
    local: Any = None if scheduler else _start_local(dask, workers or 1)
    try:
        client = _connect(dask, scheduler or local.scheduler_address)
        try:
            cluster = Cluster(client, patience)
            cluster.wait_for_workers()
            yield cluster
        finally:
            client.close(timeout=_CONNECT)
    finally:
        if local is not None:
            local.close(timeout=_CONNECT)


class Cluster:
    """Workers that take tasks.

    Args:
        client: A connection to the scheduler.
        patience: So many seconds a run waits while there is no worker at all.
    """

    def __init__(self, client: distributed.Client, patience: float = 60.0) -> None:
        self.client, self.patience = client, patience

    @property
    def width(self) -> int:
        """How many tasks are worked on at a time; 0 while there is no worker."""
        if self.client.status != "running":
            raise ClusterError(f"the scheduler at {self.address} is gone")
        return sum(self.client.nthreads().values())

    @property
    def is_alive(self) -> bool:
        """Whether the scheduler answers and has a worker."""
        return self.client.status == "running" and bool(self.client.nthreads())

    def start(self, function: Callable[[T], R], items: Iterable[T]) -> Flight[T, R]:
        """Begin to work on items.

        Args:
            function: A function of a module, or a `functools.partial` of one.
            items: What it is called with; they must not depend on each other.

        Returns:
            An iterator of (position, result) in the order in which the tasks end.
        """
        return Flight(self, function, items)

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """Return the function's results in the order of the items, whatever order they end in.

        Args:
            function: A function of a module, or a `functools.partial` of one.
            items: What it is called with; they must not depend on each other.

        Raises:
            ClusterError: the scheduler is gone, there are no workers, or a task takes one worker
                after the other down.
            TorchblurError: what the function raises.
        """
        found: dict[int, R] = {}
        for position, result in self.start(function, items):
            if isinstance(result, Lost):
                raise ClusterError(f"task {position}: {result.reason}")
            found[position] = result
        return [found[position] for position in sorted(found)]

    def wait_for_workers(self) -> None:
        """Wait until there is a worker.

        Raises:
            ClusterError: none within `patience`, or the scheduler is gone.
        """
        if self.client.status == "running":
            try:
                self.client.wait_for_workers(1, timeout=self.patience)
                return
            except TimeoutError as error:
                raise ClusterError(
                    f"no worker has joined {self.address} for {self.patience:g} s; start some with "
                    f"`dask worker {self.address}`"
                ) from error
        raise ClusterError(f"the scheduler at {self.address} is gone")

    @property
    def address(self) -> str:
        """Where the scheduler is."""
        return str(self.client.scheduler.address) if self.client.scheduler else "?"


class Flight(Generic[T, R]):
    """Tasks under way: an iterator of (position, result or `Lost`) in the order of their ends.

    No more of them are sent than keep all workers busy, so that a run can be stopped.

    Args:
        cluster: Where they go.
        function: What is called.
        items: With what.
    """

    def __init__(self, cluster: Cluster, function: Callable[[T], R], items: Iterable[T]) -> None:
        self._cluster, self._function = cluster, function
        self._waiting = deque(enumerate(items))
        self._flying: dict[distributed.Future[Any], int] = {}
        self._ended: queue.SimpleQueue[distributed.Future[Any]] = queue.SimpleQueue()

    def __iter__(self) -> Iterator[tuple[int, R | Lost]]:
        return self

    def __next__(self) -> tuple[int, R | Lost]:
        self._launch()
        if not self._flying:
            raise StopIteration
        future = self._next_ended()
        result = _result_of(future, self._cluster)
        return self._flying.pop(future), result

    def stop(self) -> int:
        """Send nothing more and take back what no worker has begun; return how many are left."""
        self._waiting.clear()
        for future in list(self._flying)[max(1, self._cluster.width) :]:
            del self._flying[future]
            future.cancel()
        return len(self._flying)

    def drop(self) -> None:
        """Forget all tasks."""
        self._waiting.clear()
        self._cluster.client.cancel(list(self._flying))
        self._flying.clear()

    def _launch(self) -> None:
        if not self._waiting:
            return
        # One task waits at the scheduler while there is no worker.
        room = max(1, 2 * self._cluster.width) - len(self._flying)
        while self._waiting and room > 0:
            position, item = self._waiting.popleft()
            future = self._cluster.client.submit(self._function, item, pure=False, retries=_RETRIES)
            self._flying[future] = position
            future.add_done_callback(self._ended.put)
            room -= 1

    def _next_ended(self) -> distributed.Future[Any]:
        while True:
            try:
                future = self._ended.get(timeout=_POLL)
            except queue.Empty:
                for future in self._flying:
                    if future.done():  # its note was lost to a Ctrl-C
                        return future
                if not self._cluster.is_alive:
                    self._cluster.wait_for_workers()
            else:
                if future in self._flying:
                    return future


def here() -> str:
    """Return the address of the worker that runs this task."""
    return str(_load_dask().get_worker().address)


def share_cores() -> None:
    """Let torch use this task's share of its worker's cores: all of them by its threads."""
    worker = _load_dask().get_worker()
    share = max(1, count_cores() // worker.state.nthreads)
    if torch.get_num_threads() > share:
        torch.set_num_threads(share)


def _result_of(future: distributed.Future[Any], cluster: Cluster) -> Any:
    if future.status == "finished":
        return future.result()
    if future.status != "error":
        raise ClusterError(f"the scheduler at {cluster.address} is gone, or dropped the run")
    error = future.exception()
    if isinstance(error, _load_dask().scheduler.KilledWorker):
        return Lost(
            f"{error.allowed_failures + 1} workers died of it, the last {error.last_worker.address}"
        )
    if isinstance(error, TorchblurError):
        raise error
    if isinstance(error, ModuleNotFoundError):
        raise ClusterError(
            f"a worker lacks the package `{error.name}`; install the same torchblur there as here, "
            "with the extras `tune` and `cluster`"
        ) from error
    raise ClusterError(f"a task failed on a worker: {type(error).__name__}: {error}") from error


def _connect(dask: Any, scheduler: str) -> distributed.Client:
    try:
        # A client that finds nobody cannot be closed without a long wait.
        asyncio.run(_knock(dask, scheduler))
        client: distributed.Client = dask.Client(scheduler, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"no Dask scheduler answers at {scheduler!r} ({error}); `dask scheduler` starts one "
            "and prints its address, such as tcp://host:8786"
        ) from error
    return client


async def _knock(dask: Any, scheduler: str) -> None:
    security = dask.Security().get_connection_args("client")
    connection = await dask.comm.connect(scheduler, timeout=_CONNECT, **security)
    await connection.close()


def _start_local(dask: Any, workers: int) -> Any:
    threads = str(max(1, count_cores() // workers))
    return dask.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.ERROR,
        env={name: threads for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")},
    )


def _load_dask() -> Any:
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise ClusterError(
            f"a cluster needs the package `{error.name}`, which is not installed; install it with: "
            "pip install 'torchblur[cluster]'"
        ) from error
    return distributed
