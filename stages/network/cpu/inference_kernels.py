"""What stands between the convolutions of a network that runs over a map strip by strip: numba kernels without Python's lock.

Every kernel writes some rows of a longer field, so that the rows which the next convolution has seen before can stay where
they are. Arrays are (rows, columns, channels) with channels fastest, float32 or bfloat16 as uint16.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from stages.network.cpu.training_kernels import SLOPE, _put, _value

LANES = 16  # channels worked on at once: a loop of known length needs no bookkeeping for each pixel
_AT = tuple(np.uint64(k * LANES) for k in range(9))


def as_words(*fields: NDArray, parts: int = 1) -> list[NDArray]:
    """Fields seen as the widest unsigned integers that divide ``parts`` of each pixel: copies then move more at once."""
    for word in (np.uint64, np.uint32, np.uint16):
        size = np.dtype(word).itemsize
        if all(field.shape[-1] * field.itemsize % (size * parts) == 0 for field in fields):
            return [field.view(word) for field in fields]
    return list(fields)


def lanes(values: NDArray) -> NDArray[np.float32]:
    """Weights of :func:`heights`: (9, C), bias first -> (blocks, 9 * LANES), channels filled up with zeros."""
    blocks = -(-values.shape[1] // LANES)
    full = np.zeros((9, blocks * LANES), np.float32)
    full[:, : values.shape[1]] = values
    return np.ascontiguousarray(full.reshape(9, blocks, LANES).transpose(1, 0, 2)).reshape(blocks, -1)


@njit(nogil=True, cache=True, fastmath={"contract"})
def heights(terrain, weights, out):
    """LeakyReLU(convolution + bias) of heights by kernels that sum to zero, columns continued at both edges.

    Differences to the middle pixel are taken first: the height itself then leaves no rounding, and the same ground gives
    the same bits in every window. terrain : (n + 2, W) m; weights : see :func:`lanes`, 1/m, neighbours row by row without
    the middle; out : (n, W, C)
    """
    rows, columns, channels = out.shape
    wide = weights.shape[0] * LANES
    line = np.empty(columns * wide, np.float32)
    for r in range(rows):
        above, row, below = terrain[r], terrain[r + 1], terrain[r + 2]
        for k in range(columns):
            a, b = max(k - 1, 0), min(k + 1, columns - 1)
            z = row[k]
            d0, d1, d2, d3 = above[a] - z, above[k] - z, above[b] - z, row[a] - z
            d4, d5, d6, d7 = row[b] - z, below[a] - z, below[k] - z, below[b] - z
            for block in range(weights.shape[0]):
                w, to = weights[block], line[k * wide + block * LANES : k * wide + (block + 1) * LANES]
                for c in range(LANES):
                    i = np.uint64(c)  # unsigned: no check for negative indices, which would keep it from vectorising
                    v = w[i] + (d0 * w[i + _AT[1]] + d1 * w[i + _AT[2]]) + (d2 * w[i + _AT[3]] + d3 * w[i + _AT[4]])
                    to[i] = v + (d4 * w[i + _AT[5]] + d5 * w[i + _AT[6]]) + (d6 * w[i + _AT[7]] + d7 * w[i + _AT[8]])
        if wide == channels:
            _activate(line, out[r].reshape(-1))
        else:
            for k in range(columns):
                _activate(line[k * wide : k * wide + channels], out[r, k])


@register_jitable
def _activate(line, out):
    for j in range(out.size):
        v = line[j]
        _put(out, j, v if v > 0 else v * SLOPE)


@njit(nogil=True, cache=True)
def pool(x, out, at):
    """Largest of 2 x 2, into the rows of ``out`` from ``at`` on. x : (2 n, 2 w, C); out : (>= at + n, w, C)"""
    columns, channels = out.shape[1], out.shape[2]
    for r in range(x.shape[0] // 2):
        upper, lower, to = x[2 * r], x[2 * r + 1], out[at + r]
        for k in range(columns):
            p0, p1, p2, p3, q = upper[2 * k], upper[2 * k + 1], lower[2 * k], lower[2 * k + 1], to[k]
            for c in range(channels):
                _put(q, c, max(max(_value(p0[c]), _value(p1[c])), max(_value(p2[c]), _value(p3[c]))))


@njit(nogil=True, cache=True)
def raise_rows(quarters, first, row, last, out, at):
    """The upsampled half of a decoder's input: rows ``row`` .. ``last`` of a level, into ``out`` from ``at`` on.

    quarters : (n, w + 1, 4 c) words, its first row is ``first``: pixel (2 j + a, 2 k + b) is quarter 2 a + b at (j + a, k + b)
    out : (.., 2 w, c + d) words
    """
    columns, channels = quarters.shape[1] - 1, quarters.shape[2] // 4
    for r in range(row, last):
        a = r & 1
        source, line = quarters[r // 2 + a - first], out[at + r - row]
        even, odd = 2 * a * channels, (2 * a + 1) * channels
        for k in range(columns):
            left, right = source[k, even : even + channels], source[k + 1, odd : odd + channels]
            to, beside = line[2 * k], line[2 * k + 1]
            for c in range(channels):
                to[c] = left[c]
            for c in range(channels):
                beside[c] = right[c]


@njit(nogil=True, cache=True)
def place_rows(kept, column, out, at):
    """The kept half of a decoder's input, beside the raised one: kept : (n, W, d) words, from ``column`` on; out as above."""
    channels = kept.shape[2]
    begin = out.shape[2] - channels
    for r in range(kept.shape[0]):
        source, line = kept[r], out[at + r]
        for k in range(out.shape[1]):
            values, to = source[column + k], line[k, begin:]
            for c in range(channels):
                to[c] = values[c]


@njit(nogil=True, cache=True)
def finish(raw, first, last, scale, start, out):
    """out[c] = raw * scale + start[c], columns ``first`` .. ``last``. raw : (n, W, C); out : (C, n, last - first) float32"""
    for r in range(raw.shape[0]):
        for c in range(out.shape[0]):
            to, shift = out[c, r], start[c]
            for k in range(last - first):
                to[k] = _value(raw[r, first + k, c]) * scale + shift
