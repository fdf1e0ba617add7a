"""Sharing out work over crops or rows to kernels that do not hold Python's lock, with the same result on any number of threads."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

_pools: dict[int, ThreadPoolExecutor] = {}
_workers: int | None = None  # how many threads share work inside one_thread_each
_here = threading.local()  # whether this thread works on a share already


@contextlib.contextmanager
def one_thread_each() -> Iterator[None]:
    """Inside, PyTorch's own operators run on one thread each, and work is shared out to as many as PyTorch had.

    An operator that is split over several threads adds up in another order, or ends its vectors elsewhere. Pieces of a
    fixed size, each worked on by one thread, come out alike however many threads there are.
    """
    global _workers
    threads, before = torch.get_num_threads(), _workers
    _workers = threads if before is None else before
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _workers = before


def in_pieces() -> bool:
    """Whether operators run on one thread each, so that batches should be cut into pieces and shared out."""
    return _workers is not None


def share_out(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """kernel(first, last, *arguments) over ``count`` crops or rows, on as many threads as PyTorch uses."""
    threads = min(_workers or torch.get_num_threads(), count)
    if threads <= 1 or getattr(_here, "busy", False):
        kernel(0, count, *arguments)
        return
    bounds = [count * k // threads for k in range(threads + 1)]
    alone = in_pieces()
    pool = _pools.setdefault(threads, ThreadPoolExecutor(threads))
    for job in [pool.submit(_work, alone, kernel, a, b, *arguments) for a, b in itertools.pairwise(bounds)]:
        job.result()


def _work(alone: bool, kernel: Callable[..., None], *arguments: Any) -> None:
    if alone and torch.get_num_threads() != 1:  # PyTorch counts for every thread anew
        torch.set_num_threads(1)
    _here.busy = True  # what is shared out in turn stays here: waiting for this very pool would last for ever
    try:
        kernel(*arguments)
    finally:
        _here.busy = False
