"""What the photographs say of themselves before any of them may say anything of the ground: gain and offset of each, how
much of what they show beyond the map is shared, and each one's own error, by structure size.

All from a sample of windows, so that it takes a bounded time and every shard finds the same. The shared variance is the
mean product of different images over the same ground: errors of one image have no part in it, and where images do not
agree it is 0 and the map stays as it is. (Moment estimates of variance components: Searle, Casella & McCulloch 1992,
"Variance Components", ch. 5.)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from schemas.checks import parse_json
from schemas.errors import ArtefactError
from stages.common.arrays import Floats, Floats32
from stages.common.progress import Progress, show_nothing
from stages.photographs.intervals import GAUSSIAN, Stack, unseen_intervals
from stages.photographs.posterior import Spread, robust_mean
from stages.photographs.pyramid import LEVELS, bands
from stages.physics.formation.radiometry import fit_line
from stages.physics.images.displacement import Field
from stages.physics.images.references import Observed, References
from stages.physics.images.registered import as_text, from_text
from stages.physics.maps.window import Box

ROUNDS = 6
SETTLED = 0.05  # relative change of all variances below which no further round is made
COSINES = np.linspace(0.0, 1.0, 17)  # bins of cos(incidence) over which the error may differ
STEPS = 200  # of the fit of variances to those of differences
OUTLYING = 4.0  # robust standard deviations
FARTHEST = 3.0  # |log ratio| beyond which nothing is measured any more


@dataclass(frozen=True)
class Calibration:
    """gain, offset : (n,), measured = gain x I/F x albedo + offset; spread : variances of log ratios;
    error : relative variance of an image's error at the cosines of incidence ``COSINES``; interval : (2, bins), half-widths
    of the 68 and 95 % intervals of an unseen image, in standard deviations, by the same bins; shadow : (2,) the same in
    shadow, I/F over the sine of the Sun's elevation; fields : what registration takes off each image, empty without it
    """

    gain: Floats
    offset: Floats
    spread: Spread
    error: Floats
    interval: Floats
    shadow: Floats
    fields: tuple[Field | None, ...] = ()

    def ratio(self, k: int, observed: Observed) -> tuple[Floats32, Floats32]:
        """(log of measured / predicted, confidence), both 0 where the image says nothing."""
        expected = self.gain[k] * observed.predicted
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(np.maximum((observed.measured - self.offset[k]) / expected, np.exp(-FARTHEST)))
        known = np.isfinite(ratio) & observed.usable
        ratio = np.where(known, np.minimum(ratio, FARTHEST), 0).astype(np.float32)
        confidence = 1.0 / np.interp(observed.cos_incidence, _middles(), self.error)
        return ratio, np.where(known, confidence, 0).astype(np.float32)

    def as_text(self) -> dict[str, Any]:
        """What JSON holds of it."""
        values = {"gain": self.gain, "offset": self.offset, "error": self.error}
        values |= {"interval": self.interval, "shadow": self.shadow}
        values |= {
            "prior": self.spread.prior,
            "shared": self.spread.shared,
            "own": self.spread.own,
            "own_px": self.spread.own_px,
        }
        text: dict[str, Any] = {k: v.tolist() for k, v in values.items()} | {"shared_px": self.spread.shared_px}
        return text | {"fields": as_text(self.fields)}

    @staticmethod
    def from_text(text: dict[str, Any]) -> Calibration:
        """The inverse of :meth:`as_text`."""
        shared_px, fields = float(text["shared_px"]), tuple(from_text(text["fields"]))
        v = {k: np.array(values, float) for k, values in text.items() if k not in ("shared_px", "fields")}
        spread = Spread(v["shared"], v["own"], shared_px, v["own_px"], v["prior"])
        return Calibration(v["gain"], v["offset"], spread, v["error"], v["interval"], v["shadow"], fields)


def write_calibration(path: Path, text: dict[str, Any], made_from: dict[str, Any]) -> None:
    """Write a calibration as JSON. made_from : the inputs and options that it holds for"""
    path.write_text(json.dumps(text | {"made_from": made_from}))


def read_calibration(path: Path, made_from: dict[str, Any], command: str) -> dict[str, Any]:
    """Read what :func:`write_calibration` wrote for the same inputs and options. Raises ArtefactError for anything else."""
    advice = f"make it with 'lunargr {command} ... -o calibration.json'"
    try:
        text = parse_json(path.read_text(), str(path), advice=advice)
    except (OSError, UnicodeDecodeError) as error:
        raise ArtefactError(f"{path}: expected a calibration as JSON, found none ({error}); {advice}.") from None
    found = text.pop("made_from", None) if isinstance(text, dict) else None
    if found != made_from:
        changed = [k for k, v in made_from.items() if found.get(k) != v] if isinstance(found, dict) else ["made_from"]
        raise ArtefactError(
            f"{path}: expected the calibration of these files and options, found another ({', '.join(changed)}); {advice}."
        )
    return text


@dataclass
class Sample:
    """One window with all images that see it. prior : (h, w) variance of what the map may be wrong by, None where unknown"""

    prior: Floats32 | None = None
    images: list[int] = field(default_factory=list)
    observations: list[Observed] = field(default_factory=list)


def take_samples(
    references: References,
    windows: Sequence[Box],
    progress: Progress = show_nothing,
    prior: Callable[[Box], Floats32 | None] = lambda box: None,
) -> list[Sample]:
    """What the images show of some windows, one sample each. prior : (h, w) of a window's, as :func:`posterior.estimate` takes it"""
    samples = []
    for number, box in enumerate(windows):
        progress(number, len(windows), "calibration windows")
        sample = Sample(prior(box))
        for k in references.overlapping(box):
            observed = references.observe(k, box)
            if observed is not None:
                sample.images.append(k)
                sample.observations.append(observed)
        if sample.images:
            samples.append(sample)
    return samples


