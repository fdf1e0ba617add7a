"""The layers between convolutions, on the CPU, in as few passes over memory as possible: numba kernels without Python's
lock.

PyTorch's own operators take one pass each for normalisation, activation, dropout and padding, forward and back, which costs
twice the convolutions. Arrays are (crops, rows, columns * channels) with channels fastest, float32 or bfloat16 as uint16.
Innermost loops index by the loop's own variable alone: numba then needs no check for negative indices, and vectorises.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, overload, register_jitable
from numpy.typing import NDArray
from torch import Tensor

SLOPE = np.float32(0.01)  # of LeakyReLU below zero


def rows_of(x: Tensor) -> NDArray:
    """(B, C, H, W) channels-last tensor -> its memory as (B, H, W * C), bfloat16 as uint16."""
    y = pixels_of(x)
    return y.reshape(y.shape[0], y.shape[1], -1)


def pixels_of(x: Tensor) -> NDArray:
    """(B, C, H, W) channels-last tensor -> its memory as (B, H, W, C), bfloat16 as uint16."""
    y = x.detach().permute(0, 2, 3, 1)
    return y.view(torch.int16).numpy().view(np.uint16) if x.dtype == torch.bfloat16 else y.numpy()


def channels_last(x: Tensor) -> Tensor:
    """(B, C, H, W), laid out pixel by pixel."""
    return x.contiguous(memory_format=torch.channels_last)


def empty(crops: int, channels: int, height: int, width: int, dtype: torch.dtype) -> Tensor:
    """Channels-last."""
    return torch.empty((crops, channels, height, width), dtype=dtype, memory_format=torch.channels_last)


@intrinsic
def _as_float(context, bits):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.uint32), generate


@intrinsic
def _as_bits(context, value):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.uint32(types.float32), generate


def _value(stored):
    raise RuntimeError("only inside kernels")


def _put(out, j, value):
    raise RuntimeError("only inside kernels")


@overload(_value)
def _value_of(stored):
    if stored is types.uint16:
        return lambda stored: _as_float(np.uint32(np.uint32(stored) << np.uint32(16)))  # type: ignore[call-arg]
    return lambda stored: np.float32(stored)


@overload(_put)
def _put_into(out, j, value):
    if out.dtype is types.uint16:  # to nearest, ties to even

        def put(out, j, value):
            bits: Any = _as_bits(np.float32(value))  # type: ignore[call-arg]
            out[j] = np.uint16(np.uint32(bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> 16)  # type: ignore[unreachable]

        return put

    def put_float(out, j, value):
        out[j] = np.float32(value)

    return put_float


@register_jitable
def _mixed(word, low, high):
    """The 32 random bits of layers.kept_values."""
    x = np.uint32(np.uint32(word * np.uint32(0x9E3779B9)) + low)
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x21F0AAAD))
    x = np.uint32((x ^ (x >> np.uint32(15)) ^ high) * np.uint32(0x735A2D97))
    return np.uint32(x ^ (x >> np.uint32(15)))


@register_jitable
def _drop(line, r, low, high, threshold, factor):
    """Dropout on row ``r``: its first half takes the lower 16 bits of the mixed words, the second the upper."""
    half = (line.size + 1) // 2
    left, right = line[:half], line[half:]
    first = np.uint32(r * half)
    for j in range(half):
        x = _mixed(np.uint32(first + np.uint32(j)), low, high)
        left[j] *= factor if (x & np.uint32(0xFFFF)) >= threshold else np.float32(0)
    for j in range(right.size):
        x = _mixed(np.uint32(first + np.uint32(j)), low, high)
        right[j] *= factor if (x >> np.uint32(16)) >= threshold else np.float32(0)


@njit(nogil=True, cache=True)
def sum_moments(first, last, x, pivot, sums):
    """sums[n] = sums over a crop of (x - pivot) and of its square; pivot : (W * C,), sums : (B, 2, C) float64"""
    channels, length = sums.shape[2], x.shape[2]
    one, two = np.empty(length, np.float32), np.empty(length, np.float32)
    for n in range(first, last):
        one[:] = 0
        two[:] = 0
        for r in range(x.shape[1]):
            row = x[n, r]
            for j in range(length):
                v = _value(row[j]) - pivot[j]
                one[j] += v
                two[j] += v * v
        _fold(one, sums[n, 0], channels)
        _fold(two, sums[n, 1], channels)


@register_jitable
def _fold(row, out, channels):
    out[:] = 0
    for j in range(0, row.size, channels):
        for c in range(channels):
            out[c] += row[j + c]


@njit(nogil=True, cache=True)
def normalise(first, last, x, out, scale, shift, keys, threshold, factor, pad, channels):
    """out = dropout(leaky(x * scale + shift)), edges continued by ``pad`` pixels; scale, shift : (W * C,)

    first, last : rows, counted through all crops
    """
    rows, length = x.shape[1], x.shape[2]
    line = np.empty(length, np.float32)
    for i in range(first, last):
        n, r = i // rows, i % rows
        row = x[n, r]
        for j in range(length):
            v = _value(row[j]) * scale[j] + shift[j]
            line[j] = v if v > 0 else v * SLOPE
        if threshold:
            _drop(line, r, keys[n, 0], keys[n, 1], threshold, factor)
        _write(line, out[n], r, rows, pad, channels)


@register_jitable
def _write(line, target, r, rows, pad, channels):
    """One row into a field whose edges are continued by ``pad`` (0 or 1) pixels."""
    begin, end = pad * channels, pad * channels + line.size
    row = target[r + pad]
    inner = row[begin:end]
    for j in range(line.size):
        _put(inner, j, line[j])
    if pad:
        row[:begin] = row[begin : begin + channels]
        row[end:] = row[end - channels : end]
        if r == 0:
            target[0] = row
        if r == rows - 1:
            target[rows + 1] = row


@register_jitable
def _gather(line, field, r, rows, pad, channels):
    """The transpose of :func:`_write`: the gradient in a row's values, with that in their copies at the edges."""
    begin, end = pad * channels, pad * channels + line.size
    inner = field[r + pad, begin:end]
    for j in range(line.size):
        line[j] = _value(inner[j])
    if pad:
        if r == 0:
            inner = field[0, begin:end]
            for j in range(line.size):
                line[j] += _value(inner[j])
        if r == rows - 1:
            inner = field[rows + 1, begin:end]
            for j in range(line.size):
                line[j] += _value(inner[j])
        last = line[line.size - channels :]
        for q in range(r if r == 0 else r + 1, rows + 2 if r == rows - 1 else r + 2):
            left, right = field[q, :begin], field[q, end:]
            for c in range(channels):
                line[c] += _value(left[c])
                last[c] += _value(right[c])


