"""The albedo of a window from its photographs: where they agree it is theirs, where they do not it is the map's.

Log ratios of measured to predicted I/F are split into bands of structure size. In every band the albedo that all images
share has a variance, and each image an error of its own on top (see ``calibrate``); the mean of the posterior weighs
images and the prior, log albedo 0, by the inverse of these. Before that, each pixel of each image gets a weight by how
far it lies from what the others say, as residuals of Student's distribution do (Lange, Little & Taylor 1989,
J. Am. Stat. Assoc. 84:881): a shadow or a cosmic ray in one image leaves no mark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from stages.common.arrays import Floats, Floats32
from stages.photographs.pyramid import LEVELS, bands, collapse, enlarge, reduce

FREEDOM = 4.0  # degrees of freedom of Student's distribution, as Lange et al. recommend
ITERATIONS = 8


@dataclass(frozen=True)
class Spread:
    """Variances of log ratios. shared : (LEVELS + 1,) of the albedo that all images show, by band; own : (n, LEVELS + 1)
    of each image's error; shared_px, own_px : (), (n,) of whole pixels; prior : (LEVELS + 1,) of what the map may be wrong
    by where no image says more
    """

    shared: Floats
    own: Floats
    shared_px: float
    own_px: Floats
    prior: Floats

    def of(self, images: list[int]) -> Spread:
        """The same for some of the images."""
        return Spread(self.shared, self.own[images], self.shared_px, self.own_px[images], self.prior)


def robust_mean(ratio: Floats32, confidence: Floats32, spread: Spread) -> Floats32:
    """The robust mean of a window's images, pixel by pixel; lowers ``confidence`` in place where one differs from the others.

    ratio, confidence : (n, H, W), log of measured / predicted and 0 where unknown; returns (H, W)
    """
    location = np.zeros(ratio.shape[1:], np.float32)
    own = np.maximum(spread.own_px, 1e-12)
    _robust_mean(ratio, confidence, own, 1.0 / max(spread.shared_px, 1e-12), location)
    for k in range(len(ratio)):
        confidence[k] /= _local_error(ratio[k] - location, confidence[k], own[k])
    return location


def estimate(
    ratio: Floats32, confidence: Floats32, spread: Spread, prior: Floats32 | None = None
) -> tuple[Floats32, Floats32]:
    """(log albedo, its standard deviation), (H, W), from ratios whose confidence ``robust_mean`` has seen.

    prior : (H, W) variance of what the map may be wrong by, place by place; None: that of ``spread`` everywhere
    """
    height, width = ratio.shape[1:]
    shapes = [(height, width)]
    for _ in range(LEVELS):
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    sums = [np.zeros(shape, np.float32) for shape in shapes]
    precision = [np.zeros(shape, np.float32) for shape in shapes]
    for k in range(len(ratio)):
        for level, (values, weight) in enumerate(bands(ratio[k], confidence[k])):
            scaled = weight * np.float32(1.0 / max(spread.own[k, level], 1e-12))
            sums[level] += scaled * values
            precision[level] += scaled
    shares = spread.prior / max(float(spread.prior.sum()), 1e-30)
    wrong = np.full(shapes[0], np.float32(spread.prior.sum())) if prior is None else prior
    means, variances = [], []
    for level in range(LEVELS + 1):
        shared = np.float32(spread.shared[level])
        kept = 1.0 / (1.0 + shared * precision[level])  # the prior's weight in the mean
        means.append(shared * kept * sums[level])
        # what the prior is wrong by comes in with its weight, the images' errors with theirs
        variances.append(kept * kept * (np.float32(shares[level]) * wrong + shared * shared * precision[level]))
        if level < LEVELS:
            wrong = reduce(wrong)
    return collapse(means), np.sqrt(np.maximum(collapse(variances), 0))


def _local_error(residual: Floats32, confidence: Floats32, own: float) -> Floats32:
    """Local mean square of an image's residuals over their usual one, at least 1: poorly registered blocks count less."""
    energy, weight = confidence * residual * residual / np.float32(own), (confidence > 0).astype(np.float32)
    shapes = []
    for _ in range(LEVELS):
        shapes.append(energy.shape)
        energy, weight = reduce(energy), reduce(weight)
    ratio = np.divide(energy, weight, out=np.zeros_like(weight), where=weight > 1e-3)
    for shape in shapes[::-1]:
        ratio = enlarge(ratio, shape)
    return np.maximum(ratio, np.float32(1))


@numba.njit(cache=True, nogil=True)
def _robust_mean(ratio, confidence, own, prior, location):
    """Iteratively reweighted mean of every pixel with the prior at 0, started at the median."""
    count, height, width = ratio.shape
    values, precision, weights = np.empty(count + 1), np.empty(count), np.empty(count)
    for r in range(height):
        for c in range(width):
            n = 0
            for k in range(count):
                if confidence[k, r, c] > 0:
                    values[n] = ratio[k, r, c]
                    precision[n] = confidence[k, r, c] / own[k]
                    n += 1
            if n == 0:
                location[r, c] = 0.0
                continue
            values[n] = 0.0
            middle = np.median(values[: n + 1])  # not by weight: the image of least noise has its cosmic rays, too
            for _ in range(ITERATIONS):
                top, bottom = 0.0, prior
                for i in range(n):
                    away = values[i] - middle
                    weights[i] = (FREEDOM + 1.0) / (FREEDOM + away * away * precision[i])
                    top += weights[i] * precision[i] * values[i]
                    bottom += weights[i] * precision[i]
                middle = top / bottom
            location[r, c] = middle
            i = 0
            for k in range(count):
                if confidence[k, r, c] > 0:
                    confidence[k, r, c] *= weights[i]
                    i += 1
