"""Whether heights help: each image left out in turn, predicted by the others with and without them, on the same windows.

The map without heights is that of ``lunargr albedo`` from the same images. Squared errors are compared window by window;
the correction counts if the 95 % interval of its gain lies above zero.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stages.common.arrays import Floats32
from stages.common.intervals import gain_interval
from stages.common.progress import Progress, show_nothing
from stages.photographs.calibrate import COSINES, Calibration
from stages.photographs.ground import Ground
from stages.photographs.intervals import unseen_widths
from stages.photographs.posterior import estimate, robust_mean
from stages.photographs.prior import terrain_variance
from stages.physics.images.spectrum import WAVELENGTHS, Spectrum, by_wavelength, waves
from stages.physics.images.windows import WINDOW_PX, choose_windows
from stages.physics.maps.window import Box, Window
from stages.physics.terrain.surface import SHADOWED
from stages.refine.fit import fit, variances
from stages.refine.learn import SEED, learn
from stages.refine.patch import Noise, Patch
from stages.refine.solve import FIELDS, Priors

WINDOWS = 16
MARGIN_PX = 16  # around windows: read, and not judged
FOLDS = 4
ENOUGH = 8  # windows; where there are fewer, their quarters are the units of ground
THINNED = 5
SLOPE, FLAT_PX = (
    0.05,
    8.0,
)  # where the search for spectra starts: slope of a wave, constant heights from this wavelength on


@dataclass(frozen=True)
class Learned:
    """Of one map. gain : percent, low, high; reason : why heights stay, empty where they do not

    interval : (2, bins), shadow : (2,) half-widths for an unseen image, as in ``Calibration``
    """

    calibration: Calibration
    priors: Priors
    noise: Noise
    gain: tuple[float, float, float]
    reason: str

    def as_text(self) -> dict[str, Any]:
        """What JSON holds of it."""
        spectra = {k: getattr(self.priors, k).variance.tolist() for k in ("heights", "albedo", "trust", "widening")}
        noise = {"absolute": self.noise.absolute.tolist(), "relative": self.noise.relative.tolist()}
        return {
            "calibration": self.calibration.as_text(), "spectra": spectra, "noise": noise,
            "gain": [v if math.isfinite(v) else None for v in self.gain], "reason": self.reason,
        }  # fmt: skip

    @staticmethod
    def from_text(text: dict[str, Any]) -> Learned:
        """The inverse of :meth:`as_text`."""
        spectra = {k: Spectrum(np.array(v, float)) for k, v in text["spectra"].items()}
        noise = {k: np.array(v, float) for k, v in text["noise"].items()}
        low, middle, high = (math.nan if v is None else float(v) for v in text["gain"])
        calibration = Calibration.from_text(text["calibration"])
        return Learned(calibration, Priors(**spectra), Noise(**noise), (low, middle, high), str(text["reason"]))


@dataclass
class Scores:
    """Of pairs of window and image left out. ours, other : sums of squared errors with and without heights; unit : of ground

    residual, place, image : (N,) of pixels, for the intervals
    """

    ours: list[float]
    other: list[float]
    unit: list[tuple[int, ...]]
    residual: list[Floats32]
    place: list[Any]
    image: list[Any]


@dataclass(frozen=True)
class Turn:
    """Waves (2, H, W) of what the images found without some, of a draw about it, and of what noise alone did to it."""

    found: Floats32
    draw: Floats32
    noise: Floats32


class Turns:
    """How much more what images find differs with the choice of images than their noise says: the jackknife (Tukey 1958) by wavelength."""

    def __init__(self) -> None:
        self._more, self._drawn = np.zeros((2, FIELDS, len(WAVELENGTHS)))

    def add(self, turns: Sequence[Turn]) -> None:
        """Count one window's."""
        count = len(turns)
        if count < 2:
            return
        mean = np.mean([turn.found for turn in turns], axis=0)
        for turn in turns:
            for k in range(FIELDS):
                more = (turn.found[k] - mean[k]) ** 2 - turn.noise[k] ** 2 / count
                self._more[k] += by_wavelength(more) * (count - 1) / count
                self._drawn[k] += by_wavelength(turn.draw[k] ** 2) / count

    def widening(self) -> Spectrum:
        """(2, K) factors of the variances of heights and log albedo."""
        return Spectrum(1 + np.maximum(self._more, 0) / np.maximum(self._drawn, 1e-30))


