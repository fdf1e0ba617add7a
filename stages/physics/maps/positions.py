"""Positions at which crops lie on valid pixels, and the blocks that large arrays are processed in."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def blocks(height: int, width: int, size: int) -> Iterator[tuple[int, int, int, int]]:
    """(row, col, height, width) of the blocks that tile an array."""
    for row in range(0, height, size):
        for col in range(0, width, size):
            yield row, col, min(size, height - row), min(size, width - col)


def valid_positions(
    valid: Any, height: int, width: int, block: tuple[int, int, int, int], crop: int
) -> NDArray[np.bool_]:
    """(height, width) of the block: whether a crop may be centred there, all of rows r - crop/2 .. r + crop/2 - 1 (columns
    alike) being valid.

    valid : (H, W) array or dataset, read only around the block (row, col, height, width)
    """
    row, col, h, w = block
    half = crop // 2
    top, left, bottom, right = row - half, col - half, row + h + half - 1, col + w + half - 1
    r0, c0, r1, c1 = max(0, top), max(0, left), min(height, bottom), min(width, right)
    invalid = np.ones((bottom - top, right - left), np.uint8)
    invalid[r0 - top : r1 - top, c0 - left : c1 - left] = valid[r0:r1, c0:c1] == 0
    # The sum over the crop's square is zero exactly where nothing in it is invalid (faster than an erosion).
    bad = cv2.boxFilter(
        invalid, cv2.CV_32F, (crop, crop), anchor=(half, half), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return bad[half : half + h, half : half + w] < 0.5
