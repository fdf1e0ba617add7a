"""Reproducible random numbers and random fields."""

import zlib

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter


def generator(seed: int, *keys: object) -> np.random.Generator:
    """A generator of its own for each purpose, so that changing one draw leaves all others as they were."""
    return np.random.default_rng([seed & 0xFFFFFFFF, zlib.crc32(repr(keys).encode())])


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform between those of low and high."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def sign(rng: np.random.Generator) -> float:
    """Plus or minus one."""
    return float(rng.choice([-1.0, 1.0]))


def correlated_field(rng: np.random.Generator, shape: tuple[int, int], length_px: float) -> np.ndarray:
    """Gaussian noise of mean 0 and rms 1 with a Gaussian kernel of sigma length_px."""
    step = max(1, int(length_px / 3))  # a broad field needs no fine grid
    coarse = rng.standard_normal((shape[0] // step + 2, shape[1] // step + 2)).astype(np.float32)
    sigma = length_px / step
    # White noise after this kernel has an rms of 1 / (2 sigma sqrt(pi)); a fixed factor keeps local means honest.
    field = gaussian_filter(coarse, sigma, mode="wrap")
    field *= 2 * sigma * np.sqrt(np.pi)
    return stretch(field, step, shape)


def stretch(field: np.ndarray, step: int, shape: tuple[int, int]) -> np.ndarray:
    """Linear interpolation of a field whose cells are step cells of the result wide."""
    if step == 1:
        return np.ascontiguousarray(field[: shape[0], : shape[1]], dtype=np.float32)
    for axis in (0, 1):
        place = np.clip((np.arange(shape[axis]) + 0.5) / step - 0.5, 0, field.shape[axis] - 1.001)
        low = np.floor(place).astype(int)
        weight = (place - low).astype(np.float32)
        weight = weight[:, None] if axis == 0 else weight[None, :]
        field = field.take(low, axis) * (1 - weight) + field.take(low + 1, axis) * weight
    return field.astype(np.float32)


def fractal_field(rng: np.random.Generator, shape: tuple[int, int], hurst: float, longest: float) -> np.ndarray:
    """A self-affine surface of rms 1 that levels off for waves above `longest` cells."""
    size = [fft.next_fast_len(n, real=True) for n in shape]
    spectrum = fft.rfft2(rng.standard_normal(size).astype(np.float32))
    wave = np.hypot(fft.fftfreq(size[0])[:, None], fft.rfftfreq(size[1])[None, :])
    spectrum *= ((wave**2 + longest**-2.0) ** (-(1 + hurst) / 2)).astype(np.float32)
    spectrum[0, 0] = 0
    field = fft.irfft2(spectrum, size)[: shape[0], : shape[1]]
    return (field / field.std()).astype(np.float32)
