"""A chart of a map grid: where on the grid a point in space stands, fast enough to ask at every step of a ray.

Map projections are smooth, so over one scene (row, col) is a low-order polynomial of the gnomonic coordinates about
the scene's centre. It is fitted to the projection library's own answers and refused where it misses them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from schemas.errors import GeometryError
from stages.common.arrays import Floats
from stages.physics.maps.grid import Grid, unit_vectors

TOLERANCE = 0.005  # px, of the fitted polynomial against the projection itself
_DEGREES = (1, 2, 3, 4, 5, 7, 9)


@dataclass(frozen=True)
class Chart:
    """Gnomonic coordinates about ``axes[2]`` <-> (col, row) on a grid, for points on and near the body.

    axes : (3, 3), rows are east, north and up of the local frame in body-fixed coordinates (origin: body's centre)
    forward : (2, n + 1, n + 1), coefficients of x^i y^j of (col, row), x and y in units of ``scale``
    scale : gnomonic coordinate that the polynomials count as 1
    reach : gnomonic coordinates beyond this are off the chart
    """

    axes: Floats
    forward: Floats
    scale: float
    reach: float
    radius: float

    def to_local(self, points: Floats) -> Floats:
        """Body-fixed (..., 3) -> local frame, origin still at the body's centre."""
        return points @ self.axes.T


def fit_chart(grid: Grid) -> Chart:
    """The chart of a grid. Raises GeometryError where the grid is too large for one (a good part of the body)."""
    height, width = grid.height, grid.width
    margin = 0.1 * max(height, width) + 4
    lon, lat = grid.lonlat((height - 1) / 2, (width - 1) / 2)
    up = unit_vectors(float(lon), float(lat))
    axes = axes_about(up)
    row, col, x, y = _lattice(grid, axes, margin, 29, 0.0)
    check = _lattice(grid, axes, margin, 28, 0.37)
    scale = float(max(np.abs(x).max(), np.abs(y).max()))
    for degree in _DEGREES:
        terms = _terms(x / scale, y / scale, degree)
        # Offsets from the middle keep the normal equations' digits for the pixels' fractions.
        target = np.stack([col, row], axis=1)
        solution = np.linalg.lstsq(terms, target, rcond=None)[0]
        miss = _terms(check[2] / scale, check[3] / scale, degree) @ solution - np.stack([check[1], check[0]], axis=1)
        error = float(np.abs(miss).max())
        if error < TOLERANCE:
            forward = np.zeros((2, degree + 1, degree + 1))
            forward[:, *np.transpose(_powers(degree))] = solution.T
            return Chart(axes, forward, scale, 1.02 * scale, grid.radius)
    raise GeometryError(
        f"the scene spans {height} x {width} px of {grid.gsd:g} m, too much of the body for one perspective view; "
        "crop it (gdal_translate -projwin) to what the camera can see."
    )


def axes_about(up: Floats) -> Floats:
    """(3, 3) rows east, north, up about a place (3,); any east will do at a pole."""
    east = np.cross([0.0, 0.0, 1.0], up)
    if np.linalg.norm(east) < 1e-9:
        east = np.array([0.0, 1.0, 0.0])
    east = east / np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def _lattice(grid: Grid, axes: Floats, margin: float, count: int, shift: float) -> tuple[Floats, ...]:
    """(row, col) of a lattice over the grid and a margin, denser towards the edges, and its gnomonic coordinates."""
    node = -np.cos(np.pi * (np.arange(count) + 0.5 * shift) / (count - 1 + shift))
    rows = (grid.height - 1) / 2 + node * ((grid.height - 1) / 2 + margin)
    cols = (grid.width - 1) / 2 + node * ((grid.width - 1) / 2 + margin)
    row, col = (v.ravel() for v in np.meshgrid(rows, cols, indexing="ij"))
    lon, lat = grid.lonlat(row, col)
    good = np.isfinite(lon) & np.isfinite(lat)
    local = unit_vectors(np.where(good, lon, 0.0), np.where(good, lat, 0.0)) @ axes.T
    good &= local[:, 2] > 0.2
    if good.mean() < 0.9:
        raise GeometryError(
            f"the scene spans {grid.height} x {grid.width} px of {grid.gsd:g} m, more than one side of the body; crop it to what the camera can see."
        )
    local = local[good]
    return row[good], col[good], local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]


def _powers(degree: int) -> list[tuple[int, int]]:
    """(i, j) of the terms x^i y^j of a polynomial."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def _terms(x: Floats, y: Floats, degree: int) -> Floats:
    """(n, terms) at scaled gnomonic coordinates (n,)."""
    return np.stack([x**i * y**j for i, j in _powers(degree)], axis=1)


@numba.njit(cache=True, inline="always")
def chart_position(forward, x, y):
    """(col, row) at scaled gnomonic coordinates, by Horner's rule in both."""
    n = forward.shape[1] - 1
    col, row = 0.0, 0.0
    for i in range(n, -1, -1):
        inner_col, inner_row = 0.0, 0.0
        for j in range(n - i, -1, -1):
            inner_col = inner_col * y + forward[0, i, j]
            inner_row = inner_row * y + forward[1, i, j]
        col = col * x + inner_col
        row = row * x + inner_row
    return col, row


@numba.njit(cache=True)
def chart_gradient(forward, x, y):
    """d(col)/dx, d(col)/dy, d(row)/dx, d(row)/dy at scaled gnomonic coordinates."""
    n = forward.shape[1] - 1
    col_x, col_y, row_x, row_y = 0.0, 0.0, 0.0, 0.0
    power_x = 1.0  # x^i
    before_x = 0.0  # x^(i-1)
    for i in range(n + 1):
        power_y, before_y = 1.0, 0.0
        for j in range(n + 1 - i):
            dx = i * before_x * power_y
            dy = j * power_x * before_y
            col_x += forward[0, i, j] * dx
            col_y += forward[0, i, j] * dy
            row_x += forward[1, i, j] * dx
            row_y += forward[1, i, j] * dy
            before_y = power_y
            power_y *= y
        before_x = power_x
        power_x *= x
    return col_x, col_y, row_x, row_y


def step_length(grid: Grid) -> float:
    """The longest step, m, over which a straight ray stays within 0.01 px of a straight line on the grid."""
    extent = 0.1 * max(grid.height, grid.width) * grid.gsd
    return max(min(math.sqrt(0.04 * grid.radius * grid.gsd), extent), grid.gsd)
