"""How far an image lies from its rendering: sub-pixel shifts by region, what they are worth, and when to believe none.

A region's shift is found in two steps. A masked normalised cross-correlation over whole-pixel shifts (Padfield 2012,
IEEE Trans. Image Process. 21:2706) says where to look. Gauss-Newton steps then minimise the difference between the
image and a gain and offset of the rendering, with the gradient of the rendering, which has no noise (Baker & Matthews
2004, Int. J. Comput. Vis. 56:221). Both see only structure of up to a few tens of pixels: albedo and haze that vary
slowly say nothing about the place.

Albedo that follows the terrain must be allowed for: shading is a slope towards the Sun, so that bright rims and dark
floors added to it look like the same shading a part of a pixel away. Further ``patterns`` (elevation, curvature) are
fitted beside the rendering for that.

Shifts are (dx, dy) in pixels along columns and rows: image[row + dy, col + dx] shows what rendering[row, col] shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d, spline_filter

from schemas.errors import GeometryError

Floats = NDArray[np.float64]

# sigma of the mean that is taken off: albedo is strongest over long distances, shading over short ones
HIGH_PASS_PX = 4.0
SMOOTH_PX = 0.7  # sigma of the blur that both get, against pixel noise and aliasing
LEAST_PIXELS = 400
LEAST_SHARE = 0.1
LEAST_CORRELATION = 0.25
LEAST_LEAD = 0.05  # of the best correlation over those further than NEAR_PX from it
NEAR_PX = 3.0
WORST_SIGMA_PX = 0.5
ITERATIONS = 30


@dataclass(frozen=True)
class Shift:
    """One region's answer.

    dx, dy : px along columns and rows; sigma : px, standard error of the worse axis
    correlation : between image and rendering at that shift, small structure only; lead : over the next best place
    refused : why the shift is not to be believed, empty where it is
    """

    dx: float
    dy: float
    sigma: float
    correlation: float
    lead: float
    refused: str = ""

    @property
    def accepted(self) -> bool:
        return not self.refused

    @property
    def quality(self) -> float:
        """0 (worthless) to 1: the correlation, 0 where the shift is refused."""
        return max(0.0, self.correlation) if self.accepted else 0.0


def estimate_shift(
    image: ArrayLike,
    rendering: ArrayLike,
    valid: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    max_shift: float = 8.0,
    patterns: Sequence[ArrayLike] = (),
) -> Shift:
    """The shift of ``image`` against ``rendering``, both (H, W); gain and offset between them are free.

    valid : (H, W) bool, pixels that count in both; NaN never count. weights : (H, W) >= 0, for example less in shadow
    patterns : (H, W) each, what else the surface may show in place with the rendering, in unknown strength
    max_shift : px, how far to search
    Never raises for poor evidence: see ``Shift.refused``. Raises GeometryError for shapes that differ.
    """
    image, rendering = np.asarray(image, float), np.asarray(rendering, float)
    if image.ndim != 2 or image.shape != rendering.shape:
        raise GeometryError(
            f"registration: expected an image and a rendering of one shape (H, W), found {image.shape} and {rendering.shape}."
        )
    good_image, good_rendering = np.isfinite(image), np.isfinite(rendering)
    if valid is not None:
        good_image = good_image & np.asarray(valid, bool)
        good_rendering = good_rendering & np.asarray(valid, bool)
    count = int((good_image & good_rendering).sum())
    nothing = Shift(0.0, 0.0, math.inf, 0.0, 0.0)
    if count < max(LEAST_PIXELS, LEAST_SHARE * image.size):
        return replace(nothing, refused=f"only {count} pixels are valid")
    a, b = _small_structure(image, good_image), _small_structure(rendering, good_rendering)
    if not (a[good_image].std() > 0 and b[good_rendering].std() > 0):
        return replace(nothing, refused="one of the two shows no structure")
    weight = good_rendering.astype(float) * (1.0 if weights is None else np.asarray(weights, float))
    templates = [b]
    for pattern in patterns:
        extra = _small_structure(np.where(good_rendering, np.asarray(pattern, float), 0.0), good_rendering)
        size = float((extra**2).sum())
        # what it has in common with the rendering stays with the rendering, whose strength has a sign to be checked
        extra -= b * float((extra * b).sum()) / float((b * b).sum())
        if float((extra**2).sum()) > 1e-6 * size:
            templates.append(extra / extra[good_rendering].std() * b[good_rendering].std())
    reach = math.ceil(max_shift)
    scores = _combined(
        [masked_correlation(a, good_image, t, good_rendering, reach) for t in templates],
        np.corrcoef([t[good_rendering] for t in templates]) if len(templates) > 1 else np.eye(1),
    )
    peak = np.unravel_index(int(np.nanargmax(scores)), scores.shape)
    rows, cols = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    far = np.hypot(rows - rows[peak], cols - cols[peak]) > NEAR_PX
    others = scores[far & np.isfinite(scores)]
    lead = float(scores[peak] - others.max()) if others.size else math.nan
    start = float(cols[peak]), float(rows[peak])
    dx, dy, sigma, correlation = _refine(a, good_image, templates, weight, start)
    found = Shift(dx, dy, sigma, correlation, lead)
    return replace(found, refused=_why_not(found, start, max_shift))


def _why_not(found: Shift, start: tuple[float, float], max_shift: float) -> str:
    if not (math.isfinite(found.dx) and math.isfinite(found.dy)):
        return "the search did not settle"
    if found.correlation < LEAST_CORRELATION:
        return f"image and rendering correlate at {found.correlation:.2f} only"
    if max(abs(found.dx), abs(found.dy)) > max_shift - 0.5:
        return f"the best place lies at the end of the search ({max_shift:g} px)"
    if math.hypot(found.dx - start[0], found.dy - start[1]) > 2.0:
        return "the two steps of the search disagree"
    if not found.lead >= LEAST_LEAD:
        return f"another place fits as well (lead {found.lead:.2f})"
    if not found.sigma <= WORST_SIGMA_PX:
        return f"the place is uncertain by {found.sigma:.2f} px"
    return ""


def _small_structure(values: Floats, good: NDArray[np.bool_]) -> Floats:
    """Values less their surroundings' mean, slightly smoothed, 0 where not good."""
    mask = good.astype(float)
    filled = np.where(good, values, 0.0)
    fine = _masked_mean(filled, mask, SMOOTH_PX)
    result = np.where(good, fine - _masked_mean(filled, mask, HIGH_PASS_PX), 0.0)
    return result


