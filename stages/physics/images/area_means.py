"""Area means of an image over the quadrilaterals that show the pixels of a ground grid."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.physics.maps.grid import CSM_CENTRE

ReadWindow = Callable[[int, int, int, int], NDArray[np.float32]]

MAX_SAMPLES = 64  # per side of a ground pixel
WINDOW_PX = 1 << 23  # image pixels in memory at a time


def area_means(
    read_window: ReadWindow, size: tuple[int, int], line: Floats, sample: Floats, wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(h, w) means of the image over the quadrilaterals between corners, and whether every contributing pixel was valid.

    read_window : (line, sample, lines, samples) -> pixels, NaN = nodata; only asked for windows inside the image
    size : (lines, samples) of the image; line, sample : (h, w, 2, 2) corners, the image's first pixel from 0 to 1
    wanted : (h, w), where a mean is wanted. Ground that spans much of the image is taken in halves, so that a window never
    holds more than WINDOW_PX.
    """
    lines_all, samples_all = size
    height, width = wanted.shape
    on_image = (line >= 0) & (line <= lines_all) & (sample >= 0) & (sample <= samples_all)
    whole = wanted & on_image.all(axis=(2, 3))
    values, complete = np.full(wanted.shape, np.nan, np.float32), np.zeros(wanted.shape, bool)
    if not whole.any():
        return values, complete
    lines, samples = line[whole], sample[whole]
    l0, l1 = max(0, math.floor(lines.min()) - 1), min(lines_all, math.ceil(lines.max()) + 1)
    s0, s1 = max(0, math.floor(samples.min()) - 1), min(samples_all, math.ceil(samples.max()) + 1)
    if (l1 - l0) * (s1 - s0) > WINDOW_PX and wanted.size > 1:
        middle = max(height, width) // 2
        halves = (np.s_[:middle], np.s_[middle:]) if height >= width else (np.s_[:, :middle], np.s_[:, middle:])
        for part in halves:
            values[part], complete[part] = area_means(read_window, size, line[part], sample[part], wanted[part])
        return values, complete
    # along rows' sides, along columns'
    spans = [np.hypot(np.diff(lines, axis=a), np.diff(samples, axis=a)).max(axis=(1, 2)) for a in (1, 2)]
    n_row, n_col = (_samples_per_side(span) for span in spans)
    pixels = read_window(l0, s0, l1 - l0, s1 - s0)
    first = CSM_CENTRE + l0, CSM_CENTRE + s0
    _average(np.ascontiguousarray(pixels, np.float32), line, sample, *first, whole, n_row, n_col, values, complete)
    return values, complete


def _samples_per_side(size_px: Floats) -> int:
    """Samples along a side of ground pixels that span ``size_px`` (n,) image pixels: one, or two per image pixel.

    Twice is the least that is exact for an image that is linear between its pixel centres.
    """
    largest = float(np.nanmax(size_px, initial=0.0))
    return 1 if largest <= 1.0 else min(MAX_SAMPLES, math.ceil(2 * largest - 0.1))


@numba.njit(cache=True, parallel=True)
def _average(pixels, line, sample, first_line, first_sample, wanted, n_row, n_col, values, complete):
    lines, samples = pixels.shape
    for i in numba.prange(wanted.shape[0]):
        for j in range(wanted.shape[1]):
            if not wanted[i, j]:
                continue
            total = 0.0
            good = True
            for a in range(n_row):
                f = (a + 0.5) / n_row
                for b in range(n_col):
                    g = (b + 0.5) / n_col
                    y = (1 - f) * ((1 - g) * line[i, j, 0, 0] + g * line[i, j, 0, 1]) + f * (
                        (1 - g) * line[i, j, 1, 0] + g * line[i, j, 1, 1]
                    )
                    x = (1 - f) * ((1 - g) * sample[i, j, 0, 0] + g * sample[i, j, 0, 1]) + f * (
                        (1 - g) * sample[i, j, 1, 0] + g * sample[i, j, 1, 1]
                    )
                    y, x = y - first_line, x - first_sample
                    y = min(max(y, 0.0), lines - 1.0)
                    x = min(max(x, 0.0), samples - 1.0)
                    y0, x0 = min(int(y), max(lines - 2, 0)), min(int(x), max(samples - 2, 0))
                    y1, x1 = min(y0 + 1, lines - 1), min(x0 + 1, samples - 1)
                    u, v = y - y0, x - x0
                    value = 0.0
                    for yy, xx, weight in (
                        (y0, x0, (1 - u) * (1 - v)),
                        (y0, x1, (1 - u) * v),
                        (y1, x0, u * (1 - v)),
                        (y1, x1, u * v),
                    ):
                        if weight > 0.0:
                            value += weight * pixels[yy, xx]
                    if not math.isfinite(value):
                        good = False
                    total += value
            if good:
                values[i, j] = total / (n_row * n_col)
                complete[i, j] = True