def calibrate(samples: Sequence[Sample], count: int, units: str) -> Calibration:
    """Gains, offsets and variances of ``count`` images from windows that they share; units : iof or dn"""
    own = np.full((count, LEVELS + 1), 0.01)
    bins = len(COSINES) - 1
    spread = Spread(np.full(LEVELS + 1, 0.01), own, 0.01, own[:, 0].copy(), np.full(LEVELS + 1, 0.01))
    unknown = np.tile(np.array(GAUSSIAN)[:, None], bins)
    result = Calibration(np.ones(count), np.zeros(count), spread, np.ones(bins), unknown, np.zeros(2))
    albedo: list[Any] = [0.0] * len(samples)
    for _ in range(ROUNDS):
        gain, offset = _scales(samples, albedo, count, units)
        result = replace(result, gain=gain, offset=offset)
        stacks = [_stack(result, sample) for sample in samples]
        albedo = [
            robust_mean(ratio, confidence.copy(), result.spread.of(sample.images))
            for sample, (ratio, confidence) in zip(samples, stacks, strict=True)
        ]
        _winsorize(samples, stacks, albedo, count)
        before = result.spread.own_px
        result = replace(result, spread=_variances(samples, stacks, count))
        result = replace(result, error=_error(samples, stacks, albedo, result.spread.own_px))
        if np.abs(np.log(np.maximum(result.spread.own_px, 1e-12) / np.maximum(before, 1e-12))).max() < SETTLED:
            break
    interval, shadow = unseen_intervals([_unseen(result, sample, units) for sample in samples], result.spread, COSINES)
    return replace(result, interval=_rounded(interval), shadow=_rounded(shadow))


def _unseen(calibration: Calibration, sample: Sample, units: str) -> Stack:
    """A window with its images in I/F as one who has not seen them takes them: calibrated ones have no gain of their own."""
    scaled = [
        observed.measured if units == "iof" else (observed.measured - calibration.offset[k]) / calibration.gain[k]
        for k, observed in zip(sample.images, sample.observations, strict=True)
    ]
    measured = [v.astype(np.float32) for v in scaled]
    return Stack(*_stack(calibration, sample), sample.images, sample.observations, measured, sample.prior)


def _stack(calibration: Calibration, sample: Sample) -> tuple[Floats32, Floats32]:
    found = [calibration.ratio(k, observed) for k, observed in zip(sample.images, sample.observations, strict=True)]
    return np.stack([f[0] for f in found]), np.stack([f[1] for f in found])


