"""Faults of no catalogue: of each the diagnosis should say that something is left that it cannot name."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from scipy import fft, ndimage

from .exposure import Departure, Patch
from .fields import Array, standardised
from .layout import Needs
from .plant import Plant

LINES = 20000  # of a random sequence, more than any image has
BLOCK = 8  # px of a JPEG block


class Fault(Plant):
    """What its seed draws is its own."""

    def draw(self, rng: np.random.Generator) -> None:
        self.seed = int(rng.integers(2**62))
        self.draw_fault(rng)

    def draw_fault(self, rng: np.random.Generator) -> None:
        """Draw what the fault has of its own."""


class OnSignal(Fault, ABC):
    """It acts on the signal of the detector's pixels: of the `sensor`, before noise, if not of the `optics`, or `after` all else."""

    where: ClassVar[str] = "sensor"

    def departure(self, x: float) -> Departure:
        return Departure(**{self.where: lambda signal, patch: self.sense(signal, patch, x)})

    @abstractmethod
    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        """The signal with the fault at strength x."""


class Ghost(OnSignal):
    """A blurred, displaced and perhaps turned second image from a reflection between lenses."""

    name = "ghost"
    where = "optics"
    start, low, high = 0.03, 0.002, 0.4

    def draw_fault(self, rng: np.random.Generator) -> None:
        self.samples, self.lines, self.blur = rng.uniform(6, 30), rng.uniform(6, 30), rng.uniform(1.5, 5)
        self.turned = bool(rng.random() < 0.5)

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        second = signal[::-1, ::-1] if self.turned else signal
        second = np.roll(second, (int(self.lines), int(self.samples)), (0, 1))
        return signal + x * ndimage.gaussian_filter(second, self.blur)


class Banding(OnSignal):
    """An offset that wanders from line to line."""

    name = "banding"
    start, low, high = 0.006, 0.0003, 0.1

    def draw_fault(self, rng: np.random.Generator) -> None:
        self.period = rng.uniform(4, 18, self.scene.sites.images)

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        white = np.random.default_rng([self.seed, patch.image]).standard_normal(LINES)
        offset = standardised(ndimage.gaussian_filter1d(white, self.period[patch.image] / 4))
        return signal + x * self.scene.mean_iof * offset[np.clip(patch.lines, 0, LINES - 1)]


