"""Edges that come back every eight pixels of the detector: images that were compressed in blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.structure.innovations import Innovation

BLOCK = 8  # pixels (ITU-T T.81, JPEG)
PARTS = 8  # of a pixel along each axis: what lies between pixels is smoother where images are resampled
CONTROLS = 7, 9  # periods that no camera has


def blocks_of_compression(every: Sequence[Innovation], frames: int) -> tuple[float, float]:
    """How many times more the roughness of a frame goes with the place within a block than with that in pieces of other lengths, of the frame and
    the axis that have most of it; and its share of the frame's squares of roughness.
    """
    rough = _beside_resampling([(one, *_roughness(one)) for one in every], frames)
    best = 0.0, 0.0
    for axis in (0, 1):
        (block, share), *other = (_between(rough, frames, axis, period) for period in (BLOCK, *CONTROLS))
        best = max(best, (block / max(*(ratio for ratio, _ in other), 1.0), share))
    return best


def _beside_resampling(
    rough: Sequence[tuple[Innovation, Tensor, Tensor]], frames: int
) -> list[tuple[Innovation, Tensor, Tensor]]:
    """The same without what goes with where between the detector's pixels it was taken from, which may come back every eight pixels as well."""
    sums, count = np.zeros((2, frames, PARTS * PARTS))
    places = []
    for one, value, seen in rough:
        line, sample = (one.detector.frac() * PARTS).nan_to_num(0.0).floor().long().clamp(0, PARTS - 1).unbind(1)
        place = one.patch.frames[:, None, None] * PARTS * PARTS + line * PARTS + sample
        at, x = place[seen].numpy(), value[seen].double().numpy()
        sums += np.bincount(at, x, sums.size).reshape(sums.shape)
        count += np.bincount(at, minlength=sums.size).reshape(sums.shape)
        places.append(place)
    mean = torch.from_numpy(sums / np.maximum(count, 1)).flatten().float()
    return [(one, value - mean[place], seen) for (one, value, seen), place in zip(rough, places, strict=True)]


def _between(
    rough: Sequence[tuple[Innovation, Tensor, Tensor]], frames: int, axis: int, period: int
) -> tuple[float, float]:
    """The largest of all frames' F ratios between places within pieces of this length, and their share of its squares."""
    sums, squares, count = (np.zeros((frames, period)) for _ in range(3))
    for one, value, seen in rough:
        place = one.detector[:, axis].floor().long() % period
        for k, frame in enumerate(one.patch.frames.tolist()):
            x, at = value[k][seen[k]].double().numpy(), place[k][seen[k]].numpy()
            sums[frame] += np.bincount(at, x, period)
            squares[frame] += np.bincount(at, x * x, period)
            count[frame] += np.bincount(at, minlength=period)
    mean = sums / np.maximum(count, 1)
    share = (count * mean**2).sum(1) / np.maximum(squares.sum(1), 1e-9)
    ratio = share * count.sum(1) / (period - 1)
    return float(ratio.max()), float(share[ratio.argmax()])


def _roughness(one: Innovation) -> tuple[Tensor, Tensor]:
    """(n, h, w) second differences of what is left along both axes, over their mean on the piece, less one; and where they are known."""
    value, seen = one.limited, one.seen.clone()
    total = torch.zeros_like(value)
    total[..., 1:-1] += (value[..., 2:] - 2 * value[..., 1:-1] + value[..., :-2]).abs()
    total[..., 1:-1, :] += (value[..., 2:, :] - 2 * value[..., 1:-1, :] + value[..., :-2, :]).abs()
    for border in (seen[..., :1], seen[..., -1:], seen[..., :1, :], seen[..., -1:, :]):
        border[:] = False
    mean = (total * seen).sum((-2, -1), keepdim=True) / seen.sum((-2, -1), keepdim=True).clamp(min=1)
    return total / mean.clamp(min=1e-9) - 1, seen


__all__ = ["blocks_of_compression"]
