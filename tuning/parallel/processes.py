"""Processes of this machine that share independent work, and do not outlive who gave it."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor

import torch

from tuning.parallel.cores import count_cores

__all__ = ["worker_pool"]


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """Return processes that share the cores; they end at once when this one does, however it ends.

    Args:
        workers: How many.
    """
    threads = max(1, count_cores() // workers)
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin, (threads,))


def _begin(threads: int) -> None:
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
