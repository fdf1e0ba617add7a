"""Displacement of an image over the ground: how far from its true position it shows each place.

A displacement is constant, linear over the ground, or a smooth field (uniform bicubic B-splines). A share of the relief
displacement may come on top, which images have that were projected onto a sphere instead of the terrain: they show ground
that is h higher h tan(emission) farther away from the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from stages.common.arrays import Floats
from stages.physics.maps.grid import Grid, lonlat_of_points, unit_vectors

FORMS = ("constant", "affine", "field")  # from the simplest to the most general
# (row, col, height m) -> (dx, dy) px of the full relief displacement there
Relief = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Basis:
    """Basis functions over the ground whose weighted sum is a displacement: a constant, a plane, or cubic B-splines.

    form : one of FORMS; origin : (row, col) of the middle for 'affine', of the first knot for 'field'
    step : px per unit of the functions' coordinates: the distance of the knots; cells : (rows, cols) between a field's knots
    """

    form: str
    origin: tuple[float, float]
    step: float = 1.0
    cells: tuple[int, int] = (0, 0)

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return {"constant": 1, "affine": 3}.get(self.form, (self.cells[0] + 3) * (self.cells[1] + 3))

    def matrix(self, row: Floats, col: Floats) -> Floats:
        """(n, size) values of every basis function at n places.

        row, col : (n,) px
        """
        r, c = self._places(row, col)
        if self.form != "field":
            return np.stack([np.ones(r.shape), c, r], axis=1)[:, : self.size]
        down, across = _cubic(r, self.cells[0]), _cubic(c, self.cells[1])
        return np.einsum("na,nb->nab", down, across).reshape(len(r), -1)

    def mixture(self, coefficients: Floats, row: Floats, col: Floats) -> Floats:
        """The basis functions weighted by ``coefficients`` (size,). row, col : px, of any shape; returns the same shape"""
        r, c = self._places(row, col)
        if self.form != "field":
            parts = (np.ones(r.shape), c, r)
            return np.asarray(sum(k * p for k, p in zip(coefficients, parts, strict=False)), float)
        knots = coefficients.reshape(self.cells[0] + 3, self.cells[1] + 3)
        places = np.stack([r.ravel() + 1, c.ravel() + 1])
        return map_coordinates(knots, places, order=3, prefilter=False, mode="nearest").reshape(r.shape)

    def bending(self) -> Floats:
        """(size, size) quadratic form of how much a mixture bends: second differences of the knots along rows and columns.

        Eilers & Marx 1996, Stat. Sci. 11:89. Displacements that are linear over the ground do not bend.
        """
        if self.form != "field":
            return np.zeros((self.size, self.size))
        rows, cols = (n + 3 for n in self.cells)
        one, two = (lambda n: np.diff(np.eye(n), axis=0)), (lambda n: np.diff(np.eye(n), n=2, axis=0))
        parts = (
            np.kron(two(rows), np.eye(cols)),
            np.kron(np.eye(rows), two(cols)),
            np.sqrt(2) * np.kron(one(rows), one(cols)),
        )
        return np.asarray(sum(p.T @ p for p in parts), float)

    def _places(self, row: Floats, col: Floats) -> tuple[Floats, Floats]:
        r, c = (row - self.origin[0]) / self.step, (col - self.origin[1]) / self.step
        if self.form == "field":  # beyond its edge a field stays constant
            r, c = np.clip(r, 0, self.cells[0]), np.clip(c, 0, self.cells[1])
        rows, cols = np.broadcast_arrays(r, c)
        return rows, cols


def _cubic(place: Floats, cells: int) -> Floats:
    """(n, cells + 3) the uniform cubic B-splines at places 0 .. cells."""
    distance = np.abs(place[:, None] + 1 - np.arange(cells + 3))
    near, far = 2 / 3 - distance**2 * (1 - distance / 2), (2 - distance) ** 3 / 6
    return np.where(distance < 1, near, np.where(distance < 2, far, 0.0))


@dataclass(frozen=True)
class Field:
    """Displacement of one image over the ground, and the evidence for it.

    coefficients : (2, size) px of the basis for dx and dy; share : of the relief displacement; share_error : its standard
        error, NaN where no share was tried; reference : m, height that relief does not displace
    mean : (dx, dy) px over its blocks, without relief; freedom : parameters per axis that the data determine
    used, regions : numbers of blocks fitted and tried; scatter : px, robust standard deviation of one block
    sigma : px, standard error of the mean: that over the blocks, with one block's scatter added in quadrature, since
        albedo that follows the terrain biases all blocks alike (by up to 1.4 times the scatter in simulated scenes)
    correlation : median over the blocks used; held_out : share of held-out blocks' squared shifts that it explains
    refused : why it must not be applied, empty where it may be
    """

    basis: Basis
    coefficients: Floats
    used: int
    regions: int
    scatter: float
    sigma: float
    correlation: float
    share: float = 0.0
    share_error: float = np.nan
    reference: float = 0.0
    mean: tuple[float, float] = (0.0, 0.0)
    freedom: float = 0.0
    held_out: float = np.nan
    refused: str = field(default="")

    @property
    def accepted(self) -> bool:
        """Whether the evidence was enough."""
        return not self.refused

    @property
    def varies(self) -> bool:
        """Whether it differs from place to place."""
        return self.basis.form != "constant" or self.share != 0.0

    @property
    def form(self) -> str:
        """The form of the fit, for people."""
        return self.basis.form + (" + relief" if self.share else "")

    def at(self, row: ArrayLike, col: ArrayLike, relief: tuple[Floats, Floats] | None = None) -> tuple[Floats, Floats]:
        """(dx, dy), px, at places on the grid, 0 where refused.

        row, col : px, broadcastable; relief : (dx, dy) px of the full relief displacement there
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        if self.refused:
            return np.zeros(row.shape), np.zeros(row.shape)
        dx, dy = (self.basis.mixture(c, row, col) for c in self.coefficients)
        return (dx, dy) if relief is None else (dx + self.share * relief[0], dy + self.share * relief[1])


def relief_displacement(grid: Grid, camera_position: Floats, reference: float) -> Relief:
    """Displacement of a frame camera's image that was projected onto the sphere at ``reference`` m, not the terrain.

    A place is shown where the ray from the camera through it meets that sphere, h tan(emission) farther away; where the
    ray misses the sphere, the displacement is 0. camera_position : (3,) body-fixed, m
    """
    camera = np.asarray(camera_position, float)
    radius = grid.radius + reference

    def displacement(row: Floats, col: Floats, height: Floats) -> tuple[Floats, Floats]:
        ground = unit_vectors(*grid.lonlat(row, col)) * (grid.radius + height)[..., None]
        ray = ground - camera
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        along = (ray * camera).sum(-1)
        root = along**2 - (camera @ camera - radius**2)
        with np.errstate(invalid="ignore"):
            end = camera + (-along - np.sqrt(root))[..., None] * ray
            lon, lat = lonlat_of_points(end)
        known = np.isfinite(lon) & np.isfinite(lat)
        shown_row, shown_col = grid.rowcol_of_lonlat(np.where(known, lon, 0.0), np.where(known, lat, 0.0))
        dx, dy = np.where(known, shown_col - col, 0.0), np.where(known, shown_row - row, 0.0)
        return np.nan_to_num(dx, posinf=0, neginf=0), np.nan_to_num(dy, posinf=0, neginf=0)

    return displacement
