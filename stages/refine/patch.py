"""The photographs of one window beside what the map predicts for them, and by how much that changes with heights and albedo."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numba
import numpy as np
import torch

from stages.common.arrays import Floats, Floats32, Mask
from stages.photographs.calibrate import Calibration
from stages.photographs.ground import Ground
from stages.photographs.posterior import estimate, robust_mean
from stages.photographs.prior import terrain_variance
from stages.physics.formation.geometry import photometric_angles
from stages.physics.images.references import Observed, References, SceneHorizon, far_from_shadow
from stages.physics.maps.grid import Grid
from stages.physics.maps.window import Box, Window
from stages.physics.photometry import masked_radiance_factor
from stages.physics.terrain.block_geometry import block_geometry
from stages.physics.terrain.shading import Light
from stages.physics.terrain.sun_visibility import visible_share
from stages.physics.terrain.surface import SHADOWED

GRAZING = 0.02  # cos(incidence) below which a facet's brightness says little
BROAD_PX = 4.0  # standard deviation: 7 in 10 of a wave of 32 px are broad, 3 of one of 16 px, none of 8 px
FREEDOM = 4.0  # of Student's distribution, as Lange et al. 1989 recommend


class Raised:
    """A terrain with a correction on one window, read by slicing. elevation : anything that slices, m"""

    def __init__(self, elevation: Any, box: Box, correction: Floats32) -> None:
        self._elevation, self._box, self._correction = elevation, Window(*box), correction
        self.shape = elevation.shape

    def __getitem__(self, key: tuple[slice, slice]) -> Floats32:
        (r0, r1, _), (c0, c1, _) = (s.indices(n) for s, n in zip(key, self.shape, strict=True))
        part = np.array(self._elevation[r0:r1, c0:c1], np.float32)
        box = self._box
        top, bottom = max(r0, box.row), min(r1, box.row + box.height)
        left, right = max(c0, box.col), min(c1, box.col + box.width)
        if top < bottom and left < right:
            inner = self._correction[top - box.row : bottom - box.row, left - box.col : right - box.col]
            part[top - r0 : bottom - r0, left - c0 : right - c0] += inner
        return part


@dataclass
class Photograph:
    """Image ``k`` on its part ``box`` of a window. measured : (h, w) I/F, gain and offset taken off, NaN where unknown

    horizon : (h, w) of the terrain towards the Sun, rad; changes : (2, h, w) of I/F without albedo by the slopes to the east and north
    """

    k: int
    box: Window
    light: Light
    measured: Floats32
    horizon: Floats32
    changes: Floats32 | None = None

    def sun_sine(self, grid: Grid) -> float:
        """Of the Sun's elevation over the middle, 0 where it is down."""
        row, col, height, width = self.box
        return math.sin(max(0.0, self.light.sun.over(grid, row + (height - 1) / 2, col + (width - 1) / 2)[1]))


@dataclass(frozen=True)
class Predicted:
    """What a map says of one photograph, (h, w) each. image : I/F with albedo, 0 in shadow, NaN where unknown

    east, north : relative change of I/F by the slopes; usable : lit and away from shadows and unknown ground
    cosine : of incidence; shadow : share of the Sun that is hidden
    """

    image: Floats32
    east: Floats32
    north: Floats32
    usable: Mask
    cosine: Floats32
    shadow: Floats32


@dataclass(frozen=True)
class Noise:
    """Variance of photographs about the map, absolute + relative x I/F^2, (n,) each."""

    absolute: Floats
    relative: Floats

    def of(self, k: int, image: Floats32) -> Floats32:
        """(h, w) for image ``k``."""
        return (self.absolute[k] + self.relative[k] * image**2).astype(np.float32)


