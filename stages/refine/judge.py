"""Whether heights help: images left out in turn, predicted by the others with and without them, on the same windows.

Without them: the same posterior with the DEM's heights, and the map of ``lunargr albedo``. Squared errors are compared
window by window, each with the image's best gain there: its level is the reflectance's and tells nothing of heights. The
correction counts if the 95 % intervals of its gain over both lie above zero.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats32, Mask
from stages.common.intervals import gain_interval
from stages.common.progress import Progress, show_nothing
from stages.photographs.calibrate import COSINES, Calibration
from stages.photographs.ground import Ground
from stages.photographs.intervals import unseen_widths
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
SLOPE = 0.05  # of a wave, where the search for spectra starts
FLAT_PX = 8.0  # and from this wavelength on heights of one variance


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
    """Sums of squared errors of pairs of window and image left out: with heights, with those of the DEM, of ``lunargr albedo``.

    unit : of ground
    """

    refined: list[float] = field(default_factory=list)
    held: list[float] = field(default_factory=list)
    albedo: list[float] = field(default_factory=list)
    unit: list[tuple[int, ...]] = field(default_factory=list)


@dataclass(frozen=True)
class Judged:
    """Pixels (N,) of image ``k``, left out. at : in the window, row by row; residual, image : measured and predicted I/F

    place : bin of the cosine of incidence, the last one shadow; least : I/F, standard deviation in shadow
    """

    k: int
    at: Any
    residual: Floats32
    image: Floats32
    place: Any
    least: float


@dataclass(frozen=True)
class Turn:
    """What the images found without some: waves (2, H, W) of it, of a draw about it, and of what noise alone did to it.

    doubt : see ``Evidence``
    """

    found: Floats32
    draw: Floats32
    noise: Floats32
    doubt: Floats32
    judged: list[Judged]


class Widening:
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

    def spectrum(self) -> Spectrum:
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
    scores, turns, widening = Scores(), [], Widening()
    folds = min(FOLDS, count)
    for number, (patch, window) in enumerate(zip(patches, windows, strict=True)):
        mine = []
        for fold in range(folds):
            progress(number * folds + fold, len(windows) * folds, "images left out")
            left = {k for k in range(count) if k % folds == fold}
            mine += _score(scores, ground, calibration, patch, window, (priors, noise), left)
        widening.add(mine)
        turns += mine
    priors = replace(priors, widening=widening.spectrum())
    gain, reason = _decide(scores, len(windows))
    return Learned(_with_intervals(calibration, priors, turns), priors, noise, gain, reason)


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
    start = patch.start(used)
    held, _, _ = fit(patch, start, replace(priors, heights=Spectrum(np.zeros(len(WAVELENGTHS)))), noise, used)
    without = [[patch.predict(p, fields).image for fields in (held, start)] for p in tested]
    fields, posterior, evidence = fit(patch, start, priors, noise, used)
    rng = np.random.default_rng([SEED, *window[:2], min(left)])
    mean, draw, noise_alone = (waves(x) for x in (fields, posterior.draw(rng), posterior.draw(rng, prior=False)))
    turn = Turn(mean, draw, noise_alone, evidence.doubt, [])
    quarter, others = _quarters(patch, window), np.zeros(patch.shape, np.uint8)
    for p in patch.photographs:
        if p.k in used:
            others[p.box.within(patch.box).part] += np.isfinite(p.measured)
    for p, before in zip(tested, without, strict=True):
        after, values = patch.predict(p, fields), np.full((6, *patch.shape), np.nan, np.float32)
        # as one who has not seen it takes it: a calibrated image has no gain of its own
        measured = p.measured * np.float32(calibration.gain[p.k] if ground.units == "iof" else 1)
        values[:, *p.box.within(patch.box).part] = measured, after.image, *before, after.cosine, after.shadow
        # one image tells neither heights nor albedo
        known = np.isfinite(values).all(axis=0) & (quarter >= 0) & (others > 1)
        errors = _squares(values[0], values[1:4], known)
        for k in np.unique(quarter[known]):
            here = errors[:, known & (quarter == k)].sum(axis=1, dtype=float)
            for sums, value in zip((scores.refined, scores.held, scores.albedo), here, strict=True):
                sums.append(float(value))
            scores.unit.append((*window[:2], int(k)))
        place = np.clip(np.digitize(values[4], COSINES) - 1, 0, len(COSINES) - 2)
        place[values[5] > SHADOWED] = len(COSINES) - 1
        at = np.flatnonzero(known)[::THINNED]
        residual, image, bins = (v.ravel()[at] for v in (np.abs(values[1] - values[0]), values[1], place))
        least = max(p.sun_sine(ground.references.surface.grid), 1e-3)
        turn.judged.append(Judged(p.k, at, residual, image, bins, least))
    patch.refresh(None)
    return [turn]


def _squares(measured: Floats32, predicted: Floats32, known: Mask) -> Floats32:
    """(n, H, W) squared errors of ``predicted``, each times the gain that fits (H, W) ``measured`` best where ``known``."""
    own = predicted[:, known]
    gain = own @ measured[known] / np.maximum(np.square(own).sum(axis=1), 1e-30)
    return np.asarray((gain[:, None, None] * predicted - measured) ** 2, np.float32)


def _quarters(patch: Patch, window: Box) -> NDArray[np.int8]:
    """(H, W) the quarter of the judged window, 0 to 3, that a pixel lies in, -1 around it."""
    found = np.full(patch.shape, -1, np.int8)
    judged = Window(*window).within(patch.box)
    rows, cols = np.indices((judged.height, judged.width))
    found[judged.part] = 2 * (rows >= WINDOW_PX // 2) + (cols >= WINDOW_PX // 2)
    return found


def _decide(scores: Scores, windows: int) -> tuple[tuple[float, float, float], str]:
    """The gain with its interval, and why the heights stay, empty where they do not."""
    if not scores.unit:  # one is left out, and one alone tells neither heights nor albedo
        return (math.nan,) * 3, "no three images show the same ground"
    corners = np.array(scores.unit)
    names = corners[:, :2] if windows >= ENOUGH else corners
    unit = np.unique(names, axis=0, return_inverse=True)[1].ravel()
    heights, all_of_it = (
        gain_interval(np.array(scores.refined), np.array(v), unit) for v in (scores.held, scores.albedo)
    )
    found = all_of_it.value, all_of_it.low, all_of_it.high
    for gain, what in ((heights, "heights"), (all_of_it, "heights and albedo")):
        if not math.isfinite(gain.low):
            return found, "too little ground to judge by"
        if not gain.low > 0:
            return found, (
                f"images left out gain {gain.value:+.1f} % by {what} ({gain.low:+.1f} to {gain.high:+.1f}), "
                "not surely more than nothing"
            )
    return found, ""


def _with_intervals(calibration: Calibration, priors: Priors, turns: Sequence[Turn]) -> Calibration:
    """The calibration with intervals of the images left out, where there are any."""
    own, units, seen = float(np.median(calibration.spread.own.sum(axis=1))), [], []
    for turn in turns:
        variance = variances(priors, [turn.draw], turn.doubt)[1].ravel() + own
        for j in turn.judged:
            units.append(np.where(j.place == len(COSINES) - 1, j.least, np.sqrt(variance[j.at]) * np.abs(j.image)))
            seen.append(j)
    if not seen:
        return calibration
    unit, place = np.concatenate(units), np.concatenate([j.place for j in seen])
    residual, image = (np.concatenate(v) for v in ([j.residual for j in seen], [np.full(len(j.at), j.k) for j in seen]))
    bins = len(COSINES) - 1
    lit, dark = (unit > 0) & (place < bins), (unit > 0) & (place == bins)
    interval, shadow = calibration.interval, calibration.shadow
    if lit.any():
        interval = unseen_widths(residual[lit] / unit[lit], place[lit], image[lit], bins)
    if lit.any() and dark.any():
        shadow = unseen_widths(residual[dark] / unit[dark], place[dark] - bins, image[dark], 1)[:, 0]
    return replace(calibration, interval=interval, shadow=shadow)