def find_out(ground: Ground, form: str | None, progress: Progress = show_nothing) -> Learned:
    """Calibration, spectra, noise and gain of a map's photographs. form : of displacement, as in ``Ground.calibrate``"""
    calibration = ground.calibrate(form, progress)
    shape, count = ground.map["valid"].shape, len(ground.references.frames)
    windows = choose_windows(shape, count, ground.references.overlapping)[:WINDOWS]
    boxes = [Window(*box).padded(MARGIN_PX, shape) for box in windows]
    patches = [Patch(ground, calibration, box) for box in boxes]
    priors, noise, _ = learn(patches, *_start(patches, calibration), progress)
    scores, turns = Scores([], [], [], [], [], []), Turns()
    folds = min(FOLDS, count)
    for number, (patch, window) in enumerate(zip(patches, windows, strict=True)):
        found = []
        for fold in range(folds if count > 1 else 0):
            progress(number * folds + fold, len(windows) * folds, "images left out")
            left = {k for k in range(count) if k % folds == fold}
            found += _score(scores, ground, calibration, patch, window, (priors, noise), left)
        turns.add(found)
    priors = replace(priors, widening=turns.widening())
    gain, reason = _decide(scores, len(windows), count)
    return Learned(_with_intervals(calibration, scores), priors, noise, gain, reason)


def _start(patches: Sequence[Patch], calibration: Calibration) -> tuple[Priors, Noise]:
    """Where the search for spectra and noise starts."""
    wave = 2 * np.pi / WAVELENGTHS / patches[0].px[0]
    flat = 2 * np.pi / FLAT_PX / patches[0].px[0]
    heights = Spectrum((SLOPE / np.maximum(wave, flat)) ** 2)
    albedo = Spectrum(1e-3 * (WAVELENGTHS / 4) ** 2)
    relative = np.maximum(calibration.spread.own_px, 1e-6)
    return Priors(heights, albedo, Spectrum(np.ones(len(WAVELENGTHS)))), Noise(np.zeros(len(relative)), relative)


def _score(
    scores: Scores, ground: Ground, calibration: Calibration, patch: Patch, window: Box,
    learned: tuple[Priors, Noise], left: Collection[int],
) -> list[Turn]:  # fmt: skip
    """Count the images ``left`` out of one window, as the others predict them; what these find, if any are left."""
    used = [p.k for p in patch.photographs if p.k not in left]
    tested = [p for p in patch.photographs if p.k in left]
    if not used or not tested:
        return []
    priors, noise = learned
    patch.refresh(None)
    plain = patch.start(used)
    fields = plain.copy()
    plain[1] = _shared_albedo(ground, calibration, patch, used)
    without = [patch.predict(p, plain).image for p in tested]
    fields, posterior, evidence = fit(patch, fields, priors, noise, used)
    rng = np.random.default_rng([SEED, *window[:2], min(left)])
    turn = Turn(*(waves(x) for x in (fields, posterior.draw(rng), posterior.draw(rng, prior=False))))
    std = np.sqrt(variances(posterior, evidence, priors, 1, rng)[1])
    own = float(np.median(calibration.spread.own.sum(axis=1)))
    judged, others = Window(*window).within(patch.box), np.zeros(patch.shape, np.uint8)
    for photograph in patch.photographs:
        if photograph.k in used:
            others[photograph.box.within(patch.box).part] += np.isfinite(photograph.measured)
    for photograph, before in zip(tested, without, strict=True):
        found, box = patch.predict(photograph, fields), photograph.box.within(patch.box)
        known = np.zeros(box[2:], bool)
        known[max(0, judged.row - box.row) : max(0, judged.row + judged.height - box.row),
              max(0, judged.col - box.col) : max(0, judged.col + judged.width - box.col)] = True  # fmt: skip
        known &= np.isfinite(before) & np.isfinite(found.image) & np.isfinite(photograph.measured)
        known &= others[box.part] > 1  # one image tells neither heights nor albedo
        # as one who has not seen it takes it: a calibrated image has no gain of its own
        measured = photograph.measured * np.float32(calibration.gain[photograph.k] if ground.units == "iof" else 1)
        errors = [np.where(known, (v - measured) ** 2, 0) for v in (found.image, before)]
        for part, corner in _quarters(box, judged):
            sums = [float(e[part].sum(dtype=float)) for e in errors]
            if known[part].any():
                scores.ours.append(sums[0])
                scores.other.append(sums[1])
                scores.unit.append((*window[:2], *corner))
        shadow = found.shadow > SHADOWED
        unit = np.sqrt(std[box.part] ** 2 + own) * np.abs(found.image)
        unit = np.where(shadow, max(photograph.sun_sine(ground.references.surface.grid), 1e-3), unit)
        use = known & (unit > 0)
        place = np.clip(np.digitize(found.cosine, COSINES) - 1, 0, len(COSINES) - 2)
        scores.place.append(np.where(shadow, len(COSINES) - 1, place)[use][::THINNED])
        scores.residual.append((np.sqrt(errors[0])[use] / unit[use])[::THINNED].astype(np.float32))
        scores.image.append(np.full(len(scores.place[-1]), photograph.k, np.intp))
    patch.refresh(None)
    return [turn]


