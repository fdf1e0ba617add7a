"""Heights and log albedo of a window together: the mean of a Gaussian posterior, and draws from it.

With x the two fields, D the slopes of the heights beside the log albedo, and per pixel a triangle L with L L' the sum
over images of w j j' (j: relative I/F by log albedo and both slopes, w: weight), the images say

    v = L' D x + noise,   noise of variance 1 / F(k) at spatial frequency k,   prior: x of variance S(k)

so that the number of images does not enter the cost of an iteration. F is small where errors of images are broader than a
pixel; D leaves out slopes as broad as ``patch`` takes off the images. In z = S^(-1/2) x the normal equations are (1 + B'B) z = B' y, solved by conjugate gradients with the mean
over the window as preconditioner. Draws: perturb y and the prior by what each scatters, and solve again (Papandreou &
Yuille 2010, NIPS 23).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np

from stages.common.arrays import Floats32
from stages.physics.images.spectrum import WAVELENGTHS, Spectrum, collect, frequencies, waves
from stages.refine.patch import BROAD_PX

ITERATIONS = 80
TOLERANCE = 1e-3  # of the residual's norm, preconditioned
BLUR_PX = 0.4  # standard deviation: a sensor then passes 45 % of the contrast of two pixels a wave
FREE = 100.0  # the mean log albedo may be so many times what broad waves are
FIELDS = 2  # heights, log albedo


@dataclass(frozen=True)
class Priors:
    """Spectra of the heights' correction (m2) and of log albedo, and F; widening : variance of both over what the posterior says"""

    heights: Spectrum
    albedo: Spectrum
    trust: Spectrum
    widening: Spectrum = field(default_factory=lambda: Spectrum(np.ones((FIELDS, len(WAVELENGTHS)))))


def unresolved(priors: Priors, size: int = 256) -> tuple[float, float]:
    """Variance of heights, m2, and of log albedo that no photograph tells, however many there are.

    The optics blur a map's pixel by about BLUR_PX, which renderings do not; they take central differences, which a wave of
    k rad/px along an axis passes by sin(k) / k.
    """
    rows, cols = frequencies((size, size))
    square = np.maximum(rows**2 + cols**2, 1e-12)
    blur = np.exp(-0.5 * BLUR_PX**2 * square)
    passed = np.maximum((rows * np.sin(rows) + cols * np.sin(cols)) / square, 1e-3)
    heights = priors.heights.of((size, size)) * np.minimum(np.abs(blur / passed - 1), 1) ** 2
    albedo = priors.albedo.of((size, size)) * (1 - blur) ** 2
    return float(heights.mean(dtype=float)), float(albedo.mean(dtype=float))


class Posterior:
    """Of one window. evidence : (6, H, W) sums of w j j', its lower triangle row by row; px : m of a pixel (east, north)"""

    def __init__(self, evidence: Floats32, px: tuple[float, float], priors: Priors) -> None:
        self.shape: tuple[int, int] = evidence.shape[1:]
        self._px = px
        self._root = _triangle(evidence)
        self._trust = np.sqrt(priors.trust.of(self.shape))
        self.occupied = float((self._root[[0, 2, 5]] > 0).sum()) / np.prod(
            self.shape
        )  # of 3: what images tell of a pixel
        self._scale = np.stack([np.sqrt(s.of(self.shape)) for s in (priors.heights, priors.albedo)])
        self._scale[:, 0, 0] *= 0, FREE
        rows, cols = frequencies(self.shape)
        self._fine = 1 - np.exp(-0.5 * BROAD_PX**2 * (rows**2 + cols**2))
        mean = evidence.mean(axis=(1, 2), dtype=float).astype(np.float32)
        slopes = mean[2] * (np.sin(cols) / px[0]) ** 2 + mean[5] * (np.sin(rows) / px[1]) ** 2
        self._diagonal = 1 + (self._scale * self._trust) ** 2 * np.stack(
            [slopes * self._fine**2, np.broadcast_to(mean[0], self.shape)]
        )

    def mean(self, gradient: Floats32, around: Floats32, near: bool) -> Floats32:
        """(2, H, W) heights and log albedo. gradient : (3, H, W) sums of w j times the residual at ``around`` (2, H, W)

        near : whether ``around`` is a mean of such a posterior itself, to start from
        """
        seen = _reduced(self._root, gradient) + self.seen(around)
        start = np.zeros_like(self._scale)
        if near:
            np.divide(waves(around), self._scale, out=start, where=self._scale > 0)
        return self._fields(self._solve(self._back(self._trust * waves(seen)), start))

    def draw(self, rng: np.random.Generator, prior: bool = True) -> Floats32:
        """(2, H, W) by which one draw of the posterior differs from its mean. prior : False for what noise alone does to the mean"""
        right = self._back(rng.standard_normal((3, *self.shape), np.float32))
        if prior:
            right += rng.standard_normal((FIELDS, *self.shape), np.float32)
        return self._fields(self._solve(right, np.zeros_like(right)))

    def misfit(self, gradient: Floats32, around: Floats32, found: Floats32) -> Floats32:
        """(3, H, W) of what the images say and ``found`` (2, H, W) does not; arguments as for :meth:`mean`"""
        return _reduced(self._root, gradient) + self.seen(around - found)

    def seen(self, fields: Floats32) -> Floats32:
        """(3, H, W) of what fields (2, H, W) look like to the images, in standard deviations."""
        fine = np.stack([collect(self._fine * waves(fields[0])), fields[1]])
        return _weighed(self._root, _slopes(fine, self._px))

    def _fields(self, z: Floats32) -> Floats32:
        return collect(self._scale * z)

    def _forth(self, z: Floats32) -> Floats32:
        values = self._scale * z
        values[0] *= self._fine
        return self._trust * waves(_weighed(self._root, _slopes(collect(values), self._px)))

    def _back(self, y: Floats32) -> Floats32:
        values = self._scale * waves(_summed(self._root, collect(self._trust * y), self._px))
        values[0] *= self._fine
        return values

    def _solve(self, right: Floats32, start: Floats32) -> Floats32:
        """z of (1 + B'B) z = right."""
        z, residual = start.copy(), right.copy()
        if start.any():
            residual -= start + self._back(self._forth(start))
        ahead = residual / self._diagonal
        step = ahead.copy()
        size, whole = _dot(residual, ahead), _dot(right, right / self._diagonal)
        for _ in range(ITERATIONS):
            if not size > TOLERANCE**2 * whole:
                break
            image = step + self._back(self._forth(step))
            length = np.float32(size / _dot(step, image))
            z += length * step
            residual -= length * image
            ahead = residual / self._diagonal
            before, size = size, _dot(residual, ahead)
            step = ahead + np.float32(size / before) * step
        return z


