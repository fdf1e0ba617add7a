"""Effects of optics, detector and calibration."""

from __future__ import annotations

import numpy as np

from .exposure import Departure
from .fields import Array, log_uniform, standardised
from .layout import Needs
from .plant import ABSOLUTE, GAINS, Plant


class Echo(Plant):
    name = "echo"
    needs = Needs(margin=28)

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 0.02, rng.uniform(0.004, 0.01), 0.2
        self.lag = int(rng.choice([2, 3, 4, 5, 6, 8, 10, 14])) * int(rng.choice([-1, 1]))
        self.axis = str(rng.choice(["sample", "line"]))
        self.sign = float(rng.choice([1, 1, 1, -1]))

    def departure(self, x: float) -> Departure:
        return Departure(echo=(self.sign * x, self.lag, self.axis))

    def parameters(self, x: float) -> dict:
        return {"fraction": self.sign * x, "lag_px": self.lag, "axis": self.axis}


class PsfBlur(Plant):
    name = "psf_blur"

    def draw(self, rng: np.random.Generator) -> None:
        self.start, self.low, self.high = 0.8, rng.uniform(0.4, 1.0), 5.0

    def departure(self, x: float) -> Departure:
        return Departure(blur_px2=x)

    def parameters(self, x: float) -> dict:
        return {"sigma2_px2": x}


class ImageGain(Plant):
    name = "image_gain"
    measure = GAINS
    start, low, high = 0.03, 0.002, 0.3

    def draw(self, rng: np.random.Generator) -> None:
        self.gains = standardised(rng.standard_normal(self.scene.sites.images))

    def departure(self, x: float) -> Departure:
        return Departure(gain=1 + x * self.gains)

    def parameters(self, x: float) -> dict:
        return {"rms": x}


class ColumnPattern(Plant):
    """Vignetting off the centre and waves across the detector."""

    name = "column_pattern"
    start, low, high = 0.01, 0.003, 0.03

    def draw(self, rng: np.random.Generator) -> None:
        width = self.scene.camera.width
        u = np.arange(width) / width
        pattern = -1.2 * (u - rng.uniform(0.3, 0.7)) ** 2 * 4
        for order in range(2, 9):
            wave = rng.standard_normal() / order
            pattern = pattern + wave * np.cos(np.pi * order * u + rng.random() * 6)
        self.pattern = standardised(pattern)

    def departure(self, x: float) -> Departure:
        return Departure(columns=1 + x * self.pattern)

    def parameters(self, x: float) -> dict:
        """Over the samples that the data show."""
        samples = np.concatenate([part.ravel()[::5] for part in self.clean.samples])
        at = np.clip(np.round(samples).astype(int), 0, self.scene.camera.width - 1)
        seen = 1 + x * self.pattern[at]
        return {"rms": float(seen.std() / seen.mean())}


class DarkBias(Plant):
    name = "dark_bias"
    measure = ABSOLUTE
    needs = Needs(low_sun=True)

    def draw(self, rng: np.random.Generator) -> None:
        level = self.scene.mean_iof
        self.start, self.low, self.high = 0.05 * level, log_uniform(rng, 0.003, 0.01) * level, 0.5 * level
        self.sign = float(rng.choice([1, 1, -1]))

    def departure(self, x: float) -> Departure:
        return Departure(dark=self.sign * x)

    def parameters(self, x: float) -> dict:
        return {"iof": self.sign * x}


class Nonlinearity(Plant):
    name = "nonlinearity"

    def draw(self, rng: np.random.Generator) -> None:
        self.form = str(rng.choice(["quadratic", "log"]))
        level = self.scene.mean_iof
        if self.form == "quadratic":
            self.start, self.low, self.high = 0.05 / level, 0.002 / level, min(9, 0.6 / level)
        else:
            self.start, self.low, self.high = 0.05, 0.003, 0.3

    def departure(self, x: float) -> Departure:
        value = self.sign * x
        return Departure(nonlinearity=(value, 0.0) if self.form == "quadratic" else (0.0, value))

    def parameters(self, x: float) -> dict:
        return {self.form: self.sign * x}


class Saturation(Plant):
    """x is the share of the clean images' pixels that clip."""

    name = "saturation"
    start, low, high = 0.1, 0.002, 0.6
    _levels: Array | None = None

    def level(self, x: float) -> float:
        if self._levels is None:
            self._levels = np.concatenate([part.ravel()[::7] for part in self.clean.images])
        return float(np.quantile(self._levels, 1 - x))

    def departure(self, x: float) -> Departure:
        return Departure(saturation=self.level(x))

    def parameters(self, x: float) -> dict:
        return {"iof": self.level(x)}


EFFECTS = (Echo, PsfBlur, ImageGain, ColumnPattern, DarkBias, Nonlinearity, Saturation)
