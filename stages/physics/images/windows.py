"""Which windows of a map are worked at a time: blocks that cover it, and a sample of windows that all images share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from stages.common.progress import Progress, show_nothing
from stages.common.shards import shard_range
from stages.physics.maps.window import Box

WINDOW_PX = 128
WINDOWS_PER_IMAGE = 16
LOOKS = 2048  # windows of images held at a time: 0.8 GB at most, with their ratios
BLOCK_PX = 768
STACK_PX = 24 << 20  # pixels of all images of a block, with what lies around it: 0.2 GB

Overlapping = Callable[[Box], list[int]]  # the images that show something of a window


@dataclass(frozen=True)
class Blocks:
    """Square blocks over a map. shape : of the map, px; edge : of a block, px"""

    shape: tuple[int, int]
    edge: int

    @property
    def bands(self) -> int:
        """Rows of blocks: more shards than these have nothing to do."""
        return -(-self.shape[0] // self.edge)

    def own_rows(self, shard: tuple[int, int]) -> tuple[int, int]:
        """First and last + 1 row of the map that a shard works."""
        first, last = (min(self.shape[0], self.edge * band) for band in shard_range(self.bands, shard))
        return first, last

    def within(self, rows: tuple[int, int], progress: Progress = show_nothing) -> Iterator[Box]:
        """The blocks between two rows, one after the other."""
        cols, edge, total = self.shape[1], self.edge, rows[1] - rows[0]
        for row in range(*rows, edge):
            progress(row - rows[0], total, "rows")
            for col in range(0, cols, edge):
                yield row, col, min(edge, rows[1] - row), min(edge, cols - col)
        progress(total, total, "rows")


def choose_blocks(shape: tuple[int, int], overlapping: Overlapping, halo: int, stack_px: int = STACK_PX) -> Blocks:
    """Blocks of BLOCK_PX, smaller where so many images overlap that memory would grow with them.

    halo : px around a block that are read with it; stack_px : pixels of all its images that memory holds
    """
    edge, (rows, cols) = BLOCK_PX, shape
    while edge > max(64, 2 * halo):
        side = edge + 2 * halo
        starts = [(r, c) for r in range(0, rows, edge) for c in range(0, cols, edge)]
        most = max(len(overlapping((r - halo, c - halo, side, side))) for r, c in starts)
        if most * side * side <= stack_px:
            break
        edge //= 2
    return Blocks(shape, edge)


def choose_windows(shape: tuple[int, int], count: int, overlapping: Overlapping) -> list[Box]:
    """Windows spread over the map such that every one of ``count`` images has WINDOWS_PER_IMAGE, as far as LOOKS allow."""
    rows, cols = (-(-n // WINDOW_PX) for n in shape)
    total = rows * cols
    step = max(1, round(total * 0.6180339887))  # the golden section leaves no large gap at any time
    while np.gcd(step, total) != 1:
        step += 1
    seen, looks = np.zeros(count, int), 0
    chosen: list[Box] = []
    for number in range(total):
        row, col = (WINDOW_PX * k for k in divmod(number * step % total, cols))
        box = row, col, min(WINDOW_PX, shape[0] - row), min(WINDOW_PX, shape[1] - col)
        images = overlapping(box)
        if not images or (seen[images] >= WINDOWS_PER_IMAGE).all():
            continue
        if looks + len(images) > LOOKS and chosen:
            break
        seen[images] += 1
        looks += len(images)
        chosen.append(box)
    return chosen
