"""The steps of an epoch: their pairs, their order, their learning rate, and reading them ahead."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray

from stages.pairs import symmetries
from stages.pairs.reader import Batch, PairReader

WARM_UP = 20  # steps over which a cosine schedule rises


def learning_rate(highest: float, schedule: str, step: int, steps: int) -> float:
    """The learning rate of one step of a training run: constant, or a cosine after a short rise."""
    if schedule == "constant":
        return highest
    return highest * min(1, (step + 1) / WARM_UP) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))


def order_steps(
    train: NDArray[np.int64], batch: int, augment: bool, rng: np.random.Generator, rank: int, ranks: int
) -> list[tuple[NDArray, NDArray | None]]:
    """The batches of one epoch for this process: (pair indices, symmetries).

    Every process gets the same number of batches; a crop's symmetry does not depend on its process.

    train : (n,), indices of pairs
    """
    order = rng.permutation(train)
    turns = rng.integers(0, symmetries.COUNT, len(order)) if augment else None
    count = math.ceil(len(order) / batch)
    bounds = [len(order) * k // count for k in range(count + 1)]  # equal batches: BatchNorm dislikes a rest of one
    steps = []
    for first, last in itertools.pairwise(bounds):
        mine = np.arange(first, last)[rank::ranks] if last - first >= ranks else np.arange(first, last)
        steps.append((order[mine], None if turns is None else turns[mine]))
    return steps


def prefetch(
    reader: PairReader, steps: Sequence[tuple[NDArray, NDArray | None]], device: torch.device
) -> Iterator[Batch]:
    """Batches in order, the next one read while the current one is worked on.

    steps : pair indices (b,) and symmetries (b,), or None, of each batch
    """
    with ThreadPoolExecutor(1) as pool:
        waiting = None
        for indices, turns in steps:
            following = pool.submit(reader.batch, indices, turns)
            if waiting is not None:
                yield waiting.result().to(device)
            waiting = following
        if waiting is not None:
            yield waiting.result().to(device)
