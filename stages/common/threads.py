"""The number of threads that computations run in."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

_pools: dict[int, ThreadPoolExecutor] = {}


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Within this block PyTorch's operators run on one thread: on several they add in another order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def share_out(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) on ranges of ``count`` crops or rows, in as many threads as PyTorch uses.

    The kernel releases Python's lock, and its results do not depend on the ranges.
    """
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        kernel(0, count, *arguments)
        return
    bounds = [count * k // threads for k in range(threads + 1)]
    pool = _pools.setdefault(threads, ThreadPoolExecutor(threads))
    for job in [pool.submit(kernel, a, b, *arguments) for a, b in itertools.pairwise(bounds)]:
        job.result()