def _dot(a: Floats32, b: Floats32) -> float:
    return float(np.einsum("fij,fij->", a, b, dtype=np.float64))


@numba.njit(cache=True)
def _triangle(evidence):
    """L, (6, H, W), of L L' = the evidence, 0 along what no image tells."""
    out = np.zeros_like(evidence)
    for r in range(evidence.shape[1]):
        for c in range(evidence.shape[2]):
            m00 = evidence[0, r, c]
            if not m00 > 0:
                continue
            a = np.sqrt(m00)
            b, d = evidence[1, r, c] / a, evidence[3, r, c] / a
            out[0, r, c], out[1, r, c], out[3, r, c] = a, b, d
            left = evidence[2, r, c] - b * b
            e = 0.0
            if left > 1e-5 * evidence[2, r, c]:
                f = np.sqrt(left)
                e = (evidence[4, r, c] - b * d) / f
                out[2, r, c], out[4, r, c] = f, e
            left = evidence[5, r, c] - d * d - e * e
            if left > 1e-5 * evidence[5, r, c]:
                out[5, r, c] = np.sqrt(left)
    return out


@numba.njit(cache=True)
def _reduced(root, gradient):
    """L^-1 gradient, (3, H, W), 0 along what no image tells."""
    out = np.zeros_like(gradient)
    for r in range(root.shape[1]):
        for c in range(root.shape[2]):
            if root[0, r, c] > 0:
                out[0, r, c] = gradient[0, r, c] / root[0, r, c]
            if root[2, r, c] > 0:
                out[1, r, c] = (gradient[1, r, c] - root[1, r, c] * out[0, r, c]) / root[2, r, c]
            if root[5, r, c] > 0:
                rest = gradient[2, r, c] - root[3, r, c] * out[0, r, c] - root[4, r, c] * out[1, r, c]
                out[2, r, c] = rest / root[5, r, c]
    return out


def _slopes(fields: Floats32, px: tuple[float, float]) -> Floats32:
    """D x: (3, H, W) log albedo, slopes to the east and north, 0 at the window's edge."""
    heights = fields[0]
    out = np.zeros((3, *heights.shape), np.float32)
    out[0] = fields[1]
    out[1, :, 1:-1] = (heights[:, 2:] - heights[:, :-2]) * np.float32(0.5 / px[0])
    out[2, 1:-1] = (heights[:-2] - heights[2:]) * np.float32(0.5 / px[1])
    return out


@numba.njit(cache=True)
def _weighed(root, values):
    """L' values, (3, H, W)."""
    out = np.empty_like(values)
    for r in range(root.shape[1]):
        for c in range(root.shape[2]):
            x, y, z = values[0, r, c], values[1, r, c], values[2, r, c]
            out[0, r, c] = root[0, r, c] * x + root[1, r, c] * y + root[3, r, c] * z
            out[1, r, c] = root[2, r, c] * y + root[4, r, c] * z
            out[2, r, c] = root[5, r, c] * z
    return out


def _summed(root: Floats32, values: Floats32, px: tuple[float, float]) -> Floats32:
    """D' L values: (2, H, W)."""
    seen = _unweighed(root, values)
    out = np.zeros((FIELDS, *values.shape[1:]), np.float32)
    out[1] = seen[0]
    east, north = seen[1, :, 1:-1] * np.float32(0.5 / px[0]), seen[2, 1:-1] * np.float32(0.5 / px[1])
    out[0, :, 2:] += east
    out[0, :, :-2] -= east
    out[0, :-2] += north
    out[0, 2:] -= north
    return out


@numba.njit(cache=True)
def _unweighed(root, values):
    """L values, (3, H, W)."""
    out = np.empty_like(values)
    for r in range(root.shape[1]):
        for c in range(root.shape[2]):
            x, y, z = values[0, r, c], values[1, r, c], values[2, r, c]
            out[0, r, c] = root[0, r, c] * x
            out[1, r, c] = root[1, r, c] * x + root[2, r, c] * y
            out[2, r, c] = root[3, r, c] * x + root[4, r, c] * y + root[5, r, c] * z
    return out