def _masked_mean(filled: Floats, mask: Floats, sigma: float) -> Floats:
    top = cv2.GaussianBlur(filled, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    share = cv2.GaussianBlur(mask, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return top / np.maximum(share, 1e-6)


def masked_correlation(
    image: Floats, good_image: NDArray[np.bool_], rendering: Floats, good_rendering: NDArray[np.bool_], reach: int
) -> Floats:
    """(2 reach + 1, 2 reach + 1) correlation coefficients of image[r + dy, c + dx] with rendering[r, c], rows are dy.

    NaN where fewer than a tenth of the pixels overlap.
    """
    shape = tuple(cv2.getOptimalDFTSize(n + reach) for n in image.shape)

    def transform(values: NDArray) -> NDArray[np.complex128]:
        return np.fft.rfft2(values, shape)

    def correlate(first: NDArray, second: NDArray) -> Floats:
        full = np.fft.irfft2(first * np.conj(second), shape)
        index = np.arange(-reach, reach + 1)
        return full[np.ix_(index % shape[0], index % shape[1])]

    a, b = np.where(good_image, image, 0.0), np.where(good_rendering, rendering, 0.0)
    ma, mb = transform(good_image.astype(float)), transform(good_rendering.astype(float))
    fa, fb = transform(a), transform(b)
    overlap = np.maximum(correlate(ma, mb), 1e-9)
    sum_a, sum_b = correlate(fa, mb), correlate(ma, fb)
    top = correlate(fa, fb) - sum_a * sum_b / overlap
    var_a = correlate(transform(a * a), mb) - sum_a**2 / overlap
    var_b = correlate(ma, transform(b * b)) - sum_b**2 / overlap
    with np.errstate(invalid="ignore", divide="ignore"):
        score = top / np.sqrt(np.maximum(var_a, 0) * np.maximum(var_b, 0))
    return np.where((overlap >= LEAST_SHARE * image.size) & np.isfinite(score), score, -1.0)


def _combined(scores: Sequence[Floats], among: Floats) -> Floats:
    """Multiple correlation of the image with several templates, from its correlation with each and theirs among them.

    The sign is the first one's: a negative of the rendering is no match.
    """
    if len(scores) == 1:
        return scores[0]
    stack = np.stack(scores, axis=-1)
    known = (stack > -1).all(-1)
    inverse = np.linalg.inv(among + 1e-6 * np.eye(len(scores)))
    square = np.einsum("...i,ij,...j->...", stack, inverse, stack)
    gain = stack @ inverse[0]
    return np.where(known, np.sqrt(np.clip(square, 0, 1)) * np.sign(gain), -1.0)


def _refine(
    image: Floats, good: NDArray[np.bool_], templates: Sequence[Floats], weight: Floats, start: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Gauss-Newton from ``start``; (dx, dy, standard error, correlation)."""
    solid, whole = _eroded(good, 7), _eroded(weight > 0, 3)
    spline = spline_filter(image, order=5)
    dx, dy = start
    change = np.full(2, np.inf)
    for step in range(ITERATIONS):
        moved = _moved(spline, dx, dy)
        use = whole.copy()
        for column in (math.floor(dx), math.ceil(dx)):
            for row in (math.floor(dy), math.ceil(dy)):
                use &= _displaced(solid, column, row)
        if use.sum() < LEAST_PIXELS / 2:
            return math.nan, math.nan, math.inf, 0.0
        w = weight[use]
        design = np.stack([t[use] for t in templates] + [np.ones(w.size)], axis=1)
        weighted = design * w[:, None]
        # all templates have one size, so that the normal equations are good enough
        ridge = 1e-10 * np.trace(weighted.T @ design) * np.eye(design.shape[1])
        strength = np.linalg.solve(weighted.T @ design + ridge, weighted.T @ moved[use])
        fitted = sum(k * t for k, t in zip(strength, templates, strict=False))
        residual = moved[use] - fitted[use] - strength[-1]
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-12
        robust = w / (1 + (residual / (3 * scale)) ** 2)  # Cauchy: craters that the DEM lacks must not pull
        # Shift and strengths together: image[x + d + e] = fitted(x) leaves image[x + d] = fitted - slopes . e
        slopes = np.stack([np.gradient(fitted, axis=1)[use], np.gradient(fitted, axis=0)[use]], axis=1)
        full = np.concatenate([slopes, design], axis=1)
        full_scale = np.sqrt((full**2).mean(axis=0)) + 1e-300
        full = full / full_scale
        normal = (full * robust[:, None]).T @ full
        if not np.linalg.cond(normal) < 1e10:
            return math.nan, math.nan, math.inf, 0.0
        solved = np.linalg.solve(normal, (full * robust[:, None]).T @ residual) / full_scale
        change = -solved[:2]
        change *= min(1.0, 1.0 / max(1e-12, float(np.abs(change).max())))
        dx, dy = dx + float(change[0]), dy + float(change[1])
        if np.abs(change).max() < 1e-4 and step >= 2:
            break
    if np.abs(change).max() > 0.02:
        return math.nan, math.nan, math.inf, 0.0
    # Neighbouring residuals are alike: as many count as one as the smoothing and the terrain's grain make so.
    spread = np.zeros(image.shape)
    spread[use] = residual
    inverse = np.linalg.inv(normal)
    errors = (
        inverse @ ((full * (robust**2 * residual**2)[:, None]).T @ full) @ inverse / np.outer(full_scale, full_scale)
    )
    sigma = math.sqrt(max(0.0, float(np.diag(errors)[:2].max())) * _grain(spread, use))
    model = fitted[use] - np.average(fitted[use], weights=w)
    seen = moved[use] - np.average(moved[use], weights=w)
    correlation = float((w * model * seen).sum()) / math.sqrt(
        float((w * model**2).sum()) * float((w * seen**2).sum()) + 1e-300
    )
    return dx, dy, sigma, correlation if strength[0] > 0 else -abs(correlation)


def _moved(spline: Floats, dx: float, dy: float) -> Floats:
    """The image at (row + dy, col + dx) from the coefficients of its quintic spline.

    A cubic convolution's phase depends on the fraction of a pixel: it drew shifts by up to 0.05 px.
    """
    for axis, shift in ((0, dy), (1, dx)):
        whole = math.floor(shift)
        weights = [_quintic(shift - whole - k) for k in range(-2, 4)]
        # taps reach from two before to three behind the whole pixel: correlate1d centres an even window on its fourth
        spline = correlate1d(spline, weights, axis=axis, mode="constant", origin=-1)
        spline = _displaced(spline, *((whole, 0) if axis else (0, whole)))
    return spline


def _quintic(x: float) -> float:
    """The centred B-spline of fifth order."""
    return sum((-1) ** k * math.comb(6, k) * max(0.0, x + 3 - k) ** 5 for k in range(7)) / 120


def _displaced(values: NDArray, columns: int, rows: int) -> NDArray:
    """values[row + rows, col + columns], zeros from outside."""
    out = np.zeros_like(values)
    height, width = values.shape
    r0, r1, c0, c1 = max(0, -rows), min(height, height - rows), max(0, -columns), min(width, width - columns)
    if r1 > r0 and c1 > c0:
        out[r0:r1, c0:c1] = values[r0 + rows : r1 + rows, c0 + columns : c1 + columns]
    return out


def _eroded(mask: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    kernel = np.ones((size, size), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def _grain(residual: Floats, use: NDArray[np.bool_]) -> float:
    """How many pixels of residual vary as one: the sum of its autocorrelation over the nearest lags."""
    total = 1.0
    power = float((residual[use] ** 2).mean()) + 1e-300
    for lag in range(1, 9):
        for axis in (0, 1):
            a, b = (
                np.take(residual, range(lag, residual.shape[axis]), axis),
                np.take(residual, range(residual.shape[axis] - lag), axis),
            )
            ua, ub = np.take(use, range(lag, use.shape[axis]), axis), np.take(use, range(use.shape[axis] - lag), axis)
            both = ua & ub
            if both.any():
                total += max(0.0, float((a * b)[both].mean()) / power)
    return max(1.0, total * total / 4)


# --- many regions of one image --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Field:
    """One image's displacement over the ground: dx = x0 + xc (col - col0) + xr (row - row0), dy alike.

    coefficients : (2, 3), px and px per px; rows dx, dy; columns constant, by column, by row
    origin : (row0, col0); used, regions : how many regions it rests on and how many were tried
    scatter : px, robust standard deviation of a region about it
    sigma : px, standard error: of the mean over the regions, and as much again as one region scatters, because albedo that
        follows the terrain pulls all of them the same way (up to 1.4 times the scatter in simulated scenes)
    correlation : median over the regions used; refused : why it must not be applied, empty where it may be
    """

    coefficients: Floats
    origin: tuple[float, float]
    used: int
    regions: int
    scatter: float
    sigma: float
    correlation: float
    refused: str = ""

    @property
    def accepted(self) -> bool:
        return not self.refused

    def at(self, row: ArrayLike, col: ArrayLike) -> tuple[Floats, Floats]:
        """(dx, dy), px, at places on the grid; zero where refused."""
        row, col = np.asarray(row, float) - self.origin[0], np.asarray(col, float) - self.origin[1]
        if self.refused:
            return np.zeros(np.broadcast_shapes(row.shape, col.shape)), np.zeros(
                np.broadcast_shapes(row.shape, col.shape)
            )
        (x0, xc, xr), (y0, yc, yr) = self.coefficients
        return x0 + xc * col + xr * row, y0 + yc * col + yr * row


LEAST_REGIONS = {"shift": 4, "affine": 8}
WORST_FIELD_SIGMA_PX = 0.25
WORST_SCATTER_PX = 1.5
LEAST_ACCEPTED = 0.2  # share of the regions tried


def fit_field(shifts: Sequence[Shift], row: ArrayLike, col: ArrayLike, kind: str = "shift") -> Field:
    """One displacement of a whole image from its regions' shifts at (row, col) on the grid.

    kind : 'shift' (the same everywhere) or 'affine' (linear over the ground). Regions that disagree with the rest are
    left out; ``Field.refused`` says where the evidence is too poor.
    """
    if kind not in LEAST_REGIONS:
        raise GeometryError(f"registration: expected 'shift' or 'affine', found '{kind}'.")
    row, col = np.asarray(row, float), np.asarray(col, float)
    good = np.array([s.accepted for s in shifts], bool)
    regions = len(shifts)
    origin = (float(row.mean()), float(col.mean())) if regions else (0.0, 0.0)
    nothing = Field(np.zeros((2, 3)), origin, int(good.sum()), regions, math.inf, math.inf, 0.0)
    needed = LEAST_REGIONS[kind] if kind == "affine" else min(LEAST_REGIONS[kind], max(1, regions))
    if good.sum() < max(needed, LEAST_ACCEPTED * regions):
        first = next((s.refused for s in shifts if s.refused), "no region was tried")
        return replace(
            nothing, refused=f"{int(good.sum())} of {regions} regions agree with the rendering (elsewhere: {first})"
        )
    values = np.array([[s.dx, s.dy] for s in shifts])[good]
    sigmas = np.maximum([s.sigma for s, g in zip(shifts, good, strict=True) if g], 0.02)
    terms = [np.ones(values.shape[0])]
    if kind == "affine":
        terms += [col[good] - origin[1], row[good] - origin[0]]
    design = np.stack(terms, axis=1)
    extent = np.abs(design).max(axis=0)
    if (kind == "affine" and (extent[1:] == 0).any()) or np.linalg.matrix_rank(
        design / np.maximum(extent, 1e-9), tol=1e-2
    ) < len(terms):
        return replace(nothing, refused="its regions do not spread over the image")
    weight = 1.0 / sigmas**2
    keep = np.ones(len(values), bool)
    for _ in range(20):
        solution, scatter, off = _solve(design, values, weight * keep)
        scatter = max(scatter, float(np.median(sigmas)))
        fresh = off < 3.5 * np.maximum(scatter, sigmas)
        robust = 1.0 / (sigmas**2 + scatter**2)
        if (fresh == keep).all() and np.allclose(robust, weight, rtol=1e-3):
            break
        keep, weight = fresh, robust
        if keep.sum() < max(len(terms) + 1, needed / 2):
            return replace(nothing, refused=f"its {int(good.sum())} usable regions contradict each other")
    coefficients = np.zeros((2, 3))
    coefficients[:, : len(terms)] = solution.T
    sigma = math.sqrt(float(np.linalg.inv((design * (weight * keep)[:, None]).T @ design)[0, 0]))
    correlation = float(np.median([s.correlation for s, g in zip(shifts, good, strict=True) if g]))
    field = Field(coefficients, origin, int(keep.sum()), regions, scatter, math.hypot(sigma, scatter), correlation)
    if scatter > WORST_SCATTER_PX:
        return replace(field, refused=f"its regions scatter by {scatter:.2f} px")
    if sigma > WORST_FIELD_SIGMA_PX:
        return replace(field, refused=f"the shift is uncertain by {sigma:.2f} px")
    return field


def _solve(design: Floats, values: Floats, weight: Floats) -> tuple[Floats, float, Floats]:
    """Weighted least squares, the robust scatter of what counts, and each region's distance from the fit."""
    root = np.sqrt(weight)[:, None]
    if design.shape[1] == 1:
        # the median does not move with a third of bad regions, as a mean would
        counted = weight > 0
        centre = np.median(values[counted], axis=0)
        near = np.abs(values - centre).max(axis=1) < 3 * (1.4826 * np.median(np.abs(values[counted] - centre)) + 0.05)
        root = root * near[:, None]
    solution = np.linalg.lstsq(design * root, values * root, rcond=None)[0]
    off = values - design @ solution
    counted = root[:, 0] > 0
    scatter = 1.4826 * float(np.median(np.abs(off[counted]))) if counted.any() else math.inf
    return np.asarray(solution, float), scatter, np.asarray(np.abs(off).max(axis=1), float)
