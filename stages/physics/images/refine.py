"""Shifts to a fraction of a pixel by least squares, with errors from the autocovariance of the residuals.

Gauss-Newton steps minimise the difference between the image and a gain and offset of the rendering, with the gradient of
the rendering, which has no noise (Baker & Matthews 2004, Int. J. Comput. Vis. 56:221). Further templates (albedo that
follows the terrain) are fitted together with the rendering: shading is a slope towards the Sun, so that bright rims or dark
floors added to it look like the same shading a fraction of a pixel away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from stages.common.arrays import Floats, Mask

ITERATIONS = 30
LEAST_PIXELS = 200  # that must stay usable while the image is moved under the template
MEMORY_PX = 16  # residuals farther apart are taken as independent


@dataclass(frozen=True)
class Refined:
    """A shift to a fraction of a pixel; NOT_CONVERGED where the steps do not converge.

    place : (dx, dy) px; share : of ``relief`` within the region, 0 without; correlation : between image and rendering
    covariance : (3, 3) of dx, dy and share, inf for a share that was not asked for
    """

    place: tuple[float, float]
    share: float
    covariance: Floats
    correlation: float


NOT_CONVERGED = Refined((math.nan, math.nan), 0.0, np.full((3, 3), math.inf), 0.0)


def refine(
    spline: Floats,
    good: Mask,
    templates: Sequence[Floats],
    weight: Floats,
    start: tuple[float, float],
    relief: Floats | None = None,
) -> Refined:
    """The image's shift against ``templates[0]``, plus any mixture of the others, from ``start`` = (dx, dy) px on.

    spline : (H, W) coefficients of the image's quintic spline; good : (H, W) its known pixels; templates : (H, W) each
    weight : (H, W) >= 0, 0 outside the region
    relief : (2, H, W) px (dx, dy), a displacement pattern whose share within the region is fitted as well
    """
    solid, whole = erode(good, 7), erode(weight > 0, 3)
    dx, dy = start
    change, fit, region = np.full(2, np.inf), None, None
    for step in range(ITERATIONS):
        moved = shift_spline(spline, dx, dy)
        cell = math.floor(dx), math.ceil(dx), math.floor(dy), math.ceil(dy)
        if region is None or region.cell != cell:
            use = whole & _known_within(solid, cell)
            if use.sum() < LEAST_PIXELS:
                return NOT_CONVERGED
            region = _Region.around(cell, use, templates, weight)
        fit = _linear_fit(moved, region, None)
        if fit is None:
            return NOT_CONVERGED
        change = -fit.change[:2]
        change *= min(1.0, 1.0 / max(1e-12, float(np.abs(change).max())))
        dx, dy = dx + float(change[0]), dy + float(change[1])
        if np.abs(change).max() < 1e-4 and step >= 2:
            break
    if fit is None or region is None or np.abs(change).max() > 0.02:
        return NOT_CONVERGED
    share, covariance = 0.0, np.full((3, 3), math.inf)
    if relief is not None:
        full = _linear_fit(moved, region, relief)
        if full is not None:
            # adding the share changes the shift; what a fit without it would still change does not count
            dx, dy, share = dx - full.change[0] + fit.change[0], dy - full.change[1] + fit.change[1], -full.change[2]
            return Refined((dx, dy), share, full.covariance(region.use), fit.correlation)
    covariance[:2, :2] = fit.covariance(region.use)
    return Refined((dx, dy), share, covariance, fit.correlation)


@dataclass(frozen=True)
class _Region:
    """The pixels that count while the image moves within one ``cell`` of whole pixels (least and largest dx, then dy).

    use : (H, W), n pixels; design : (n, k) templates and a constant; east, south : (n, k) their slopes; weight : (n,)
    projector : (k, n), from pixels to the weighted least-squares mixture of the templates
    """

    cell: tuple[int, int, int, int]
    use: Mask
    design: Floats
    east: Floats
    south: Floats
    weight: Floats
    projector: Floats

    @classmethod
    def around(cls, cell: tuple[int, int, int, int], use: Mask, templates: Sequence[Floats], weight: Floats) -> _Region:
        flat = np.flatnonzero(use)
        columns = [*templates, np.ones(use.shape)]
        design, east, south = (
            np.stack([np.take(v, flat) for v in values], axis=1)
            for values in (columns, [_slope(v, 1) for v in columns], [_slope(v, 0) for v in columns])
        )
        w = np.take(weight, flat)
        weighted = design * w[:, None]
        # all templates have one standard deviation, so that the normal equations are well conditioned
        normal = weighted.T @ design
        projector = np.linalg.solve(normal + 1e-10 * np.trace(normal) * np.eye(len(normal)), weighted.T)
        return cls(cell, use, design, east, south, w, projector)


def _slope(values: Floats, axis: int) -> Floats:
    """(H, W) central differences per px; 0 at the outermost pixels, which never count."""
    out = np.zeros_like(values)
    if axis:
        out[:, 1:-1] = (values[:, 2:] - values[:, :-2]) / 2
    else:
        out[1:-1] = (values[2:] - values[:-2]) / 2
    return out


@dataclass(frozen=True)
class _Linear:
    """One linearised fit of p parameters, dx, dy and the relief's share, to n pixels.

    change : (p,) of the parameters; columns : (n, p) weighted design, orthogonal to the templates
    inverse : (p, p) of its normal matrix; residual : (n,)
    """

    change: Floats
    columns: Floats
    inverse: Floats
    residual: Floats
    correlation: float

    def covariance(self, use: Mask) -> Floats:
        """(p, p) covariance of the parameters, with the autocovariance of the residuals: neighbouring ones are correlated.

        use : (H, W), the n pixels
        """
        height, width = use.shape
        shape = tuple(cv2.getOptimalDFTSize(n + MEMORY_PX) for n in (height, width))

        def transform(values: Floats) -> NDArray[np.complex128]:
            spread = np.zeros(use.shape)
            spread[use] = values
            return np.fft.rfft2(spread, shape)

        pairs = np.maximum(np.fft.irfft2(np.abs(transform(np.ones(use.sum()))) ** 2, shape), 1.0)
        memory = np.fft.irfft2(np.abs(transform(self.residual)) ** 2, shape) / pairs
        lag = [np.abs(np.fft.fftfreq(n, 1 / n)) / MEMORY_PX for n in shape]
        taper = [np.where(v < 1, 0.5 + 0.5 * np.cos(np.pi * v), 0.0) for v in lag]
        power = np.maximum(np.fft.fft2(memory * taper[0][:, None] * taper[1]).real, 0.0)[:, : shape[1] // 2 + 1]
        # real transforms hold each frequency but the first (and the middle) once for two
        count = np.full(power.shape[1], 2.0)
        count[0] = 1.0
        if shape[1] % 2 == 0:
            count[-1] = 1.0
        spectra = np.stack([transform(c) for c in self.columns.T])
        noise = np.einsum("ayx,yx,x,byx->ab", spectra.conj(), power, count, spectra).real / (shape[0] * shape[1])
        return np.asarray(self.inverse @ noise @ self.inverse.T, float)


def _linear_fit(moved: Floats, region: _Region, relief: Floats | None) -> _Linear | None:
    """One Gauss-Newton step e from the shift d of ``moved``, to first order: image[x + d] = fitted(x) - slopes(x) . e."""
    w, design, flat = region.weight, region.design, moved[region.use]
    strength = region.projector @ flat
    residual = flat - design @ strength
    scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-12
    robust = w / (1 + (residual / (3 * scale)) ** 2)  # Cauchy: craters that the DEM lacks must not pull
    east, south = region.east @ strength, region.south @ strength
    slopes = [east, south]
    if relief is not None:
        slopes.append(east * relief[0][region.use] + south * relief[1][region.use])
    free = np.stack(slopes, axis=1)
    size = np.sqrt((free**2).mean(axis=0)) + 1e-300
    free = free / size
    weighted = design * robust[:, None]
    inner = weighted.T @ design
    inner += 1e-10 * np.trace(inner) * np.eye(len(inner))
    nuisance = np.linalg.solve(inner, weighted.T @ np.column_stack([free, residual]))
    free, residual = free - design @ nuisance[:, :-1], residual - design @ nuisance[:, -1]
    normal = (free * robust[:, None]).T @ free
    if not np.linalg.cond(normal) < 1e8:
        return None
    inverse = np.linalg.inv(normal)
    step = inverse @ ((free * robust[:, None]).T @ residual)
    model = design[:, :-1] @ strength[:-1]
    model = model - np.average(model, weights=w)
    seen = flat - np.average(flat, weights=w)
    correlation = float((w * model * seen).sum()) / math.sqrt(
        float((w * model**2).sum()) * float((w * seen**2).sum()) + 1e-300
    )
    return _Linear(
        step / size,
        free * robust[:, None],
        inverse / size[:, None],
        residual - free @ step,
        correlation if strength[0] > 0 else -abs(correlation),
    )


def shift_spline(spline: Floats, dx: float, dy: float) -> Floats:
    """The image at (row + dy, col + dx) from the coefficients of its quintic spline.

    The phase of a cubic convolution depends on the fraction of a pixel, which biased shifts by up to 0.05 px.

    spline : (H, W); dx, dy : px; returns (H, W)
    """
    for axis, shift in ((0, dy), (1, dx)):
        whole = math.floor(shift)
        weights = [_quintic(shift - whole - k) for k in range(-2, 4)]
        # taps reach from two before to three behind the whole pixel: correlate1d centres an even window on its fourth
        spline = correlate1d(spline, weights, axis=axis, mode="constant", origin=-1)
        spline = shift_pixels(spline, *((whole, 0) if axis else (0, whole)))
    return spline


def _quintic(x: float) -> float:
    """The centred B-spline of fifth order."""
    return sum((-1) ** k * math.comb(6, k) * max(0.0, x + 3 - k) ** 5 for k in range(7)) / 120


def shift_pixels(values: NDArray, columns: int, rows: int) -> NDArray:
    """values[row + rows, col + columns], zeros from outside.

    values : (H, W); returns (H, W)
    """
    out = np.zeros_like(values)
    height, width = values.shape
    r0, r1, c0, c1 = max(0, -rows), min(height, height - rows), max(0, -columns), min(width, width - columns)
    if r1 > r0 and c1 > c0:
        out[r0:r1, c0:c1] = values[r0 + rows : r1 + rows, c0 + columns : c1 + columns]
    return out


def _known_within(solid: Mask, cell: tuple[int, int, int, int]) -> Mask:
    """(H, W) whether all pixels to interpolate from are known wherever in ``cell`` the image is moved to."""
    known = np.ones(solid.shape, bool)
    for column in set(cell[:2]):
        for row in set(cell[2:]):
            known &= shift_pixels(solid, column, row)
    return known


def erode(mask: Mask, size: int) -> Mask:
    """The pixels of a mask whose ``size`` x ``size`` surroundings are in it.

    mask : (H, W); returns (H, W)
    """
    kernel = np.ones((size, size), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
