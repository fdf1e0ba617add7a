"""Correlation of an image with its rendering over whole-pixel shifts: masked, normalised, of small structure only.

The method is that of Padfield 2012 (IEEE Trans. Image Process. 21:2706): pixels that are unknown in either picture do not
count. Both are band-passed first, because slow changes (albedo, stray light) do not tell the place.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats, Mask

# sigma of the mean that is subtracted: albedo is strongest over long distances, shading over short ones
HIGH_PASS_PX = 4.0
SMOOTH_PX = 0.7  # sigma of the blur that both get, against pixel noise and aliasing
LEAST_OVERLAP = 0.1  # share of the window that must be known in both at a shift
SUPPORT_PX = 12  # radius of the band-pass (3 sigma)


def small_structure(values: Floats, good: Mask) -> Floats:
    """Values (H, W) minus the mean of their surroundings, slightly smoothed, 0 where not ``good`` (H, W)."""
    mask = good.astype(float)
    filled = np.where(good, values, 0.0)
    return np.where(good, _masked_mean(filled, mask, SMOOTH_PX) - _masked_mean(filled, mask, HIGH_PASS_PX), 0.0)


def _masked_mean(filled: Floats, mask: Floats, sigma: float) -> Floats:
    top = cv2.GaussianBlur(filled, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    share = cv2.GaussianBlur(mask, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return top / np.maximum(share, 1e-6)


def masked_correlation(image: Floats, good_image: Mask, templates: Sequence[Floats], good: Mask, reach: int) -> Floats:
    """(n, 2 reach + 1, 2 reach + 1) correlation coefficients of image[r + dy, c + dx] with each template[r, c].

    image, good_image, good : (H, W), and so is each of the n templates. Rows of the answer are dy, columns dx.
    -1 where too few known pixels overlap.
    """
    shape = tuple(cv2.getOptimalDFTSize(n + reach) for n in image.shape)
    index = np.arange(-reach, reach + 1)
    lags = np.ix_(index % shape[0], index % shape[1])

    def transform(values: NDArray) -> NDArray[np.complex128]:
        return np.fft.rfft2(values, shape)

    def correlate(first: NDArray, second: NDArray) -> Floats:
        return np.fft.irfft2(first * np.conj(second), shape)[lags]

    a = np.where(good_image, image, 0.0)
    ma, mb, fa, fa2 = (transform(v) for v in (good_image.astype(float), good.astype(float), a, a * a))
    overlap = np.maximum(correlate(ma, mb), 1e-9)
    sum_a = correlate(fa, mb)
    var_a = np.maximum(correlate(fa2, mb) - sum_a**2 / overlap, 0)
    scores = np.empty((len(templates), 2 * reach + 1, 2 * reach + 1))
    for k, template in enumerate(templates):
        b = np.where(good, template, 0.0)
        fb = transform(b)
        sum_b = correlate(ma, fb)
        top = correlate(fa, fb) - sum_a * sum_b / overlap
        var_b = np.maximum(correlate(ma, transform(b * b)) - sum_b**2 / overlap, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            score = top / np.sqrt(var_a * var_b)
        scores[k] = np.where((overlap >= LEAST_OVERLAP * image.size) & np.isfinite(score), score, -1.0)
    return scores


def combined_correlation(scores: Floats, mutual: Floats) -> Floats:
    """(R, C) multiple correlation of the image with several templates together.

    Its sign is that of the first template's coefficient: a negative of the rendering is no match.

    scores : (n, R, C) correlation with each template over the shifts; mutual : (n, n) of the templates with each other
    """
    if len(scores) == 1:
        return scores[0]
    stack = np.moveaxis(scores, 0, -1)
    known = (stack > -1).all(-1)
    inverse = np.linalg.inv(mutual + 1e-6 * np.eye(len(scores)))
    square = np.einsum("...i,ij,...j->...", stack, inverse, stack)
    return np.where(known, np.sqrt(np.clip(square, 0, 1)) * np.sign(stack @ inverse[0]), -1.0)
