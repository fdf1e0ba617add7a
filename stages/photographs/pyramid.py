"""Structure by size: Laplacian pyramids of images with gaps (Burt & Adelson 1983, IEEE Trans. Commun. 31:532), each
level smoothed by normalised convolution (Knutsson & Westin 1993, CVPR:515) so that unknown pixels say nothing.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.common.arrays import Floats32

LEVELS = 5  # bands of 1, 2, 4, 8 and 16 px; everything larger is one band more
CELL_PX = 1 << LEVELS
HALO_PX = 3 * CELL_PX  # 3.7 standard deviations of all smoothing together


def bands(values: Floats32, confidence: Floats32) -> list[tuple[Floats32, Floats32]]:
    """(coefficients, mean confidence) of LEVELS bands, fine to coarse, and of what is larger than all of them.

    values : (H, W), anything where confidence is 0; confidence : (H, W) >= 0
    """
    found = []
    value, weight = np.where(confidence > 0, values, np.float32(0)), confidence
    for _ in range(LEVELS):
        below = reduce(weight)
        coarse = np.divide(reduce(value * weight), below, out=np.zeros_like(below), where=below > 0)
        found.append((value - enlarge(coarse, value.shape), weight))
        value, weight = coarse, below
    return [*found, (value, weight)]


def collapse(levels: list[Floats32]) -> Floats32:
    """The sum of all bands at full size."""
    total = levels[-1]
    for level in levels[-2::-1]:
        total = level + enlarge(total, level.shape)
    return total


def reduce(values: Floats32) -> Floats32:
    """(H, W) -> half as many rows and columns, Gaussian-smoothed."""
    return np.asarray(cv2.pyrDown(values), np.float32)


def enlarge(values: Floats32, shape: tuple[int, ...]) -> Floats32:
    """(h, w) -> ``shape``, twice as many rows and columns."""
    return np.asarray(cv2.pyrUp(values, dstsize=(shape[1], shape[0])), np.float32)
