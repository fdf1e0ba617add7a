"""The windows of a map. Each is predicted with all the context that the network sees: their edges leave no trace."""

from __future__ import annotations

import itertools
import math

from schemas import ConfigError
from stages.common.shards import shard_range
from stages.infer.config import Config
from stages.physics.maps.window import Box

BAND = 1024  # rows; shards hold whole bands of a map
SMALLEST = 16  # px, side of a window
# Context costs a wide window little, and one that runs from north to south nothing but at its ends. Memory follows the width.
WIDEST, TALLEST, SHORTEST = 4096, 8192, 512
CHUNK = 256  # px of the artefact's chunks, which are best written whole


def check_window(config: Config) -> None:
    """Raises ConfigError."""
    if config.window is not None and config.window < SMALLEST:
        raise ConfigError(f"`window`: expected at least {SMALLEST} px, found {config.window}.")


def window_rows(height: int, config: Config) -> list[tuple[int, int]]:
    """(first, last + 1) row of each band of windows; shards hold whole bands."""
    return _pieces(height, config.window or BAND)


def _pieces(length: int, size: int) -> list[tuple[int, int]]:
    return [(start, min(length, start + size)) for start in range(0, length, size)]


def shard_rows(height: int, config: Config) -> tuple[int, int]:
    """(first, last + 1) row that a shard writes."""
    rows = window_rows(height, config)
    first, last = shard_range(len(rows), config.shard)
    starts = [start for start, _ in rows] + [height]
    return starts[first], starts[last]


def list_windows(shape: tuple[int, int], config: Config, together: int) -> list[Box]:
    """The windows of a shard, row by row, as large as memory allows where no size is asked for.

    together : threads to keep busy
    """
    first, last = shard_rows(shape[0], config)
    if last <= first:
        return []
    if config.window is not None:
        rows = [(first + a, first + b) for a, b in _pieces(last - first, config.window)]
        columns = _pieces(shape[1], config.window)
    else:
        columns = _even(0, shape[1], WIDEST)
        # with multiples of this share every thread gets as many windows
        share = together // math.gcd(together, len(columns))
        pieces = -(-(last - first) // (TALLEST * share)) * share
        rows = _even(first, last, max(SHORTEST, -(-(last - first) // pieces)))
    return [(a, c, b - a, d - c) for a, b in rows for c, d in columns]


def _even(first: int, last: int, largest: int) -> list[tuple[int, int]]:
    """Pieces of nearly one size that begin at chunks, none larger than ``largest`` (rounded up to chunks)."""
    chunks = range(-(-first // CHUNK), -(-last // CHUNK))
    count = max(1, -(-(last - first) // largest))
    inner = sorted({chunks[len(chunks) * k // count] * CHUNK for k in range(1, count)} - {first}) if len(chunks) else []
    return list(itertools.pairwise([first, *inner, last]))
