"""Brightness that comes in equal steps: images that were digitised with few levels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from stages.diagnose.model.sites import Site

BINS = 8192  # of the histogram
BRIGHTEST = 4.0  # times the mean: a histogram ends there
WIDEST = 1 / 30  # of the mean: a step of more is a shape of the histogram
FINEST = 1 / 600  # of the mean
AROUND = 513  # waves of the histogram's spectrum that a peak is compared with: it is as wide as the histogram is narrow


def steps_of_brightness(sites: Sequence[Site], frames: int) -> tuple[float, float, int]:
    """-log10 of the chance of the strongest wave in the histogram of any frame's pixels, and what such steps are rms, relative to its mean; which frame (-1: none).

    Flat ground keeps the levels of a detector wherever resampling mixes equal pixels; smooth brightness has a smooth histogram. The same is
    sought in the root of brightness, in which cameras that compress (compand) their numbers have equal steps.
    """
    best, size, which = 0.0, 0.0, -1
    for frame in range(frames):
        pixels = [s.read[k][s.read_valid[k]] for s in sites for k in np.flatnonzero(s.frames == frame)]
        values = torch.cat(pixels).numpy() if pixels else np.zeros(0)
        mean = float(values.mean()) if len(values) else 0.0
        if not mean > 0:
            continue
        relative = values / mean
        for scaled, per_step in ((relative, 1.0), (np.sqrt(np.maximum(relative, 0.0)), 2.0)):
            chance, step = _strongest(scaled)
            chance -= math.log10(2 * frames)
            if chance > best:
                best, size, which = chance, per_step * step / math.sqrt(12), frame
    return best, size, which


def _strongest(values: NDArray[np.floating]) -> tuple[float, float]:
    """-log10 of the chance of the strongest wave in a histogram of values about 1, and its length."""
    per_unit = np.arange(BINS // 2 + 1) / BRIGHTEST  # cycles per mean brightness
    sought = (per_unit > 1 / WIDEST) & (per_unit < 1 / FINEST)
    counts = np.histogram(values, BINS, (0.0, BRIGHTEST))[0]
    power = np.abs(np.fft.rfft(counts)) ** 2 / max(counts.sum(), 1)  # of chance alone exponential, with mean 1
    excess = np.where(sought, power / np.maximum(median_filter(power, AROUND) / math.log(2), 1.0), 0.0)
    top = int(excess.argmax())
    return float(excess[top] / math.log(10) - math.log10(sought.sum())), 1 / max(float(per_unit[top]), 1e-9)


__all__ = ["steps_of_brightness"]