class Jpeg(OnSignal):
    """Cosine coefficients of blocks rounded to steps of the noise, coarser for higher frequencies."""

    name = "jpeg"
    where = "after"
    needs_noise = True
    start, low, high = 1.0, 0.05, 20.0

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        scene = self.scene
        noise = math.sqrt(scene.read_variance + scene.photon_variance * scene.mean_iof)
        step = x * noise * (1 + 0.55 * np.add.outer(np.arange(BLOCK), np.arange(BLOCK)))
        rows, cols = signal.shape
        padded = np.pad(signal, ((0, -rows % BLOCK), (0, -cols % BLOCK)), "edge")
        blocks = padded.reshape(padded.shape[0] // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
        coefficients = np.round(fft.dctn(blocks, axes=(2, 3), norm="ortho") / step) * step
        blocks = fft.idctn(coefficients, axes=(2, 3), norm="ortho").transpose(0, 2, 1, 3)
        return blocks.reshape(padded.shape[0], -1)[:rows, :cols]


class ChargeSmear(OnSignal):
    """Each column of a frame adds a share of its mean: no shutter while it was read."""

    name = "charge_smear"
    needs = Needs(line_scan=False)
    start, low, high = 0.03, 0.001, 0.4

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        return signal + x * signal.mean(0, keepdims=True)


class MotionBlur(Fault):
    """x: detector px along the lines' direction."""

    name = "motion_blur"
    needs = Needs(line_scan=True, margin=18)
    start, low, high = 2.0, 0.8, 7.0

    def departure(self, x: float) -> Departure:
        return Departure(motion=x)


class Moire(OnSignal):
    """A sine of its own period and direction in every image."""

    name = "moire"
    start, low, high = 0.005, 0.0003, 0.1

    def draw_fault(self, rng: np.random.Generator) -> None:
        images = range(self.scene.sites.images)
        self.waves = [(rng.uniform(2.3, 7), rng.random() * np.pi, rng.random() * 6) for _ in images]

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        period, azimuth, phase = self.waves[patch.image]
        along = patch.samples * np.cos(azimuth) + patch.lines * np.sin(azimuth)
        return signal + x * self.scene.mean_iof * 1.414 * np.sin(2 * np.pi * along / period + phase)


class CosmicRays(OnSignal):
    """Bright pixels, and dead ones, at random; x: their share."""

    name = "cosmic_rays"
    start, low, high = 3e-4, 5e-5, 0.01

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        hit = patch.rng.random(signal.shape) < x
        dead = patch.rng.random(signal.shape) < 0.3
        bright = self.scene.mean_iof * patch.rng.exponential(1.0, signal.shape)
        return signal + hit * np.where(dead, -0.9 * signal, bright)


class StrayGradient(OnSignal):
    """Light that grows towards one side of the frame, another side in every image."""

    name = "stray_gradient"

    def draw_fault(self, rng: np.random.Generator) -> None:
        level = self.scene.mean_iof
        self.start, self.low, self.high = 0.02 * level, 0.001 * level, 0.5 * level
        images = range(self.scene.sites.images)
        self.fields = [(rng.random() * 6.28, rng.uniform(0.4, 1.6), rng.standard_normal(3)) for _ in images]

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        azimuth, level, wave = self.fields[patch.image]
        offset = self.scene.camera.offset[patch.image]
        u = (patch.samples - offset[0]) / (self.scene.size * 2.0)
        v = (patch.lines - offset[1]) / (self.scene.size * 2.0)
        growing = level * np.exp(np.clip(u * np.cos(azimuth) + v * np.sin(azimuth), -3, 3))
        return signal + x * (growing + 0.3 * wave[0] * np.sin(3 * u + wave[1]))


class Nearest(Fault):
    """The map projection took the nearest detector pixel."""

    name = "nearest"
    start = low = high = 1.0

    def departure(self, x: float) -> Departure:
        return Departure(resampling=0)


class OddEven(OnSignal):
    """Two amplifiers: odd and even columns with gains of their own."""

    name = "odd_even"
    start, low, high = 0.006, 0.0005, 0.1

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        return signal * (1 + x * (2 * (patch.samples % 2) - 1))


class CoarseQuantisation(OnSignal):
    """x: the step, I/F."""

    name = "coarse_quantisation"
    where = "after"
    needs_noise = True

    def draw_fault(self, rng: np.random.Generator) -> None:
        level = self.scene.mean_iof
        self.start, self.low, self.high = 0.01 * level, 0.001 * level, 0.4 * level

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        return np.round(signal / x) * x


class DustRings(OnSignal):
    """Out-of-focus grains on the detector's window."""

    name = "dust_rings"
    start, low, high = 0.01, 0.0005, 0.2

    def draw_fault(self, rng: np.random.Generator) -> None:
        width, number = self.scene.camera.width, 700
        sample = rng.random(number) * width
        line = rng.random(number) * (4 * width if self.scene.camera.line_scan else width)
        self.grains = np.c_[sample, line, rng.uniform(4, 12, number), rng.uniform(0.4, 1.4, number)]

    def sense(self, signal: Array, patch: Patch, x: float) -> Array:
        samples, lines = patch.samples, patch.lines
        gain = np.ones(signal.shape)
        for sample, line, radius, depth in self.grains:
            beside = samples[0, 0] - 20 < sample < samples[0, -1] + 20
            if beside and lines[0, 0] - 20 < line < lines[-1, 0] + 20:
                away = np.hypot(samples - sample, lines - line)
                gain -= x * depth * 3 * np.exp(-0.5 * ((away - radius) / 1.5) ** 2)
        return signal * gain


_ALL = (  # the dealer draws by position
    Ghost, Banding, Jpeg, ChargeSmear, MotionBlur, Moire, CosmicRays, StrayGradient, Nearest, OddEven,
    CoarseQuantisation, DustRings,
)  # fmt: skip
FAULTS: dict[str, type[Plant]] = {fault.name: fault for fault in _ALL}
