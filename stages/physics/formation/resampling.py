"""Images moved by fractions of a pixel, by the cubic of Catmull & Rom (Keys 1981)."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray
from torch import Tensor


def displace(image: Tensor, east: Tensor, south: Tensor) -> Tensor:
    """The image sampled ``east`` columns and ``south`` rows further on; beyond its edges the outermost pixels repeat.

    The cubic moves straight lines and parabolas exactly. Bilinear sampling would blur by up to a quarter of a squared pixel;
    the cubic of ``torch.nn.functional.grid_sample`` moves a ramp by 0.14 px where 0.1 is asked for.

    image : (B, H, W); east, south : px, broadcastable to it; returns (B, H, W)
    """
    height, width = image.shape[-2:]
    if all(d.ndim < 2 or d.shape[-2:] == (1, 1) for d in (east, south)):  # rows and columns one after the other
        across = _matrix(width, east.expand(len(image), 1, 1)[:, 0], image)
        down = _matrix(height, south.expand(len(image), 1, 1)[:, 0], image)
        return down @ image @ across.transpose(1, 2)
    east, south = east.expand_as(image), south.expand_as(image)
    if image.dtype == torch.float32 and image.device.type == "cpu" and not _has_gradient(image, east, south):
        moved = torch.empty(image.shape)
        _displace(_array(image), _array(east), _array(south), moved.numpy())
        return moved
    return displace_anywhere(image, east, south)


def displace_anywhere(image: Tensor, east: Tensor, south: Tensor) -> Tensor:
    """As :func:`displace`, on any device and with gradients, all (B, H, W)."""
    height, width = image.shape[-2:]
    right, x = _taps(torch.arange(width, dtype=image.dtype) + east, width)
    down, y = _taps(torch.arange(height, dtype=image.dtype)[:, None] + south, height)
    flat, moved = image.flatten(1), image.new_zeros(image.shape)
    for row, high in zip(down, y, strict=True):
        along = image.new_zeros(image.shape)
        for column, across in zip(right, x, strict=True):
            along = along + across * flat.gather(1, (row * width + column).flatten(1)).view(image.shape)
        moved = moved + high * along
    return moved


def _array(field: Tensor) -> NDArray[np.float32]:
    return field.float().contiguous().numpy()


def _has_gradient(*tensors: Tensor) -> bool:
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)


def _matrix(count: int, shift: Tensor, image: Tensor) -> Tensor:
    """(B, count, count) by which one axis is sampled ``shift`` (B, 1) further on."""
    index, weights = _taps(torch.arange(count, dtype=image.dtype) + shift, count)
    matrix = image.new_zeros(len(shift), count, count)
    for place, weight in zip(index, weights, strict=True):
        matrix = matrix.scatter_add(2, place[..., None], weight[..., None])
    return matrix


def _taps(place: Tensor, count: int) -> tuple[list[Tensor], list[Tensor]]:
    """The four pixels about every place, kept within the image, and their weights."""
    first = place.detach().floor()
    t = place - first
    index = [(first.long() + k).clamp(0, count - 1) for k in (-1, 0, 1, 2)]
    return index, list(_catmull_rom(t))


@register_jitable
def _catmull_rom(t):
    """Weights of four pixels at ``t`` of the way from the second to the third; tensors, or numbers in kernels."""
    return (
        ((2 - t) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((4 - 3 * t) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    )


@njit(cache=True, nogil=True)
def _displace(image, east, south, moved):  # pragma: no cover - compiled
    crops, height, width = image.shape
    x, y = np.empty(4, np.float32), np.empty(4, np.float32)
    for b in range(crops):
        for i in range(height):
            for j in range(width):
                u, v = np.float32(j) + east[b, i, j], np.float32(i) + south[b, i, j]
                column, row = np.floor(u), np.floor(v)
                x[0], x[1], x[2], x[3] = _catmull_rom(u - column)
                y[0], y[1], y[2], y[3] = _catmull_rom(v - row)
                total = np.float32(0)
                for k in range(4):
                    r = min(max(int(row) + k - 1, 0), height - 1)
                    along = np.float32(0)
                    for n in range(4):
                        along += x[n] * image[b, r, min(max(int(column) + n - 1, 0), width - 1)]
                    total += y[k] * along
                moved[b, i, j] = total
