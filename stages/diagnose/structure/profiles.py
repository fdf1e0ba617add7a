"""What images have on whole columns, or lines, of their detector: seams between its parts, bands at one distance, single columns that stand out, and
lines each of which has a brightness of its own.

Each by itself is too faint to be seen in one image. What is left of every piece of ground is added up along the columns of the detector that it falls
on; what the images then have in common is where a step lies, how far apart bands are, how bright a column is, and that lines scatter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import ndtri

from stages.common.arrays import Floats
from stages.common.intervals import ratio_interval
from stages.diagnose.likelihood.tails import surprise
from stages.diagnose.structure.innovations import Innovation

LONG = 8  # pixels of a column on a piece of ground, at least
OFTEN = 6  # pieces of ground that a column is seen on: of fewer nobody knows how far they scatter
SIDE = 8  # columns on either side of a step that are compared
BESIDE = -3, -2, 2, 3  # columns that one column is compared with: resampling spreads it over the next
AROUND = 31  # waves of a spectrum that a band is compared with
WAVES = 256  # columns that profiles are extended to for their spectra
FIRST = (
    13  # of these waves, 20 columns long: on a piece of ground longer ones are not told from what ground and film have
)
SMOOTH = 31  # lines: what is broader is ground or a field of the image
# px per px: along lines at these slopes, either way, the same sums know nothing of the detector's
ASLANT = 0.08, 0.14, 0.2


@dataclass
class Profile:
    """Of one piece of ground in one image. first : number of the first column; total, count : (L,) sum of what is left, in standard deviations,
    and number of its pixels; site : number of the ground
    """

    first: int
    total: Floats
    count: Floats
    site: int

    @property
    def columns(self) -> np.ndarray:
        """(L,) their numbers."""
        return self.first + np.arange(len(self.count))

    @property
    def mean(self) -> Floats:
        """(L,) of every column; 0 where it has no pixels."""
        return self.total / np.maximum(self.count, 1)


def profiles(every: Sequence[Innovation], axis: int) -> list[Profile]:
    """Over the detector's lines (0) or samples (1)."""
    return [_profile(detector[axis], value, site) for site, detector, value in _seen(every)]


def _seen(every: Sequence[Innovation]) -> Iterator[tuple[int, Floats, Floats]]:
    """Of every image of a piece of ground whose place on the detector is known: the ground's number, line and sample (2, N), what is left (N,)."""
    for one in every:
        for value, seen, detector in zip(one.limited, one.seen, one.detector, strict=True):
            known = seen & detector.isfinite().all(0)
            if bool(known.any()):
                yield one.patch.site, detector[:, known].double().numpy(), value[known].double().numpy()


def _profile(place: Floats, value: Floats, site: int) -> Profile:
    """Of pixels at these places, px, (N,) each."""
    column = np.round(place).astype(np.int64)
    first = int(column.min())
    count = np.bincount(column - first).astype(np.float64)
    return Profile(first, np.bincount(column - first, value, len(count)).astype(np.float64), count, site)


def seam(every: Sequence[Profile]) -> tuple[float, float]:
    """-log10 of the chance that steps, of whatever sign, scatter so much more on one column than on the others, and their share of the squares there.

    A step that is the same in all images is a matter of the flat field, and what images of one ground alone have is the ground's.
    """
    place, step, pixels, usual = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    ground = [np.zeros(0, np.int64)]
    for one in every:
        at = np.arange(SIDE, len(one.count) - SIDE + 1)
        total, count = (np.concatenate([[0.0], np.cumsum(x)]) for x in (one.total, one.count))
        left, right = count[at] - count[at - SIDE], count[at + SIDE] - count[at]
        known = (left > SIDE * LONG) & (right > SIDE * LONG)
        if known.sum() < SIDE:
            continue
        at, left, right = at[known], left[known], right[known]
        away = (total[at] - total[at - SIDE]) / left - (total[at + SIDE] - total[at]) / right
        place.append(one.first + at)
        step.append(away / np.sqrt(1 / left + 1 / right))
        pixels.append(left + right)
        ground.append(np.full(len(at), one.site))
        usual.append(np.full(len(at), max(float(np.median(np.abs(step[-1]))), 1e-9)))
    column, number = np.unique(np.concatenate(place), return_inverse=True)
    steps = np.concatenate(step)
    often = np.bincount(number, minlength=len(column))
    wide = np.bincount(number, np.concatenate(pixels), len(column)) / np.maximum(often, 1)
    site = np.concatenate(ground)
    sites = int(site.max(initial=0)) + 1
    cell = number * sites + site
    of_site = np.bincount(cell, minlength=len(column) * sites).reshape(-1, sites)
    known = (often >= OFTEN) & ((of_site > 0).sum(1) > 2)
    if known.sum() < SIDE:
        return 0.0, 0.0

    def scatter(x: Floats) -> tuple[Floats, Floats]:
        """Of every column, over that of the middle one, without the ground that has most of it; and its degrees of freedom."""

        def about(mean: Floats, weight: Floats) -> Floats:
            squares = weight * (x - mean[number]) ** 2
            return np.bincount(cell, squares, of_site.size).astype(np.float64).reshape(of_site.shape)

        mean = np.bincount(number, x, len(column)) / np.maximum(often, 1)
        kept = (about(mean, np.ones(len(x))).argmax(1)[number] != site).astype(float)
        count = np.bincount(number, kept, len(column))
        mean = np.bincount(number, kept * x, len(column)) / np.maximum(count, 1)
        freedom = np.maximum(count - 1, 1)
        out = (about(mean, kept).sum(1) / freedom)[known]
        return out / float(np.median(out)), freedom[known]

    # one image under a low Sun, whose shading the covariance has not, would be a seam by itself wherever it is steepest
    (unlikely, freedom), (squares, _), wide = scatter(steps / np.concatenate(usual)), scatter(steps), wide[known]
    chance = surprise(unlikely * freedom, freedom) - math.log10(len(freedom))
    top = int(chance.argmax())
    return float(chance[top]), max(float((squares[top] - 1) / wide[top]), 0.0)


