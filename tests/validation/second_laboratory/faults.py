"""Faults of images that no catalogue of the judged program holds.

Each takes the chip's image (I/F), its lines and samples on the detector, a strength and random numbers
that are the same for a whole case or, where a fault differs from image to image, for one pair.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import convolve1d, gaussian_filter, shift


@dataclass(frozen=True)
class Place:
    """Where a chip lies: its lines and samples, the frame's centre (line, sample) and half diagonal, px."""

    lines: np.ndarray
    samples: np.ndarray
    centre: tuple[float, float]
    reach: float


Rng = np.random.Generator


def periodic_pickup(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """A wave of the electronics, size: share of the mean signal."""
    by_sample, by_line = case.uniform(0.04, 0.3), case.uniform(-0.1, 0.1)
    angle = by_sample * at.samples[None, :] + by_line * at.lines[:, None]
    return image + size * image.mean() * np.sin(2 * np.pi * (angle + pair.uniform()))


def odd_even_amplifiers(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Even and odd samples go through amplifiers whose gains differ by size."""
    return image * (1 + size * (at.samples % 2 - 0.5))[None, :]


def blooming(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Bright pixels spill a share of their excess along the column."""
    excess = np.maximum(image - 1.2 * np.median(image), 0)
    tail = np.exp(-np.abs(np.arange(-12, 13)) / case.uniform(2, 5))
    tail[12] = 0
    return image + size * (convolve1d(excess, tail / tail.sum(), axis=0) - excess)


def compression_blocks(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Lossy compression: cosine coefficients of 8 x 8 blocks in steps, size: share of the mean signal."""
    rows, cols = (n // 8 * 8 for n in image.shape)
    blocks = image[:rows, :cols].reshape(rows // 8, 8, cols // 8, 8)
    coarse = size * image.mean() * (1 + np.add.outer(np.arange(8), np.arange(8)))[None, :, None, :]
    spectrum = dctn(blocks, axes=(1, 3), norm="ortho")
    result = image.copy()
    result[:rows, :cols] = idctn(np.round(spectrum / coarse) * coarse, axes=(1, 3), norm="ortho").reshape(rows, cols)
    return result


def motion_blur(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Smear in one direction of the detector over size px."""
    angle = case.uniform(0, np.pi)
    steps = np.linspace(-0.5, 0.5, 7) * size
    moved = [shift(image, (s * np.sin(angle), s * np.cos(angle)), order=3, mode="nearest") for s in steps]
    return np.mean(moved, axis=0)


def ghost_reflection(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """A defocused mirror image, size: its share."""
    return image + size * gaussian_filter(image[::-1, ::-1], case.uniform(1.5, 4))


def corner_stray_light(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Light that grows towards one corner of the detector, size: share of the mean signal there."""
    towards = case.choice([-1, 1], 2)
    line = 1 + towards[0] * (at.lines - at.centre[0]) / at.reach
    sample = 1 + towards[1] * (at.samples - at.centre[1]) / at.reach
    near = np.maximum(line, 0)[:, None] ** 2 + np.maximum(sample, 0)[None, :] ** 2
    return image + size * image.mean() * (near / 6) ** case.uniform(3, 5)


def hot_pixels(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Pixels too bright by about a third, size: how many of all."""
    excess = case.uniform(0.2, 0.5) * image.mean()
    return image + np.where(pair.uniform(size=image.shape) < size, excess * pair.exponential(size=image.shape), 0)


def missing_lines(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Runs of one to three lost lines filled with the last good one, size: share of lines."""
    source = np.arange(image.shape[0])
    for line in range(1, len(source)):
        if pair.uniform() < size / 2:
            last = line + int(pair.integers(1, 4))
            source[line:last] = source[line - 1]
    return image[source]


def defocus_over_field(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """A curved focal plane: variance of blur grows as the squared distance from the centre to size, px2."""
    far = np.add.outer((at.lines - at.centre[0]) ** 2, (at.samples - at.centre[1]) ** 2) / at.reach**2
    level = np.clip(2 * far, 0, 1) * 4  # a share of the variance reached in four steps
    stack = [image] + [gaussian_filter(image, np.sqrt(size * k / 4)) for k in (1, 2, 3, 4)]
    return sum(np.maximum(1 - np.abs(level - k), 0) * stack[k] for k in range(5))


def coarse_companding(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Codes in equal steps of the square root, size: step over the root of the mean signal."""
    step = size * np.sqrt(max(float(image.mean()), 1e-6))
    return (np.round(np.sqrt(np.maximum(image, 0)) / step) * step) ** 2


def detector_seam(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Two detectors that join within the field differ by size in gain and lie a fraction of a pixel apart."""
    spacing = case.uniform(60, 110)  # a mosaic of small chips, so that most crops hold a seam
    other = ((at.samples + case.uniform(0, spacing)) // spacing % 2).astype(bool)
    moved = shift(image, (min(4 * size, 0.5), 0), order=1, mode="nearest") * (1 + size)
    return np.where(other[None, :], moved, image)


def transfer_smear(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Light gathered while the charge moves out: each column gains a share of what its earlier lines saw."""
    return image + size * np.cumsum(image, axis=0) / image.shape[0]


def line_banding(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Each line has an offset of its own, size: rms over the mean signal."""
    return image + size * image.mean() * pair.standard_normal(image.shape[0])[:, None]


def nearest_resampling(image: np.ndarray, at: Place, size: float, case: Rng, pair: Rng) -> np.ndarray:
    """Done where the image is laid on the map; nothing happens on the detector."""
    return image


@dataclass(frozen=True)
class Fault:
    """How a fault acts, whether before the noise (optics), and the range of its size with a first guess."""

    act: Callable[..., np.ndarray]
    optical: bool
    unit: str
    lowest: float
    first: float
    highest: float


FAULTS = {
    "periodic_pickup": Fault(periodic_pickup, False, "relative", 1e-4, 0.003, 0.1),
    "odd_even_amplifiers": Fault(odd_even_amplifiers, False, "relative", 1e-4, 0.01, 0.2),
    "blooming": Fault(blooming, False, "share", 1e-3, 0.03, 0.6),
    "compression_blocks": Fault(compression_blocks, False, "relative", 5e-4, 0.004, 0.2),
    "motion_blur": Fault(motion_blur, True, "px", 0.3, 1.5, 8.0),
    "ghost_reflection": Fault(ghost_reflection, True, "share", 1e-3, 0.02, 0.3),
    "corner_stray_light": Fault(corner_stray_light, True, "relative", 1e-3, 0.05, 2.0),
    "hot_pixels": Fault(hot_pixels, False, "share", 1e-6, 5e-5, 0.02),
    "missing_lines": Fault(missing_lines, False, "share", 1e-3, 0.02, 0.6),
    "defocus_over_field": Fault(defocus_over_field, True, "px2", 0.1, 1.0, 8.0),
    "coarse_companding": Fault(coarse_companding, False, "relative", 1e-3, 0.005, 0.1),
    "detector_seam": Fault(detector_seam, False, "relative", 1e-4, 0.005, 0.2),
    "transfer_smear": Fault(transfer_smear, False, "share", 1e-3, 0.02, 0.5),
    "line_banding": Fault(line_banding, False, "relative", 1e-4, 0.002, 0.1),
    "nearest_resampling": Fault(nearest_resampling, False, "px", 1.0, 1.0, 1.0),
}