def _winsorize(
    samples: Sequence[Sample], stacks: Sequence[tuple[Floats32, Floats32]], albedo: Sequence[Any], count: int
) -> None:
    """Clip ratios, in place, to OUTLYING robust standard deviations of their image about what the images agree on.

    Moments then mean something. Weights by pixel in their place would mix with the ratios in the bands.
    """
    away: list[list[Floats32]] = [[] for _ in range(count)]
    for sample, (ratio, confidence), location in zip(samples, stacks, albedo, strict=True):
        for k, values, known in zip(sample.images, ratio, confidence > 0, strict=True):
            away[k].append(np.abs(values - location)[known][::7])
    bounds = [OUTLYING * 1.4826 * float(np.median(np.concatenate(v))) if any(map(len, v)) else 0.0 for v in away]
    for sample, (ratio, _), location in zip(samples, stacks, albedo, strict=True):
        for k, values in zip(sample.images, ratio, strict=True):
            bound = np.float32(bounds[k])
            values[:] = location + np.clip(values - location, -bound, bound)


def _scales(samples: Sequence[Sample], albedo: Sequence[Any], count: int, units: str) -> tuple[Floats, Floats]:
    """Gain and offset of every image against the prediction times the albedo so far, on every 7th pixel.

    Images in I/F have the mean gain 1: what they all are brighter than the map is the ground's.
    """
    pairs: list[list[tuple[Floats, Floats]]] = [[] for _ in range(count)]
    for sample, log_albedo in zip(samples, albedo, strict=True):
        for k, observed in zip(sample.images, sample.observations, strict=True):
            known = observed.usable
            expected = (observed.predicted * np.exp(log_albedo))[known]
            pairs[k].append((expected[::7].astype(float), observed.measured[known][::7].astype(float)))
    gain, offset = np.ones(count), np.zeros(count)
    fitted = [k for k in range(count) if sum(len(p[0]) for p in pairs[k]) > 0]
    for k in fitted:
        expected, measured = (np.concatenate([p[i] for p in pairs[k]]) for i in (0, 1))
        gain[k], offset[k] = fit_line(expected, measured, units == "dn")
    if units == "iof" and fitted:
        gain /= np.exp(np.log(gain[fitted]).mean())
        gain[[k for k in range(count) if k not in fitted]] = 1.0
    return _rounded(gain), _rounded(offset)


def _variances(samples: Sequence[Sample], stacks: Sequence[tuple[Floats32, Floats32]], count: int) -> Spread:
    """Variance components by moments of pairs of images: products for what is shared; for the rest what a square has
    beyond that, or what differences say where this is more (errors that neighbours share would hide in differences).
    """
    levels = LEVELS + 2  # the last are whole pixels
    product, weight, difference, reach = (np.zeros((levels, count, count)) for _ in range(4))
    square, sums, pixels = (np.zeros((levels, count)) for _ in range(3))
    windows: list[tuple[list[int], Floats, Floats]] = []
    for sample, (ratio, confidence) in zip(samples, stacks, strict=True):
        split = [[*bands(r, q), (r, q)] for r, q in zip(ratio, confidence, strict=True)]
        where = np.ix_(sample.images, sample.images)
        windows.append((sample.images, *np.zeros((2, levels, len(sample.images), len(sample.images)))))
        for level in range(levels):
            values, q = (np.stack([s[level][i].ravel() for s in split]).astype(float) for i in (0, 1))
            scaled = q * values
            products, weights, squares = scaled @ scaled.T, q @ q.T, (scaled * values) @ q.T
            product[level][where] += products
            weight[level][where] += weights
            windows[-1][1][level], windows[-1][2][level] = products, weights
            difference[level][where] += squares + squares.T - 2 * products
            reach[level][where] += (q > 0) @ q.T
            square[level, sample.images] += (scaled * values).sum(axis=1)
            sums[level, sample.images] += q.sum(axis=1)
            pixels[level, sample.images] += (q > 0).sum(axis=1)
    own = np.stack([_own_variances(difference[k], reach[k]) for k in range(levels)])
    shared = np.array([_shared_variance(product[k], weight[k], own[k]) for k in range(levels)])
    beyond = (square - shared[:, None] * sums) / np.maximum(pixels, 1)
    single = np.array(
        [np.median(k[q > 0] / q[q > 0]) if (q > 0).any() else 0.0 for k, q in zip(square, sums, strict=True)]
    )
    doubt = np.array([_sampling_variance(windows, k, shared[k], own[k]) for k in range(levels - 1)])
    # as far as what is shared is known, the map is wrong by that; else by all that single images show beyond it
    total = shared[:-1].sum()
    sure = stdtrit(max(1, len(windows) - 1), 0.975) ** 2  # few windows say little of how they differ
    known = total**2 / (total**2 + sure * doubt.sum()) if total > 0 else 0.0
    prior = known * shared[:-1] + (1 - known) * single[:-1]
    own = np.maximum(own, beyond).T
    parts = (_rounded(v) for v in (shared[:-1], own[:, :-1], shared[-1], own[:, -1], prior))
    first, of_bands, px, own_px, last = parts
    return Spread(first, of_bands, float(px), own_px, last)


