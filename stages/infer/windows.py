"""The windows of a map. Each is predicted with all the context that the network sees: their edges leave no trace."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from schemas import ConfigError
from stages.common.shards import shard_range
from stages.infer.config import Config
from stages.physics.maps.window import Box

BAND = 1024  # rows; shards hold whole bands of a map
# Context costs a wide window little, and one that runs from north to south nothing but at its ends. Memory follows the width.
WIDEST, TALLEST, SHORTEST = 4096, 8192, 512
CHUNK = 256  # px of the artefact's chunks, which are best written whole


def window_and_stride(config: Config) -> tuple[int, int]:
    """px, window and stride of the lattice whose rows of windows shards share. Raises ConfigError."""
    window = BAND if config.window is None else config.window
    stride = window if config.stride is None else config.stride  # windows carry their context: they need no overlap
    if window < 16 or not 1 <= stride <= window:
        raise ConfigError(
            f"`window` and `stride`: expected 1 <= stride <= window and window >= 16, found {stride} and {window}."
        )
    return window, stride


def axis_windows(length: int, window: int, stride: int, offset: int) -> list[tuple[int, int]]:
    """(first, last) of the windows along one axis; they cover 0 .. length and overlap by window - stride."""
    start = (offset % stride) - stride if offset % stride else 0
    found = []
    while True:
        first, last = max(0, start), min(length, start + window)
        if last > first:
            found.append((first, last))
        if start + window >= length:
            return found
        start += stride


def blend_weights(first: int, last: int, overlap: int, length: int) -> NDArray[np.float32]:
    """Weights of a window along one axis: linear ramps over the overlap with its neighbours, 1 elsewhere."""
    position = np.arange(first, last, dtype=np.float32) + 0.5
    weight = np.ones(last - first, np.float32)
    if overlap > 0:
        if first > 0:
            weight = np.minimum(weight, (position - first) / overlap)
        if last < length:
            weight = np.minimum(weight, (last - position) / overlap)
    return np.maximum(weight, 1e-4)


def shard_rows(height: int, config: Config) -> tuple[int, int]:
    """Rows that a shard writes: from its first window's start to the next shard's."""
    window, stride = window_and_stride(config)
    rows = axis_windows(height, window, stride, config.offset)
    first, last = shard_range(len(rows), config.shard)
    starts = [0, *(a for a, _ in rows[1:]), height]
    return starts[first], starts[last]


def list_windows(shape: tuple[int, int], config: Config) -> list[Box]:
    """The windows that the settings ask for, row by row: all that touch the shard's rows, whole."""
    window, stride = window_and_stride(config)
    first, last = shard_rows(shape[0], config)
    rows, columns = (axis_windows(length, window, stride, config.offset) for length in shape)
    return [(a, c, b - a, d - c) for a, b in rows if b > first and a < last for c, d in columns]


def cut_swaths(shape: tuple[int, int], config: Config, together: int) -> list[Box]:
    """Windows without overlap over the shard's rows, as large as memory allows. together : threads to keep busy"""
    first, last = shard_rows(shape[0], config)
    if last <= first:
        return []
    if config.offset:
        columns = axis_windows(shape[1], WIDEST, WIDEST, config.offset)
    else:
        columns = _even(0, shape[1], WIDEST)
    share = together // math.gcd(together, len(columns))  # with multiples of it every thread gets as many windows
    pieces = -(-(last - first) // (TALLEST * share)) * share
    tallest = max(SHORTEST, -(-(last - first) // pieces))
    return [(a, c, b - a, d - c) for a, b in _even(first, last, tallest) for c, d in columns]


def _even(first: int, last: int, largest: int) -> list[tuple[int, int]]:
    """Pieces of nearly one size that begin at chunks, none larger than ``largest`` (rounded up to chunks)."""
    chunks = range(-(-first // CHUNK), -(-last // CHUNK))
    count = max(1, -(-(last - first) // largest))
    inner = sorted({chunks[len(chunks) * k // count] * CHUNK for k in range(1, count)} - {first}) if len(chunks) else []
    return list(itertools.pairwise([first, *inner, last]))