def bands(every: Sequence[Profile]) -> tuple[float, float]:
    """-log10 of the chance of the strongest wave over the detector that all images have, at whatever phase, and its share of the squares."""
    first, fixed, _ = _fixed(every)
    power, squares, count, pixels = np.zeros(WAVES // 2 + 1), np.zeros(WAVES // 2 + 1), 0, 0.0
    for one in every:
        weight = np.where(one.count >= LONG, np.hanning(len(one.count) + 2)[1:-1], 0.0)[:WAVES]
        if (weight > 0).sum() < 2 * SIDE:
            continue
        varies = one.mean - fixed[one.columns - first]
        wave = varies[:WAVES] * weight
        wave -= weight * wave.sum() / weight.sum()
        z = np.abs(np.fft.rfft(wave, WAVES)) ** 2
        fine = float(z[FIRST:].mean())
        if not fine > 0:
            continue
        power += z / fine
        # of a wave of this length, half the square of its amplitude in every pixel
        squares += 2 * z / weight.sum() ** 2 * one.count.sum()
        count, pixels = count + 1, pixels + float(one.count.sum())
    if not count:
        return 0.0, 0.0
    ratio = power / np.maximum(median_filter(power, AROUND, mode="nearest"), 1e-9)
    ratio[:FIRST] = 0.0
    top = int(ratio.argmax())
    chance = surprise(2 * count * ratio[top], 2 * count) - math.log10(len(ratio) - FIRST)
    return float(chance), float(squares[top] / pixels * (1 - 1 / max(ratio[top], 1.0)))


def lines_of_their_own(every: Sequence[Innovation]) -> tuple[float, float]:
    """Share of the squares by which means over the detector's lines scatter more than those over lines aslant, and its lower bound (95 % over grounds); NaN of too few.

    Ground, optics and what resampling leaves change slowly with direction. Lines that were read out with other offsets do not.
    """
    grounds = 1 + max((one.patch.site for one in every), default=0)
    excess, pixels = np.zeros(grounds), np.zeros(grounds)
    for site, detector, value in _seen(every):
        line, along = detector[0], detector[1] - detector[1].mean()
        slanting = [_scatter(_profile(line + a * along, value, site)) for by in ASLANT for a in (-by, by)]
        excess[site] += _scatter(_profile(line, value, site)) - np.mean(slanting)
        pixels[site] += len(value)
    found = ratio_interval(excess, pixels, np.arange(grounds))
    return found.value, found.low


def _scatter(one: Profile) -> float:
    """Sum of squares of the means of lines about those of their neighbours, pixel by pixel."""
    weight = np.where(one.count >= LONG, one.count, 0.0)
    window = np.ones(min(SMOOTH, len(weight)))
    about = np.convolve(weight * one.mean, window, "same") / np.maximum(np.convolve(weight, window, "same"), 1.0)
    return float((weight * (one.mean - about) ** 2).sum())


def columns_that_stand_out(every: Sequence[Profile]) -> tuple[float, float]:
    """How many robust standard deviations the column that is furthest from its neighbours in all images is from them, and its share of all squares."""
    _, fixed, often = _fixed(every)
    known = often >= OFTEN
    for k in BESIDE:
        known = known & (np.roll(often, k) >= OFTEN)
    known[: max(BESIDE)] = known[len(known) - max(BESIDE) :] = False
    if known.sum() < 4 * SIDE:
        return 0.0, 0.0
    away = (fixed - np.mean([np.roll(fixed, k) for k in BESIDE], 0))[known]
    sure = np.abs(away) * np.sqrt(often[known])
    top = int(sure.argmax())
    robust = float(np.median(sure)) / float(ndtri(0.75))
    return float(sure[top] / max(robust, 1e-9)), float(away[top] ** 2 * often[known][top] / often.sum())


def _fixed(every: Sequence[Profile]) -> tuple[int, Floats, Floats]:
    """The first column; mean of what is left on every one, from that to the last; and the number of pieces of ground that each is seen on."""
    first = min((p.first for p in every), default=0)
    last = max((p.first + len(p.count) for p in every), default=0)
    total, often = np.zeros((2, last - first))
    for one in every:
        long = one.count >= LONG
        at = one.columns[long] - first
        total[at] += one.mean[long]
        often[at] += 1
    return first, np.where(often >= OFTEN, total / np.maximum(often, 1), 0.0), often


__all__ = ["Profile", "bands", "columns_that_stand_out", "lines_of_their_own", "profiles", "seam"]
