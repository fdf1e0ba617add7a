"""Spectra of what the DEM and the map lack, and the noise of the photographs, from windows that they share.

Each round solves every window at the present values and sets the variances anew: a wave's variance is the mean square of
what was found over the share that images determine, that of the noise the mean square of what is left over the share that
they do not (MacKay 1992, Neural Comput. 4:415). Both shares come from one draw of each window's posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import nnls

from stages.common.arrays import Floats, Floats32
from stages.common.progress import Progress, show_nothing
from stages.physics.images.spectrum import WAVELENGTHS, Spectrum, by_wavelength, waves
from stages.refine.patch import Noise, Patch, Residual
from stages.refine.solve import FIELDS, Posterior, Priors

ROUNDS = 7
REFRESHED = (2, 4)  # rounds before which horizons are taken anew
STEP = 10.0  # by which a variance changes at most in a round
SEED = 69
LEAST_SHARE = 0.02  # of a wave's variance that images determine
LONGEST_PX = 16.0  # broader relief is the DEM's: of its error nothing is learned there
TOLD = 0.3  # from where on the found power tells a variance by itself
TRUST = (0.05, 2.0)  # F, set on the Apollo film frames and the case 'smooth' of tests/validation/refine.py
DARK = 0.2  # of the median brightness: below it errors no longer fall with the brightness
BINS = 8  # of brightness, for the noise


@dataclass
class Sums:
    """Over all windows: by field and wavelength the power found (2, K), that of draws (2, K) and the waves (K,); of what images say, by
    wavelength, the power left, that of its draws, and what white noise of the assumed variance would have
    """

    found: Floats = field(default_factory=lambda: np.zeros((FIELDS, len(WAVELENGTHS))))
    drawn: Floats = field(default_factory=lambda: np.zeros((FIELDS, len(WAVELENGTHS))))
    waves: Floats = field(default_factory=lambda: np.zeros(len(WAVELENGTHS)))
    left: Floats = field(default_factory=lambda: np.zeros(len(WAVELENGTHS)))
    fitted: Floats = field(default_factory=lambda: np.zeros(len(WAVELENGTHS)))
    white: Floats = field(default_factory=lambda: np.zeros(len(WAVELENGTHS)))

    def add(self, posterior: Posterior, gradient: Floats32, around: Floats32, found: Floats32, draw: Floats32) -> None:
        """Count one window."""
        for k in range(FIELDS):
            self.found[k] += by_wavelength(waves(found[k]) ** 2)
            self.drawn[k] += by_wavelength(waves(draw[k]) ** 2)
        count = by_wavelength(np.ones(posterior.shape, np.float32))
        self.waves += count
        self.left += by_wavelength(np.square(waves(posterior.misfit(gradient, around, found))).sum(axis=0))
        self.fitted += by_wavelength(np.square(waves(posterior.seen(draw))).sum(axis=0))
        self.white += count * posterior.occupied


def learn(
    patches: Sequence[Patch], priors: Priors, noise: Noise, progress: Progress = show_nothing
) -> tuple[Priors, Noise, list[Floats32]]:
    """Spectra and noise from windows; also the fields (2, H, W) of each.

    priors, noise : where to start; heights of no variance stay what the DEM says
    """
    rng = np.random.default_rng(SEED)
    starts = [patch.start() for patch in patches]
    fields = list(starts)
    heights = bool(priors.heights.variance.any())
    for number in range(ROUNDS):
        sums, seen = Sums(), Seen(len(noise.absolute))
        for k, patch in enumerate(patches):
            progress(number * len(patches) + k, ROUNDS * len(patches), "spectra, windows")
            if heights and number in REFRESHED:
                patch.refresh(fields[k][0])
            evidence = patch.evidence(fields[k], starts[k], noise, relinearise=number in REFRESHED)
            posterior = Posterior(evidence.products, patch.px, priors)
            found = posterior.mean(evidence.gradient, fields[k], number > 0)
            sums.add(posterior, evidence.gradient, fields[k], found, posterior.draw(rng))
            fields[k] = found
            seen.add(evidence.residuals)
        noise = seen.noise(noise)
        priors = _updated(priors, sums)
    return priors, noise, fields


def _updated(priors: Priors, sums: Sums) -> Priors:
    spectra = []
    given = (priors.heights, LONGEST_PX), (priors.albedo, np.inf)
    for (spectrum, longest), found, drawn in zip(given, sums.found, sums.drawn, strict=True):
        before = spectrum.variance
        if not before.any():
            spectra.append(spectrum)
            continue
        count = np.maximum(sums.waves, 1)
        told = 1 - drawn / count / before
        now = np.where(told > TOLD, found / count / np.maximum(told, TOLD), (found + drawn) / count)
        spectra.append(Spectrum(_bounded(np.clip(now, before / STEP, before * STEP), told, longest)))
    before = priors.trust.variance
    free = np.maximum(1 - sums.fitted * before / np.maximum(sums.white, 1e-30), LEAST_SHARE)
    now = free * sums.white / np.maximum(sums.left, 1e-30)
    return Priors(spectra[0], spectra[1], Spectrum(np.clip(np.clip(now, before / STEP, before * STEP), *TRUST)))


def _bounded(variance: Floats, told: Floats, longest: float) -> Floats:
    """Waves that images do not determine have no more variance than the next ones towards those that they determine best.

    longest : px, of waves that they determine at all
    """
    variance, best = variance.copy(), int(np.argmax(np.where(longest < WAVELENGTHS, -1, told)))
    for k in [*range(best + 1, len(told)), *range(best - 1, -1, -1)]:
        if told[k] < TOLD or WAVELENGTHS[k] > longest:
            variance[k] = min(variance[k], variance[k - 1 if k > best else k + 1])
    return variance


class Seen:
    """Residuals of each image by brightness."""

    def __init__(self, count: int) -> None:
        self._pixels: list[list[tuple[Floats32, Floats32]]] = [[] for _ in range(count)]

    def add(self, residuals: Sequence[Residual]) -> None:
        """Take the residuals of one window's images, every seventh pixel."""
        for r in residuals:
            usable = r.variance > 0
            predicted = r.predicted.image[usable][::7]
            self._pixels[r.k].append((predicted, predicted * r.relative[usable][::7]))

    def noise(self, before: Noise) -> Noise:
        """Absolute and relative variance of each image."""
        absolute, relative = before.absolute.copy(), before.relative.copy()
        for k, pieces in enumerate(self._pixels):
            if sum(len(p[0]) for p in pieces) < 20 * BINS:
                continue
            predicted, residual = (np.concatenate([p[i] for p in pieces]).astype(float) for i in (0, 1))
            absolute[k], relative[k] = _variances(predicted, residual)
        return Noise(absolute, relative)


def _variances(predicted: Floats, residual: Floats) -> tuple[float, float]:
    """(absolute, relative) variance, from the middle of the residuals in bins of brightness."""
    edges = np.quantile(predicted, np.linspace(0, 1, BINS + 1))
    place = np.clip(np.searchsorted(edges, predicted, "right") - 1, 0, BINS - 1)
    rows, values = [], []
    for k in range(BINS):
        mine = residual[place == k]
        if len(mine) < 20:
            continue
        variance = (1.4826 * float(np.median(np.abs(mine)))) ** 2
        rows.append([1.0, float(np.mean(predicted[place == k] ** 2))])
        values.append(variance)
    weight = 1 / np.maximum(values, 1e-12)
    found, _ = nnls(np.array(rows) * weight[:, None], np.array(values) * weight)
    relative = float(max(found[1], 1e-8))
    return max(float(found[0]), relative * (DARK * float(np.median(predicted))) ** 2), relative
