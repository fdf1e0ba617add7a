"""Faults of cameras that the catalogue has not, each on the signal of a whole detector, (lines, samples)."""

from __future__ import annotations

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter, uniform_filter1d


def banding(signal, samples, lines, amplitude, period):
    """Lines that read more and less in turn, as a supply that hums makes them."""
    return signal * (1 + amplitude * np.sin(2 * np.pi * lines / period))[:, None]


def hot_columns(signal, samples, lines, share, every):
    """One column in so many reads more: amplifiers or a column store that differ."""
    return signal * (1 + share * (np.round(samples) % every < 1))[None]


def motion(signal, samples, lines, px):
    """The ground moves along the lines while it is exposed."""
    return uniform_filter1d(signal, px, axis=0, mode="nearest")


def stray_light(signal, samples, lines, share, px):
    """A share of all light is spread over a wide halo."""
    return (1 - share) * signal + share * gaussian_filter(signal, px, mode="nearest")


def blooming(signal, samples, lines, above, share, px):
    """Charge of pixels brighter than so many times the mean spills along their column."""
    excess = share * np.clip(signal - above * signal.mean(), 0, None)
    return signal - excess + uniform_filter1d(excess, px, axis=0, mode="nearest")


def compression(signal, samples, lines, step):
    """Blocks of 8 pixels whose cosine transform is rounded, more coarsely the finer the wave (as ISO 10918 does); step over the mean."""
    rows, columns = (8 * (n // 8) for n in signal.shape)
    blocks = signal[:rows, :columns].reshape(rows // 8, 8, columns // 8, 8).swapaxes(1, 2)
    waves = dctn(blocks, axes=(2, 3), norm="ortho")
    steps = step * signal.mean() * (1 + np.add.outer(np.arange(8), np.arange(8)))
    kept = idctn(np.round(waves / steps) * steps, axes=(2, 3), norm="ortho")
    out = signal.copy()
    out[:rows, :columns] = kept.swapaxes(1, 2).reshape(rows, columns)
    return out


FAULTS = {f.__name__: f for f in (banding, hot_columns, motion, stray_light, blooming, compression)}
LAST = ("banding", "hot_columns", "compression")  # what acts on numbers, not on light

__all__ = ["FAULTS", "LAST"]