def _quarters(box: Window, judged: Window) -> list[tuple[tuple[slice, slice], tuple[int, int]]]:
    """The parts of an image's window in the quarters of the judged one, and which quarter each is."""
    found = []
    for down in (0, 1):
        for right in (0, 1):
            row, col = judged.row + down * WINDOW_PX // 2, judged.col + right * WINDOW_PX // 2
            rows = slice(max(0, row - box.row), max(0, row + WINDOW_PX // 2 - box.row))
            cols = slice(max(0, col - box.col), max(0, col + WINDOW_PX // 2 - box.col))
            found.append(((rows, cols), (down, right)))
    return found


def _shared_albedo(ground: Ground, calibration: Calibration, patch: Patch, used: Sequence[int]) -> Floats32:
    """(H, W) log albedo of ``lunargr albedo`` from the images used."""
    ratio, confidence, images = patch.ratios(used)
    spread = calibration.spread.of(images)
    robust_mean(ratio, confidence, spread)
    return estimate(ratio, confidence, spread, terrain_variance(ground.surface, patch.box))[0]


def _decide(scores: Scores, windows: int, count: int) -> tuple[tuple[float, float, float], str]:
    """The gain with its interval, and why the heights stay, empty where they do not."""
    if count < 2:
        return (math.nan,) * 3, "one image: none is left to judge by"
    if not scores.ours:
        return (math.nan,) * 3, "no two images show the same ground"
    corners = np.array(scores.unit)
    names = corners[:, :2] if windows >= ENOUGH else corners
    unit = np.unique(names, axis=0, return_inverse=True)[1].ravel()
    gain = gain_interval(np.array(scores.ours), np.array(scores.other), unit)
    found = gain.value, gain.low, gain.high
    if not math.isfinite(gain.low):
        return found, "too little ground to judge by"
    if gain.low > 0:
        return found, ""
    return found, (
        f"images left out gain {gain.value:+.1f} % ({gain.low:+.1f} to {gain.high:+.1f}), not surely more than nothing"
    )


def _with_intervals(calibration: Calibration, scores: Scores) -> Calibration:
    """The calibration with intervals of the images left out, where there are any."""
    if not scores.residual:
        return calibration
    residual, place, image = (np.concatenate(v) for v in (scores.residual, scores.place, scores.image))
    bins, lit = len(COSINES) - 1, place < len(COSINES) - 1
    interval, shadow = calibration.interval, calibration.shadow
    if lit.any():
        interval = unseen_widths(residual[lit], place[lit], image[lit], bins)
        if not lit.all():
            shadow = unseen_widths(residual[~lit], place[~lit] - bins, image[~lit], 1)[:, 0]
    return replace(calibration, interval=interval, shadow=shadow)