def _sampling_variance(
    windows: Sequence[tuple[list[int], Floats, Floats]], level: int, shared: float, own: Floats
) -> float:
    """Variance of :func:`_shared_variance`, from how the windows differ; infinite where there are too few."""
    away, total = [], 0.0
    for images, product, weight in windows:
        trust = 1.0 / (own[images][:, None] * own[images])
        np.fill_diagonal(trust, 0.0)
        away.append((trust * (product[level] - shared * weight[level])).sum())
        total += (trust * weight[level]).sum()
    if len(away) < 2 or not total > 0:
        return np.inf
    return float(np.square(away).sum()) / total**2 * len(away) / (len(away) - 1)


def _shared_variance(product: Floats, weight: Floats, own: Floats) -> float:
    """Mean product of two images, 0 or more; those with large errors of their own, such as shifted ones, count less."""
    trust = 1.0 / (own[:, None] * own)
    np.fill_diagonal(trust, 0.0)
    total = (trust * weight).sum()
    return max(0.0, float((trust * product).sum() / total)) if total > 0 else 0.0


def _own_variances(difference: Floats, reach: Floats) -> Floats:
    """Each image's own variance from those of differences: difference[k, j] = own[k] reach[k, j] + own[j] reach[j, k].

    Positive by multiplicative steps (Richardson 1972, J. Opt. Soc. Am. 62:55), which share what only a sum is known of
    evenly. An image that shares no pixel with another has nothing to show for itself: it differs as others do.
    """
    difference, reach = difference.copy(), reach.copy()
    np.fill_diagonal(difference, 0.0)
    np.fill_diagonal(reach, 0.0)
    total = reach.sum(axis=1)
    known = (total > 0) & (reach.sum(axis=0) > 0)
    own = np.full(len(reach), max(difference.sum() / max(2 * reach.sum(), 1e-300), 1e-12))
    for _ in range(STEPS):
        expected = own[:, None] * reach
        expected += expected.T
        share = np.divide(difference, expected, out=np.zeros_like(expected), where=expected > 0)
        own[known] *= (reach * share).sum(axis=1)[known] / total[known]
        own = np.maximum(own, 1e-12)
    if not known.any():
        return np.ones(len(reach))
    own[~known] = np.median(own[known])
    return own


def _rounded(values: Any) -> Any:
    """To nine digits: what libraries of linear algebra leave open does not reach the map."""
    values = np.asarray(values, float)
    size = 10.0 ** (8 - np.floor(np.log10(np.maximum(np.abs(values), 1e-300))))
    return np.where(values == 0, 0.0, np.round(values * size) / size)


def _error(
    samples: Sequence[Sample], stacks: Sequence[tuple[Floats32, Floats32]], albedo: Sequence[Any], own_px: Floats
) -> Floats:
    """Variance of images about what they agree on by cos(incidence), in units of each image's own, relative to the mean bin's."""
    square, pixels = np.zeros(len(COSINES) - 1), np.zeros(len(COSINES) - 1)
    for sample, (ratio, confidence), location in zip(samples, stacks, albedo, strict=True):
        several = (confidence > 0).sum(axis=0) > 1
        for k, observed, values, known in zip(sample.images, sample.observations, ratio, confidence > 0, strict=True):
            use = known & several
            bins = np.clip(np.digitize(observed.cos_incidence[use], COSINES) - 1, 0, len(square) - 1)
            # the middle of a distribution with long tails: squares up to 9 robust variances
            residual = (values - location)[use].astype(float) / np.sqrt(max(own_px[k], 1e-12))
            bound = 3 * 1.4826 * float(np.median(np.abs(residual))) if residual.size else 0.0
            square += np.bincount(bins, np.minimum(np.abs(residual), bound) ** 2, len(square))
            pixels += np.bincount(bins, minlength=len(square))
    enough = (pixels > 200) & (square > 0)
    if not enough.any():
        return np.ones(len(square))
    variance = square[enough] / pixels[enough]
    variance /= np.exp(np.average(np.log(variance), weights=pixels[enough]))
    return _rounded(np.interp(np.arange(len(square)), np.flatnonzero(enough), variance))


def _middles() -> Floats:
    return 0.5 * (COSINES[1:] + COSINES[:-1])
