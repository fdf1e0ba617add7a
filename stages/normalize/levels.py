"""Gain, offset and error of every image, from windows that images share: they take a bounded time, and every shard finds the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.common.progress import Progress, show_nothing
from stages.normalize.factor import GOOD, Normaliser, placed
from stages.physics.formation.radiometry import fit_line
from stages.physics.images.angles import PLANES
from stages.physics.images.references import References
from stages.physics.images.table import Frame
from stages.physics.images.windows import choose_windows

STEP = 4  # of a window's pixels, every so many along each axis: neighbours are not independent
COSINES = np.linspace(0.0, 1.0, 11)  # bins of cos(incidence) over which errors differ
MIDDLES = 0.5 * (COSINES[1:] + COSINES[:-1])
OUTLYING = 4.0  # robust standard deviations, beyond which a ratio counts as so many
FEWEST = 100  # pixels from which an error is worked out


@dataclass(frozen=True)
class Sample:
    """Pixels of one window. images : (n,) that show it; the others (n, m), NaN where an image is not usable

    measured : as in the file; predicted : I/F of the model; factor : to the standard geometry; cosine : of incidence
    away : (3, n, m) angles of the file less those of the terrain, deg, in the order of PLANES
    """

    images: list[int]
    measured: Floats
    predicted: Floats
    factor: Floats
    cosine: Floats
    away: Floats


@dataclass(frozen=True)
class Levels:
    """gain, offset : (n,), measured = gain x I/F + offset; std : (n, bins) relative standard deviation of normalised I/F by
    ``COSINES``, NaN where no other image tells; before, after : rms step in log I/F between images that overlap
    on a window, before and after normalisation, None without any
    """

    gain: Floats
    offset: Floats
    std: Floats
    before: float | None
    after: float | None

    def deviation(self, k: int, cosine: NDArray) -> NDArray[np.float32]:
        """Relative standard deviation of an image's pixels. cosine : (h, w) of incidence"""
        return np.interp(cosine, MIDDLES, self.std[k]).astype(np.float32)


def take_samples(
    references: References, shape: tuple[int, int], normaliser: Normaliser, progress: Progress = show_nothing
) -> list[Sample]:
    """What the images show of some windows of a map of ``shape``."""
    windows = choose_windows(shape, len(references.frames), references.overlapping)
    samples = []
    for number, box in enumerate(windows):
        progress(number, len(windows), "windows that images share")
        images, rows = [], []
        for k in references.overlapping(box):
            seen = references.see(k, box)
            if seen is None:
                continue
            good = normaliser.mask(seen) == GOOD
            cosine = np.cos(np.radians(normaliser.angles(seen)["incidence_deg"]))
            away = [seen.given[plane] - seen.planes[plane] if seen.given else 0 * cosine for plane in PLANES]
            planes = np.stack(
                [seen.measured, normaliser.predicted(k, seen), normaliser.factor(k, seen, good)[0], cosine, *away]
            )
            planes[:, np.isnan(planes[2])] = np.nan
            images.append(k)
            rows.append(placed(planes, seen.box, box)[:, ::STEP, ::STEP].reshape(len(planes), -1).astype(float))
        if images:
            measured, predicted, factor, cosine, *away = np.stack(rows, axis=1)
            samples.append(Sample(images, measured, predicted, factor, cosine, np.stack(away)))
    return samples


def compare_angles(samples: Sequence[Sample], frames: Sequence[Frame]) -> dict[str, tuple[float, float]]:
    """Mean and rms of the files' angles less those of the terrain, deg, by plane; empty where no image has a file."""
    given = [np.isin(s.images, [k for k, frame in enumerate(frames) if frame.angles]) for s in samples]
    found = {}
    for p, plane in enumerate(PLANES):
        away = np.concatenate([s.away[p][use].ravel() for s, use in zip(samples, given, strict=True)])
        away = away[np.isfinite(away)]
        if len(away):
            found[plane] = float(away.mean()), float(np.sqrt(np.mean(away**2)))
    return found


