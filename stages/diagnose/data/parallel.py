"""Sites are worked on side by side, one thread each: their arrays are too small to be cut further."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")

_pools: dict[int, ThreadPoolExecutor] = {}


def _start() -> None:
    torch.set_num_threads(1)  # of this worker
    torch.set_grad_enabled(False)


def per_site(
    function: Callable[[T], R], items: Sequence[T], done: Callable[[int], None] = lambda count: None
) -> list[R]:
    """``[function(item) for item in items]`` on as many threads as torch may use; ``done`` hears how many are finished."""
    threads = min(torch.get_num_threads(), len(items))
    results: Iterable[R]
    if threads < 2:
        results = map(function, items)
    else:
        pool = _pools.setdefault(threads, ThreadPoolExecutor(threads, "site", _start))
        results = pool.map(function, items)
    out = []
    for result in results:
        out.append(result)
        done(len(out))
    return out


__all__ = ["per_site"]
