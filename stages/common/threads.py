"""Sharing out work over crops or rows to kernels that do not hold Python's lock."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

_pools: dict[int, ThreadPoolExecutor] = {}


def share_out(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """kernel(first, last, *arguments) over ``count`` crops or rows, on as many threads as PyTorch uses."""
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        kernel(0, count, *arguments)
        return
    pool = _pools.setdefault(threads, ThreadPoolExecutor(threads))
    bounds = [count * k // threads for k in range(threads + 1)]
    for job in [pool.submit(kernel, a, b, *arguments) for a, b in itertools.pairwise(bounds)]:
        job.result()
