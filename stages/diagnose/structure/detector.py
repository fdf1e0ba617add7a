"""A pattern that stays on the detector whatever ground it shows, as dust on a window, a flat field that is off or pixels of their own make it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.common.arrays import Floats
from stages.diagnose.structure.innovations import Innovation
from stages.effects.filters import blur_matrix

BLOCK = 32  # px of the detector, in which columns and lines have their means
SPOT = 1.0  # px, sigma: dust is broader, noise of single pixels is not
KNOWN = 0.2  # of the weight about a pixel, which it is a mean of at least
PASSES = 3  # of taking out means of columns and lines in turn, where a block is not full
SHIFTS = 12  # of the grounds against each other, that tell what is alike by chance
APART = 8, 40  # px of such a shift, either way: farther than dust is wide, and grounds still overlap
BEYOND = 6.0  # standard deviations of what is alike by chance: three grounds that look alike had 3.9


def pattern_of_detector(every: Sequence[Innovation], least: float) -> float:
    """Share of the squares that images of different ground have alike where they fall on the same pixel of the detector, if it is surely more than
    ``least``, or 0: of what is broader than a pixel, beside what whole columns and lines have, which is a matter of the flat field.

    Of a line camera only images that lie on the same lines have it. Where grounds are shifted against each other nothing is alike but by chance.
    """
    place, value, site = _on_pixels(every)
    grounds = int(site.max(initial=-1)) + 1
    share = _alike(place, value, site)
    if not share > least:
        return 0.0
    rng = np.random.default_rng(grounds)
    by_chance = []
    for _ in range(SHIFTS):
        shift = rng.integers(*APART, (grounds, 2)) * rng.choice([-1, 1], (grounds, 2))
        by_chance.append(_alike(place + shift[site], value, site))
    return share if share - BEYOND * float(np.std(by_chance)) > least else 0.0


def _alike(place: NDArray[np.int64], value: Floats, site: NDArray[np.int64]) -> float:
    """Share of the squares that different grounds have alike. place : (N, 2) line and sample; value, site : (N,)"""
    if not len(place):
        return 0.0
    first, grounds = place.min(0), int(site.max()) + 1
    wide = int(place[:, 1].max() - first[1]) + 1
    # of every pixel of the detector that is hit, and of every ground that falls on one
    number, pixel = np.unique((place - first) @ [wide, 1], return_inverse=True)
    cell, of = np.unique(pixel * grounds + site, return_inverse=True)
    at, ground = cell // grounds, cell % grounds
    own, often, power = np.bincount(of, value), np.bincount(of), np.bincount(of, value**2)
    others, count = np.bincount(at, own)[at] - own, np.bincount(at, often)[at] - often
    both = count > 0
    line, sample = number // wide, number % wide
    blocks, block = np.unique(line // BLOCK * wide + sample // BLOCK, return_inverse=True)
    piece = ground * len(blocks) + block[at]
    along = [(piece * BLOCK + x[at] % BLOCK)[both] for x in (line, sample)]
    mean, other = (_without((x / n)[both], along) for x, n in ((own, often), (others, np.maximum(count, 1))))
    squares = float(power[both].sum())
    return float((often[both] * mean * other).sum()) / squares if squares > 0 else 0.0


def _without(x: Floats, along: Sequence[NDArray[np.int64]]) -> Floats:
    """(N,) less the means of those with the same number in each of ``along``."""
    for _ in range(PASSES):
        for key in along:
            x = x - (np.bincount(key, x) / np.maximum(np.bincount(key), 1))[key]
    return x


def _on_pixels(every: Sequence[Innovation]) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """(N, 2) line and sample, (N,) smoothed value and (N,) number of the ground of every pixel that is seen."""
    place, value, site = [np.zeros((0, 2), np.int64)], [np.zeros(0)], [np.zeros(0, np.int64)]
    for one in every:
        known = one.seen & one.detector.isfinite().all(1)
        place.append(np.stack([x[known].round().long().numpy() for x in one.detector.unbind(1)], 1))
        value.append(_smooth(one)[known].double().numpy())
        site.append(np.full(len(value[-1]), one.patch.site))
    return np.concatenate(place), np.concatenate(value), np.concatenate(site)


def _smooth(one: Innovation) -> Tensor:
    """(n, h, w) means of what is seen about each pixel."""
    down, across = (blur_matrix(count, SPOT).to(one.value.dtype) for count in one.value.shape[-2:])
    known = down @ one.seen.to(one.value.dtype) @ across.T
    mean: Tensor = down @ torch.where(one.seen, one.limited, 0.0) @ across.T / known.clamp(min=KNOWN)
    return mean


__all__ = ["pattern_of_detector"]