@njit(nogil=True, cache=True)
def sum_gradients(first, last, x, dy, g, scale, shift, mean, inverse, keys, threshold, factor, pad, channels, sums):
    """g = dL/d(normalised x * weight + bias); sums[n] = sums over a crop of g and of g * normalised x."""
    rows, length = x.shape[1], x.shape[2]
    line, one, two = np.empty(length, np.float32), np.empty(length, np.float32), np.empty(length, np.float32)
    for n in range(first, last):
        one[:] = 0
        two[:] = 0
        for r in range(rows):
            row, target = x[n, r], g[n, r]
            _gather(line, dy[n], r, rows, pad, channels)
            if threshold:
                _drop(line, r, keys[n, 0], keys[n, 1], threshold, factor)
            for j in range(length):
                v = _value(row[j])
                worth = line[j] * (np.float32(1) if v * scale[j] + shift[j] > 0 else SLOPE)
                one[j] += worth
                two[j] += worth * ((v - mean[j]) * inverse[j])
                _put(target, j, worth)
        _fold(one, sums[n, 0], channels)
        _fold(two, sums[n, 1], channels)


@njit(nogil=True, cache=True)
def input_gradient(first, last, x, g, scale, constant, linear):
    """g becomes dL/dx = scale * g + constant + linear * x, with two terms from the batch's mean and variance."""
    rows, length = x.shape[1], x.shape[2]
    for n in range(first, last):
        for r in range(rows):
            row, target = x[n, r], g[n, r]
            for j in range(length):
                _put(target, j, _value(target[j]) * scale[j] + constant[j] + linear[j] * _value(row[j]))


