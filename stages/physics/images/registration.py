"""Sub-pixel shifts of an image against its rendering, block by block, with their errors and the reasons to refuse them.

Each block's shift is found in two steps: ``correlation`` finds the best whole-pixel shift, up to several pixels; ``refine``
finds it to hundredths of a pixel, with its error. Both see only structure of up to a few tens of pixels.

Shifts are (dx, dy) in pixels along columns and rows: image[row + dy, col + dx] shows what rendering[row, col] shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import spline_filter

from schemas.errors import GeometryError
from stages.common.arrays import Floats, Mask
from stages.physics.images.correlation import combined_correlation, masked_correlation, small_structure
from stages.physics.images.refine import refine
from stages.physics.maps.window import Box

BLOCK_PX = 64
LEAST_PIXELS = 400
LEAST_SHARE = 0.1
LEAST_CORRELATION = 0.25
LEAST_LEAD = 0.05  # of the best correlation over those further than NEAR_PX from it
NEAR_PX = 3.0
WORST_SIGMA_PX = 0.5


@dataclass(frozen=True)
class Shift:
    """The shift of one block with its error, and the reason where it is refused.

    dx, dy : px along columns and rows; sigma : px, standard error of the worse axis
    correlation : of small structure in image and rendering at that shift; lead : over the best other place
    refused : why the shift must not be used, empty where it may be
    share : of the relief displacement within the block, where asked for; relief : (dx, dy) px, mean of all of it there
    covariance : (3, 3) of dx, dy, share
    """

    dx: float
    dy: float
    sigma: float
    correlation: float
    lead: float
    refused: str = ""
    share: float = 0.0
    relief: tuple[float, float] = (0.0, 0.0)
    covariance: Floats | None = None

    @property
    def accepted(self) -> bool:
        """Whether the evidence was enough."""
        return not self.refused

    @property
    def quality(self) -> float:
        """0 to 1: the correlation, 0 where the shift is refused."""
        return max(0.0, self.correlation) if self.accepted else 0.0

    @property
    def place_covariance(self) -> Floats:
        """(2, 2) covariance of dx and dy, px^2."""
        return np.diag([self.sigma**2] * 2) if self.covariance is None else self.covariance[:2, :2]


@dataclass(frozen=True)
class Pictures:
    """An image and its templates, band-passed to be compared block by block; all (H, W).

    spline : coefficients of the image's quintic spline; good_image, good : known pixels of image and templates
    templates : the rendering first, then patterns that the surface may show besides; weights : 0 where unknown
    relief : (2, H, W) px (dx, dy) of the full relief displacement, or None
    """

    image: Floats
    spline: Floats
    good_image: Mask
    templates: tuple[Floats, ...]
    good: Mask
    weights: Floats
    relief: Floats | None = None


def prepare(
    image: ArrayLike,
    rendering: ArrayLike,
    valid: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    patterns: Sequence[ArrayLike] = (),
    relief: Floats | None = None,
) -> Pictures:
    """Band-pass an image, its rendering and further patterns, once for all blocks. Raises GeometryError for other shapes.

    image, rendering, valid, weights : (H, W), and so is each of the ``patterns``; NaN = unknown
    weights : 0 or more, for example less in shadow; relief : (2, H, W) px (dx, dy) of the full relief displacement
    """
    image, rendering = np.asarray(image, float), np.asarray(rendering, float)
    if image.ndim != 2 or image.shape != rendering.shape:
        raise GeometryError(
            f"registration: expected an image and a rendering of one shape (H, W), found {image.shape} and {rendering.shape}."
        )
    good_image, good = np.isfinite(image), np.isfinite(rendering)
    if valid is not None:
        good_image, good = good_image & np.asarray(valid, bool), good & np.asarray(valid, bool)
    a = small_structure(image, good_image)
    others = [small_structure(np.where(good, np.asarray(p, float), 0.0), good) for p in patterns]
    weight = good.astype(float) * (1.0 if weights is None else np.asarray(weights, float))
    templates = (small_structure(rendering, good), *others)
    return Pictures(a, spline_filter(a, order=5), good_image, templates, good, weight, relief)


def block_shift(pictures: Pictures, box: Box, reach: float) -> Shift:
    """The shift of one block ``box`` = (row, col, height, width) of the pictures; refused where the evidence is poor.

    reach : px, how far to search
    """
    row, col, height, width = box
    far = math.ceil(reach)
    # the image is read beyond the block too, so that a shift costs no overlap
    r0, c0 = max(0, row - far - 3), max(0, col - far - 3)
    part = np.s_[r0 : row + height + far + 3, c0 : col + width + far + 3]
    image, good_image = pictures.image[part], pictures.good_image[part]
    inside = np.zeros(image.shape, bool)
    inside[row - r0 : row - r0 + height, col - c0 : col - c0 + width] = True
    good = pictures.good[part] & inside
    count = int((good_image & good).sum())
    nothing = Shift(0.0, 0.0, math.inf, 0.0, 0.0)
    if count < max(LEAST_PIXELS, LEAST_SHARE * height * width):
        return replace(nothing, refused=f"only {count} pixels are valid")
    if not (image[good_image].std() > 0 and pictures.templates[0][part][good].std() > 0):
        return replace(nothing, refused="one of the two shows no structure")
    templates = _orthogonal([np.where(good, t[part], 0.0) for t in pictures.templates], good)
    mutual = np.corrcoef([t[good] for t in templates]) if len(templates) > 1 else np.eye(1)
    scores = combined_correlation(masked_correlation(image, good_image, templates, good, far), mutual)
    peak = np.unravel_index(int(np.nanargmax(scores)), scores.shape)
    lag = np.arange(-far, far + 1)
    others = scores[(np.hypot(lag[:, None] - lag[peak[0]], lag - lag[peak[1]]) > NEAR_PX) & np.isfinite(scores)]
    lead = float(scores[peak] - others.max()) if others.size else math.nan
    start = float(lag[peak[1]]), float(lag[peak[0]])
    relief, mean = None, (0.0, 0.0)
    if pictures.relief is not None:
        relief = pictures.relief[(slice(None), *part)]
        middle = relief[:, good].mean(axis=1)
        relief, mean = relief - middle[:, None, None], (float(middle[0]), float(middle[1]))
    weight = np.where(good, pictures.weights[part], 0.0)
    best = refine(pictures.spline[part], good_image, templates, weight, start, relief)
    sigma = math.sqrt(max(0.0, float(np.diag(best.covariance)[:2].max())))
    found = Shift(*best.place, sigma, best.correlation, lead, "", best.share, mean, best.covariance)
    return replace(found, refused=_reason_to_refuse(found, start, reach))


def _orthogonal(templates: list[Floats], good: Mask) -> list[Floats]:
    """The rendering, and the other templates made orthogonal to it, all of one standard deviation."""
    first = templates[0]
    kept, size = [first], first[good].std()
    for extra in templates[1:]:
        before = float((extra**2).sum())
        # the common part stays with the rendering, whose strength has a sign to be checked
        extra = extra - first * float((extra * first).sum()) / float((first * first).sum())
        if float((extra**2).sum()) > 1e-6 * before:
            kept.append(extra / extra[good].std() * size)
    return kept


def _reason_to_refuse(found: Shift, start: tuple[float, float], reach: float) -> str:
    """Empty where there is none. start : (dx, dy) px of the best whole-pixel shift"""
    if not (math.isfinite(found.dx) and math.isfinite(found.dy)):
        return "the search did not settle"
    if found.correlation < LEAST_CORRELATION:
        return f"image and rendering correlate at {found.correlation:.2f} only"
    if max(abs(found.dx), abs(found.dy)) > reach - 0.5:
        return f"the best place lies at the end of the search ({reach:g} px)"
    if math.hypot(found.dx - start[0], found.dy - start[1]) > 2.0:
        return "the two steps of the search disagree"
    if not found.lead >= LEAST_LEAD:
        return f"another place fits as well (lead {found.lead:.2f})"
    if not found.sigma <= WORST_SIGMA_PX:
        return f"the place is uncertain by {found.sigma:.2f} px"
    return ""