def find_levels(samples: Sequence[Sample], groups: Sequence[int], units: str, level: bool) -> Levels:
    """Levels of images. groups : (n,), images of one group (a band) are compared; units : 'iof' or 'dn'

    Images in DN get the gain and offset that bring them to the model's prediction. These and, with ``level``, those in I/F
    are then brought to one level where they overlap; the mean of the group's log gains stays.
    """
    count = len(groups)
    gain, offset = np.ones(count), np.zeros(count)
    for k in range(count) if units == "dn" else ():
        pairs = [(s.predicted[s.images.index(k)], s.measured[s.images.index(k)]) for s in samples if k in s.images]
        expected, measured = (np.concatenate(v) for v in zip(*pairs, strict=True)) if pairs else (np.zeros(0),) * 2
        known = np.isfinite(expected)
        gain[k], offset[k] = fit_line(expected[known], measured[known], True) if known.any() else (np.nan, np.nan)
    levelled = level or units == "dn"
    raw = [_logarithms((s.measured - offset[s.images, None]) / gain[s.images, None]) for s in samples]
    logs = [v + np.log(s.factor) for s, v in zip(samples, raw, strict=True)]
    steps = _common_level(samples, logs, groups) if levelled else np.zeros(count)
    raw, logs = ([v - steps[s.images, None] for s, v in zip(samples, values, strict=True)] for values in (raw, logs))
    std = _deviations(samples, logs, groups)
    return Levels(gain * np.exp(steps), offset, std, _step(samples, raw, groups), _step(samples, logs, groups))


def _logarithms(values: Floats) -> Floats:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(values > 0, np.log(values), np.nan)


def _differences(
    samples: Sequence[Sample], logs: Sequence[Floats], groups: Sequence[int]
) -> Iterator[tuple[int, int, Floats]]:
    """For every two images of a group on a window: both indices, and the differences of their logarithms, (m,)."""
    for sample, values in zip(samples, logs, strict=True):
        for i, first in enumerate(sample.images):
            for j in range(i + 1, len(sample.images)):
                if groups[first] == groups[sample.images[j]]:
                    both = values[i] - values[j]
                    yield first, sample.images[j], both[np.isfinite(both)]


def _common_level(samples: Sequence[Sample], logs: Sequence[Floats], groups: Sequence[int]) -> Floats:
    """(n,) log level of every image over those that it overlaps, by least squares; images that hang together have mean 0."""
    count = len(groups)
    matrix, right = np.zeros((count, count)), np.zeros(count)
    for first, second, both in _differences(samples, logs, groups):
        if len(both):
            step = len(both) * float(np.median(both))
            matrix[[first, second], [first, second]] += len(both)
            matrix[[first, second], [second, first]] -= len(both)
            right[first] += step
            right[second] -= step
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=1e-9)[0], float)


def _step(samples: Sequence[Sample], logs: Sequence[Floats], groups: Sequence[int]) -> float | None:
    """Rms over windows of the median difference of two images, None where none overlap: what seams would show."""
    found = [float(np.median(both)) for _, _, both in _differences(samples, logs, groups) if len(both) >= FEWEST]
    return float(np.sqrt(np.mean(np.square(found)))) if found else None


def _deviations(samples: Sequence[Sample], logs: Sequence[Floats], groups: Sequence[int]) -> Floats:
    """(n, bins) standard deviations of the images' logarithms, from the squares of their distances to the mean of the n images
    of a pixel, times n / (n - 1). Bins with few pixels take the image's mean, images that overlap none stay NaN.
    """
    found: list[tuple[list[Floats], list[Floats]]] = [([], []) for _ in groups]
    for sample, values in zip(samples, logs, strict=True):
        for group in set(groups):
            mine = [i for i, k in enumerate(sample.images) if groups[k] == group]
            part = values[mine]
            count = np.isfinite(part).sum(axis=0)
            shared = count > 1
            part, count = part[:, shared], count[shared]
            away = (part - np.nanmean(part, axis=0)) * np.sqrt(count / (count - 1)) if part.size else part
            for row, i in enumerate(mine):
                known = np.isfinite(away[row])
                found[sample.images[i]][0].append(away[row][known])
                found[sample.images[i]][1].append(sample.cosine[i][shared][known])
    result = np.full((len(groups), len(MIDDLES)), np.nan)
    for k, (away, cosines) in enumerate(found):
        whole = np.concatenate(away) if away else np.zeros(0)
        place = np.digitize(np.concatenate(cosines) if cosines else whole, COSINES[1:-1])
        result[k] = _robust_std(whole)
        for b in range(len(MIDDLES)):
            inside = whole[place == b]
            if len(inside) >= FEWEST:
                result[k, b] = _robust_std(inside)
    return result


def _robust_std(away: Floats) -> float:
    """Rms of distances from a mean, of which none counts for more than OUTLYING robust deviations; NaN without any."""
    size = np.abs(away)
    if not len(size):
        return np.nan
    return float(np.sqrt(np.mean(np.minimum(size, OUTLYING * 1.4826 * np.median(size)) ** 2)))