@njit(nogil=True, cache=True)
def pool(first, last, x, out):
    """Largest of 2 x 2, edges continued by a pixel. x : (B, 2 h, 2 w, C), out : (B, h + 2, (w + 2) * C)

    first, last : rows of the result, counted through all crops
    """
    rows, columns, channels = x.shape[1] // 2, x.shape[2] // 2, x.shape[3]
    line = np.empty((columns, channels), np.float32)
    for i in range(first, last):
        n, r = i // rows, i % rows
        upper, lower = x[n, 2 * r], x[n, 2 * r + 1]
        for k in range(columns):
            p0, p1, p2, p3 = upper[2 * k], upper[2 * k + 1], lower[2 * k], lower[2 * k + 1]
            to = line[k]
            for c in range(channels):
                to[c] = max(max(_value(p0[c]), _value(p1[c])), max(_value(p2[c]), _value(p3[c])))
        _write(line.reshape(-1), out[n], r, rows, 1, channels)


@njit(nogil=True, cache=True)
def pool_back(first, last, x, dy, dx):
    """Each square's gradient goes to the first of its largest values. x, dx : (B, 2 h, 2 w, C)"""
    rows, columns, channels = x.shape[1] // 2, x.shape[2] // 2, x.shape[3]
    line = np.empty((columns, channels), np.float32)
    zero = np.float32(0)
    for n in range(first, last):
        for r in range(rows):
            _gather(line.reshape(-1), dy[n], r, rows, 1, channels)
            upper, lower, upper_out, lower_out = x[n, 2 * r], x[n, 2 * r + 1], dx[n, 2 * r], dx[n, 2 * r + 1]
            for k in range(columns):
                p0, p1, p2, p3 = upper[2 * k], upper[2 * k + 1], lower[2 * k], lower[2 * k + 1]
                d0, d1, d2, d3 = upper_out[2 * k], upper_out[2 * k + 1], lower_out[2 * k], lower_out[2 * k + 1]
                worth = line[k]
                for c in range(channels):
                    v0, v1, v2, v3 = _value(p0[c]), _value(p1[c]), _value(p2[c]), _value(p3[c])
                    most = max(max(v0, v1), max(v2, v3))
                    g = worth[c]
                    before1 = v0 == most
                    before2 = before1 | (v1 == most)
                    before3 = before2 | (v2 == most)
                    _put(d0, c, g if before1 else zero)
                    _put(d1, c, g if (v1 == most) & (not before1) else zero)
                    _put(d2, c, g if (v2 == most) & (not before2) else zero)
                    _put(d3, c, zero if before3 else g)


@njit(nogil=True, cache=True)
def join(first, last, quarters, kept, out):
    """Upsampled values beside kept ones, edges continued by a pixel.

    quarters : (B, h + 1, w + 1, 4 c): pixel (2 j + a, 2 k + b) is quarter 2 a + b at (j + a, k + b)
    kept : (B, 2 h, 2 w, d); out : (B, 2 h + 2, 2 w + 2, c + d); first, last : rows of ``kept``, through all crops
    """
    rows, columns, others = kept.shape[1], kept.shape[2], kept.shape[3]
    channels = quarters.shape[3] // 4
    for i in range(first, last):
        n, r = i // rows, i % rows
        a = r & 1
        target = out[n]
        source, row, line = quarters[n, r // 2 + a], kept[n, r], target[r + 1]
        for k in range(columns):
            b = k & 1
            at = (2 * a + b) * channels
            raised, beside = source[k // 2 + b, at : at + channels], row[k]
            left, right = line[k + 1, :channels], line[k + 1, channels:]
            for c in range(channels):
                left[c] = raised[c]
            for c in range(others):
                right[c] = beside[c]
        line[0] = line[1]
        line[columns + 1] = line[columns]
        if r == 0:
            target[0] = line
        if r == rows - 1:
            target[rows + 1] = line


@njit(nogil=True, cache=True)
def join_back(first, last, dy, dquarters, dkept):
    """The transpose of :func:`join`. dy : (B, 2 h + 2, (2 w + 2) * (c + d))"""
    rows, columns, others = dkept.shape[1], dkept.shape[2], dkept.shape[3]
    channels = dquarters.shape[3] // 4
    both = channels + others
    line = np.empty((columns, both), np.float32)
    for n in range(first, last):
        dquarters[n] = 0
        for r in range(rows):
            _gather(line.reshape(-1), dy[n], r, rows, 1, both)
            a = r & 1
            target, row = dquarters[n, r // 2 + a], dkept[n, r]
            for k in range(columns):
                b = k & 1
                at = (2 * a + b) * channels
                raised, beside = target[k // 2 + b, at : at + channels], row[k]
                left, right = line[k, :channels], line[k, channels:]
                for c in range(channels):
                    _put(raised, c, left[c])
                for c in range(others):
                    _put(beside, c, right[c])
