"""Filling holes of a DEM from their surroundings, as a network needs it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# px. Holes that no square fills take the window's mean: the largest square reaches farther than the network sees.
FILL_RADII = (2, 8, 32, 128)
FILL_REACH = sum(FILL_RADII)
FILL_STEP = 2.0**-10  # m


def fill_holes(elevation: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Continue the terrain into holes, (H, W): means over ever larger squares of valid pixels, which stay as they are.

    Depends only on pixels within FILL_REACH, to the last bit: sums of whole steps have no rounding that could differ
    from one window to the next.
    """
    if valid.all():
        return elevation
    import cv2  # not needed by every map, and slow to load

    filled = np.round(np.where(valid, elevation, 0).astype(np.float64) / FILL_STEP)
    known = valid.astype(np.float64)
    for radius in FILL_RADII:
        size = (2 * radius + 1, 2 * radius + 1)
        weight = cv2.boxFilter(known, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(filled * known, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        new = (known == 0) & (weight > 0.5)
        filled[new] = np.round(total[new] / weight[new])
        known[new] = 1
    far = known == 0
    filled[far] = np.round(filled[~far].mean()) if not far.all() else 0.0
    return np.where(valid, elevation, (filled * FILL_STEP).astype(np.float32))
