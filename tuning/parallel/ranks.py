"""The processes that torchrun starts for one fit: rank 0 drives, the others filter their windows.

Rank 0 alone has the optimizer, the studies and the run folder. Each request goes out to all ranks,
each works on its share of the windows, and the sums come back. So nothing can drift apart, and a
run goes on from the checkpoint of rank 0, with any number of ranks.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from torchblur.errors import TorchblurError
from torchblur.params import build
from tuning.config.fit import TuneConfig
from tuning.objective.prepare import fingerprint, is_same_data, prepare
from tuning.objective.problem import Problem
from tuning.parallel.cluster import ClusterError
from tuning.parallel.sharded_problem import Request, Shard, ShardedProblem
from tuning.results.fit import FitResult

__all__ = ["RankZeroStoppedError", "Ranks", "is_restarted", "join_ranks", "rank_here"]

_LONG = timedelta(days=30)  # others wait while rank 0 searches; a dead process is noticed at once
_MEETING = timedelta(minutes=10)
_CPU = torch.device("cpu")


class RankZeroStoppedError(ClusterError):
    """Rank 0 has stopped; it tells why itself."""


def rank_here() -> int:
    """Return this process's rank; 0 if it is alone."""
    return int(os.environ["RANK"]) if _is_one_of_many() else 0


def is_restarted() -> bool:
    """Return whether torchrun has started the ranks anew after one of them failed."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")) > 0


@contextmanager
def join_ranks(device: str) -> Iterator[Ranks | None]:
    """Join the other processes of this run; None if this one is alone.

    Args:
        device: As the configuration names it; a rank that has a GPU of its own uses it for "auto"
            and "cuda".

    Raises:
        ClusterError: the others do not answer.
    """
    if not _is_one_of_many():
        yield None
        return
    own_gpu = _take_gpu(device)
    with _clear_end():
        _meet("cpu:gloo,cuda:nccl" if own_gpu else "cpu:gloo")
    ranks = Ranks(torch.device("cuda", torch.cuda.current_device()) if own_gpu else _CPU)
    try:
        yield ranks
    except Exception:
        ranks.dismiss(None)
        raise
    finally:
        dist.destroy_process_group()


class Ranks:
    """This process among the others.

    Args:
        meeting: Where sums are made: with gloo on the CPU, with nccl on a GPU.
    """

    def __init__(self, meeting: torch.device) -> None:
        self.rank, self.count, self._meeting = dist.get_rank(), dist.get_world_size(), meeting
        self._shard: Shard | None = None
        self._dismissed = False

    # -- rank 0 --------------------------------------------------------------------------------

    def share(self, config: TuneConfig, problem: Problem) -> ShardedProblem:
        """Have all ranks build an objective; return it, with its windows split between them.

        Args:
            config: The resolved configuration.
            problem: The objective that it makes.

        Raises:
            ClusterError: a rank cannot load the data, or has other data.
        """
        text = json.dumps(config.model_dump(mode="json"))
        self._send(("prepare", (text, fingerprint(problem))))
        self._refuse_failed("")
        self._shard = Shard(problem, self.rank, self.count)
        return ShardedProblem(problem, self)

    def ask(self, request: Request) -> Tensor:
        """Return the sum over all ranks of what they answer, float64, on the CPU.

        Args:
            request: What is wanted.
        """
        self._send(("work", request))
        return self._answer(request)

    def dismiss(self, result: FitResult | None) -> None:
        """Let the other ranks end.

        Args:
            result: What they return; None if there is no result.
        """
        if self.rank == 0 and not self._dismissed:
            self._dismissed = True
            text = None if result is None else result.model_dump_json()
            try:
                self._send(("end", text))
            except ClusterError:  # a rank that is gone needs no dismissal
                return

    # -- other ranks ---------------------------------------------------------------------------

    def follow(self) -> FitResult:
        """Answer rank 0 until it is done; return its result.

        Raises:
            RankZeroStoppedError: it has none.
            ClusterError: it is gone.
        """
        while True:
            kind, content = self._receive()
            if kind == "end":
                if content is None:
                    raise RankZeroStoppedError("rank 0 has stopped")
                return FitResult.model_validate_json(content)
            if kind == "prepare":
                self._prepare(*content)
            else:
                self._answer(content)

    def _prepare(self, text: str, windows: Any) -> None:
        complaint = ""
        try:
            config: Any = build(TuneConfig, json.loads(text), "the configuration of rank 0")
            problem = prepare(config).problem
            if not is_same_data(fingerprint(problem), windows):
                complaint = f"other data under {config.data.root} than rank 0 has"
            self._shard = Shard(problem, self.rank, self.count)
        except (TorchblurError, OSError) as error:
            complaint = str(error)
        advice = "all ranks need the same files under the same paths, and the same torchblur"
        self._refuse_failed(f"{complaint}; {advice}" if complaint else "")

    # -- all -----------------------------------------------------------------------------------

    def _answer(self, request: Request) -> Tensor:
        """Do this rank's share and add it to the others'; the last number counts failures."""
        complaint, flat = "", torch.zeros(math.prod(request.shape) + 1, dtype=torch.float64)
        try:
            assert self._shard is not None
            flat[:-1] = self._shard.answer(request).flatten()
        except Exception as error:  # told to all ranks, and then raised by all
            complaint, flat[-1] = f"{type(error).__name__}: {error}", 1.0
        with _clear_end():
            flat = flat.to(self._meeting)
            dist.all_reduce(flat)
            flat = flat.cpu()
        if float(flat[-1]) > 0:
            self._refuse_failed(complaint)
        return flat[:-1].view(request.shape)

    def _refuse_failed(self, complaint: str) -> None:
        """Raise on all ranks what any of them complains of."""
        found: list[Any] = [None] * self.count
        with _clear_end():
            dist.all_gather_object(found, complaint)
        if any(found):
            if self.rank > 0:
                raise RankZeroStoppedError("a rank has failed")
            self._dismissed = True
            lines = [f"rank {rank}: {text}" for rank, text in enumerate(found) if text]
            raise ClusterError("\n".join(lines))

    def _send(self, message: tuple[str, Any]) -> None:
        with _clear_end():
            dist.broadcast_object_list([message], src=0, device=_CPU)

    def _receive(self) -> tuple[str, Any]:
        box: list[Any] = [None]
        with _clear_end():
            dist.broadcast_object_list(box, src=0, device=_CPU)
        message: tuple[str, Any] = box[0]
        return message


def _is_one_of_many() -> bool:
    """Return whether torchrun, or another launcher that tells the same, started this process."""
    return all(name in os.environ for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"))


def _meet(backend: str) -> None:
    from torch.distributed.distributed_c10d import PrefixStore
    from torch.distributed.rendezvous import rendezvous

    store, rank, count = next(rendezvous("env://", timeout=_MEETING))
    # torchrun keeps its store when it starts the ranks anew, with the addresses of the dead ones.
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    store = PrefixStore(f"attempt {attempt}", store)
    dist.init_process_group(backend, store=store, rank=rank, world_size=count, timeout=_LONG)


def _take_gpu(device: str) -> bool:
    """Choose this rank's GPU; return whether each rank of this machine has one of its own."""
    if device not in ("auto", "cuda") or not torch.cuda.is_available():
        return False
    there = torch.cuda.device_count()
    torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", os.environ["RANK"])) % there)
    return int(os.environ.get("LOCAL_WORLD_SIZE", os.environ["WORLD_SIZE"])) <= there


@contextmanager
def _clear_end() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise ClusterError(
            f"another rank is gone ({reason}); the same command with --resume goes on from the "
            "last checkpoint"
        ) from error