class Patch:
    """One window with all its photographs."""

    def __init__(self, ground: Ground, calibration: Calibration, box: Box) -> None:
        self.box, self._surface = Window(*box), ground.references.surface
        self._references, self._calibration = ground.references, calibration
        grid = self._surface.grid
        self._elevation = self._surface.read_padded(*box, 1)
        coefficients = self._surface.read_coefficients(*box)
        self._coefficients = np.broadcast_to(coefficients, (len(coefficients), *box[2:]))
        sizes = grid.local_frames(box[0] + (box[2] - 1) / 2, box[1] + (box[3] - 1) / 2).pixel_size[0]
        self.px = float(sizes[1]), float(sizes[0])
        found = (_photograph(ground.references, calibration, k, box) for k in ground.references.overlapping(box))
        self.photographs = [p for p in found if p is not None]

    @property
    def shape(self) -> tuple[int, int]:
        """Of the window."""
        return self.box.height, self.box.width

    def refresh(self, heights: Floats32 | None) -> None:
        """Take the horizons of the DEM with a correction (H, W), m, or of the DEM."""
        terrain = self._references.terrain
        if heights is not None:
            terrain = replace(terrain, elevation=Raised(terrain.elevation, self.box, heights))
        for photograph in self.photographs:
            photograph.horizon = SceneHorizon(terrain, photograph.light.sun).window(*photograph.box)

    def predict(self, photograph: Photograph, fields: Floats32, relinearise: bool = False) -> Predicted:
        """The photograph with heights and log albedo (2, H, W) beyond the map. relinearise : take changes with slopes anew"""
        row, col, height, width = photograph.box.within(self.box)
        around = np.s_[row : row + height + 2, col : col + width + 2]
        part = np.s_[row : row + height, col : col + width]
        elevation = self._elevation[around] + np.pad(fields[0], 1)[around]
        light, grid = photograph.light, self._surface.grid
        geometry = block_geometry(grid, *photograph.box[:2], elevation, light.sun.position, light.camera_position)
        anew = relinearise or photograph.changes is None
        east, north = (torch.from_numpy(s)[None].requires_grad_(anew) for s in geometry.slopes)
        vx, vy, vz = torch.from_numpy(geometry.view)[None].unbind(1)
        angles = photometric_angles(east, north, torch.from_numpy(geometry.sun)[None], (vx, vy, vz))
        values = torch.from_numpy(np.array(self._coefficients[:, *part], np.float32))
        model = self._surface.model
        bright = masked_radiance_factor(model, model.unpack(values, dim=0), angles)
        if anew:
            photograph.changes = torch.cat(torch.autograd.grad(bright.sum(), (east, north))).numpy()
        assert photograph.changes is not None
        lit = bright.detach()[0].numpy()
        visible = visible_share(geometry.sun_elevation, photograph.horizon, light.sun.radius)
        cosine = geometry.cos_incidence
        shadow = np.where(cosine > 0, 1 - visible, np.float32(1))
        shadow[np.isnan(cosine)] = np.nan
        image = np.maximum(lit, 0) * visible * np.exp(fields[1][part])
        image[np.isnan(cosine) | ~np.isfinite(values.numpy()).all(axis=0)] = np.nan
        usable = far_from_shadow(shadow) & (image > 0) & (cosine > GRAZING) & np.isfinite(photograph.measured)
        usable &= np.isfinite(photograph.changes).all(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            east, north = np.where(usable, photograph.changes / lit, 0).astype(np.float32)
        return Predicted(image.astype(np.float32), east, north, usable, cosine, shadow)

    def start(self, only: Collection[int] | None = None) -> Floats32:
        """(2, H, W): heights of the DEM, and the log albedo of ``lunargr albedo``. only : images that count, None for all"""
        mine = [p for p in self.photographs if only is None or p.k in only]
        fields = np.zeros((2, *self.shape), np.float32)
        if not mine:
            return fields
        ratio, confidence = np.zeros((2, len(mine), *self.shape), np.float32)
        for n, p in enumerate(mine):
            found, inner = self.predict(p, fields), p.box.within(self.box).part
            measured = self._calibration.gain[p.k] * p.measured + self._calibration.offset[p.k]
            observed = Observed(measured, found.image, found.cosine, found.usable, found.shadow > SHADOWED, 0.0)
            ratio[n][inner], confidence[n][inner] = self._calibration.ratio(p.k, observed)
        spread = self._calibration.spread.of([p.k for p in mine])
        robust_mean(ratio, confidence, spread)
        fields[1] = estimate(ratio, confidence, spread, terrain_variance(self._surface, self.box))[0]
        return fields

    def evidence(
        self, fields: Floats32, start: Floats32, noise: Noise, only: Collection[int] | None = None, relinearise: bool = False,
    ) -> Evidence:  # fmt: skip
        """What the images say about ``fields`` (2, H, W), beside what is broad: see ``solve``.

        start : of these images, whose broad albedo holds; only : images that count, None for all
        """
        evidence, gradient = np.zeros((6, *self.shape), np.float32), np.zeros((3, *self.shape), np.float32)
        seen = [
            _residual(p, self.predict(p, fields, relinearise), noise, p.box.within(self.box))
            for p in self.photographs
            if only is None or p.k in only
        ]
        doubt = _level(seen, start[1] - fields[1])
        for r in seen:
            found, inner = r.predicted, r.box.part
            _add(evidence[:, *inner], gradient[:, *inner], found.image, r.relative, found.east, found.north, r.variance)
        for sums in (evidence, gradient):  # slopes at the window's edge need heights beyond it
            sums[:, [0, -1]] = 0
            sums[:, :, [0, -1]] = 0
        return Evidence(evidence, gradient, seen, doubt)


@dataclass(frozen=True)
class Evidence:
    """What images say of a window. products : (6, H, W) sums of w j j'; gradient : (3, H, W) sums of w j times the residual

    doubt : (H, W) variance of log albedo for an image under other angles, from the broad residuals of these
    """

    products: Floats32
    gradient: Floats32
    residuals: list[Residual]
    doubt: Floats32


@dataclass
class Residual:
    """What a photograph shows beyond the map. box : within the window; relative : (h, w) to the predicted I/F, 0 where not usable

    variance : (h, w) I/F^2, 0 where not usable
    """

    k: int
    box: Window
    predicted: Predicted
    relative: Floats32
    variance: Floats32


def _residual(photograph: Photograph, predicted: Predicted, noise: Noise, box: Window) -> Residual:
    usable, image = predicted.usable, predicted.image
    relative = np.divide(photograph.measured - image, image, out=np.zeros_like(image), where=usable)
    variance = np.where(usable, noise.of(photograph.k, image), 0).astype(np.float32)
    return Residual(photograph.k, box, predicted, relative, variance)


def _level(seen: Sequence[Residual], wanted: Floats32) -> Floats32:
    """Bring the broad residual of each image to that of ``wanted`` (H, W), in place; (H, W) variance of another image's broad difference from it.

    Laws and calibrations err broadly, by much more than white noise of single pixels would; the DEM knows broad relief.
    """
    weight, square, spread = np.zeros((3, *wanted.shape), np.float32)
    level = broadly(wanted) / broadly(np.ones_like(wanted))
    for r in seen:
        trust = _trust(r) * np.divide(
            r.predicted.image**2, r.variance, out=np.zeros_like(r.variance), where=r.variance > 0
        )
        below, above = broadly(trust), broadly(trust * r.relative)
        here = below > 1e-3 * below.max(initial=0)
        broad = np.divide(above, below, out=np.zeros_like(above), where=here) - np.where(here, level[r.box.part], 0)
        r.relative -= np.where(r.variance > 0, broad, 0)
        _raise_variance(r)
        weight[r.box.part] += below
        square[r.box.part] += below * broad**2
        spread[r.box.part] += below**2
    # of n images of equal weight: the mean square times n / (n - 1), and as much by n for their mean
    share = np.divide(spread, weight**2, out=np.ones_like(weight), where=weight > 0)
    scatter = np.divide(square, weight, out=np.zeros_like(weight), where=weight > 0)
    return scatter * (1 + share) / np.maximum(1 - share, 0.5)


def _trust(r: Residual) -> Floats32:
    """(h, w) weights of Student's distribution, 0 where not usable."""
    known = r.variance > 0
    away = np.divide((r.relative * r.predicted.image) ** 2, r.variance, out=np.zeros_like(r.variance), where=known)
    return np.where(known, (FREEDOM + 1) / (FREEDOM + away), 0).astype(np.float32)


def _raise_variance(r: Residual) -> None:
    """Divide an image's variance, in place, by the mean weight around: blocks out of place, other laws, missing relief.

    With weights pixel by pixel, broad differences would appear in the weighed residuals as fine waves, which count most.
    """
    known = r.variance > 0
    here = np.divide(broadly(_trust(r)), broadly(known.astype(np.float32)), out=np.ones_like(r.variance), where=known)
    r.variance /= here


def broadly(values: Floats32) -> Floats32:
    """The broad part of (h, w), see BROAD_PX."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), BROAD_PX, borderType=cv2.BORDER_CONSTANT), np.float32)


def _photograph(references: References, calibration: Calibration, k: int, box: Box) -> Photograph | None:
    """Image ``k`` on a window, None where it shows nothing of it."""
    inner = references.footprints[k].within(box)
    if inner is None:
        return None
    pixels = references.read(k, inner)
    if not pixels.valid.any():
        return None
    light = references.light(k, pixels)
    measured = (pixels.values - calibration.offset[k]) / calibration.gain[k]
    known = pixels.valid & np.isfinite(measured)
    assert light.horizon is not None
    horizon = light.horizon.window(*inner)
    return Photograph(k, Window(*inner), light, np.where(known, measured, np.nan).astype(np.float32), horizon)


@numba.njit(cache=True)
def _add(evidence, gradient, image, relative, east, north, variance):
    """Add one image to the sums of its part of a window."""
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            if not variance[r, c] > 0:
                continue
            i = image[r, c]
            residual, trust = relative[r, c] * i, 1 / variance[r, c]
            p, q = i * east[r, c], i * north[r, c]
            evidence[0, r, c] += trust * i * i
            evidence[1, r, c] += trust * i * p
            evidence[2, r, c] += trust * p * p
            evidence[3, r, c] += trust * i * q
            evidence[4, r, c] += trust * p * q
            evidence[5, r, c] += trust * q * q
            gradient[0, r, c] += trust * i * residual
            gradient[1, r, c] += trust * p * residual
            gradient[2, r, c] += trust * q * residual
