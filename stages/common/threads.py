"""Running kernels that release Python's lock in several threads, with the same result on any number of them."""

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
    """Within this block PyTorch's own operators run on one thread each, and :func:`share_out` on as many as PyTorch
    had.

    An operator that is split over several threads adds in another order, or ends its vectors elsewhere. Pieces of a
    fixed size, each worked on by one thread, give the same result on any number of threads.
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
    """Whether we are inside :func:`one_thread_each`, where batches are to be cut into pieces and shared out."""
    return _workers is not None


def share_out(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) on ranges of ``count`` crops or rows, in as many threads as PyTorch uses."""
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
    if alone and torch.get_num_threads() != 1:  # PyTorch's number of threads is one of each thread
        torch.set_num_threads(1)
    _here.busy = True  # a share is not shared out again: it would wait for its own pool for ever
    try:
        kernel(*arguments)
    finally:
        _here.busy = False
