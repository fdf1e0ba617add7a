"""Sky view of facets, and the light that they receive from the terrain around them.

Both integrate over azimuths. In one azimuth a facet with normal n sees elevations above a, t = tan a, with the
cosine-weighted share F(t) = nz / (1 + t^2) + nh (pi/2 - atan t - t / (1 + t^2)), nh the normal's component along the
azimuth (Dozier and Frew 1990, IEEE Trans. Geosci. Remote Sens. 28, 963, whose angles are from the zenith). F above the
horizon is sky; the rest, down to the facet's own plane, is terrain: marching outwards, whenever the running horizon
rises from s to t, F(s) - F(t) of what is seen is the ground there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import GeometryError
from stages.common.arrays import Floats32
from stages.physics.horizon.scene import Overview
from stages.physics.maps.window import Window

CELLS_PER_DISTANCE = 32  # steps and cells grow with distance: a cell is seen under 1/32 rad


@dataclass(frozen=True)
class Surroundings:
    """The map around a window, as block means of heights, m, and I/F (NaN = unknown) on the same cells.

    row, col : the window's first pixel on the map
    """

    elevation: Overview
    radiance_factor: Overview
    row: int
    col: int

    @staticmethod
    def margin_px(overview: Overview) -> int:
        """px around the wanted pixels that a window must reach at full resolution."""
        return overview.factor * CELLS_PER_DISTANCE


def terrain_light(
    elevation: ArrayLike,
    radiance_factor: ArrayLike,
    gsd: float,
    *,
    azimuths: int = 32,
    body_radius: float | None = None,
    inner: Window | None = None,
    surroundings: Surroundings | None = None,
) -> tuple[Floats32, Floats32]:
    """Light that facets receive from the terrain that they see, taken as diffuse (one bounce), and their sky view.

    elevation, radiance_factor : (H, W), m and I/F of the lit ground; NaN = nothing there, or dark
    gsd : m; azimuths : directions looked in, evenly spaced; body_radius : m, terrain at distance d sinks by d^2 / 2R
    inner : the pixels wanted (h, w) (None: all); surroundings : the map beyond (None: nothing is there)
    returns two (h, w) float32. The light is an irradiance in units of the Sun's: times a Lambert albedo it is the I/F
    to add. The sky view is 1 on a plain; beyond the map the ground is level. NaN where the elevation or a slope is.
    """
    z, bright = (np.ascontiguousarray(v, dtype=np.float32) for v in (elevation, radiance_factor))
    if z.ndim != 2 or z.shape != bright.shape:
        raise GeometryError(
            f"radiance_factor: expected the elevation's shape (rows, columns), found {bright.shape} for {z.shape}."
        )
    top, left, height, width = inner or Window(0, 0, *z.shape)
    if surroundings is None:
        levels = np.zeros((0, 4), np.int64)
        far_z = far_bright = np.zeros(1, np.float32)
        row = col = 0
        limit, summit = math.hypot(*z.shape), float(np.fmax.reduce(z, axis=None, initial=-np.inf))
    else:
        overview, row, col = surroundings.elevation, surroundings.row, surroundings.col
        cells = overview.factor << np.arange(len(overview.starts))
        levels = np.column_stack([cells, overview.starts, overview.shapes])
        far_z, far_bright = overview.cells, np.nan_to_num(surroundings.radiance_factor.cells)
        limit, summit = math.hypot(*overview.shape), overview.highest
    distances = _distances(limit)
    level = np.full(distances.size, -1, np.int64)
    for k, (cell, *_) in enumerate(levels):
        level[distances >= cell * CELLS_PER_DISTANCE] = k
    light, sky = np.empty((2, height, width), np.float32)
    bend = 0.0 if body_radius is None else 0.5 / body_radius
    _gather(
        z, np.nan_to_num(bright), far_z, far_bright, levels, row, col, top, left, gsd, bend, summit,
        *_directions(azimuths), distances, level, light, sky,
    )  # fmt: skip
    return light, sky


def form_factors(
    elevation: ArrayLike, gsd: float, azimuths: int, distances: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int32], Floats32]:
    """The matrix behind :func:`terrain_light`, for a small grid that beyond its edges continues as its own mirror image.

    elevation : (H, W), m, without NaN; gsd : m; distances : (n,), px at which terrain is looked at, ascending
    returns compressed rows (H W + 1,), columns (m,) and shares (m,): light = matrix @ I/F, both flattened
    """
    z = np.ascontiguousarray(elevation, dtype=np.float32)
    east, north = _directions(azimuths)
    starts = np.empty(z.size + 1, np.int64)
    places = np.empty((z.size, azimuths * distances.size), np.int32)
    shares = np.empty(places.shape, np.float32)
    _list_factors(z, gsd, east, north, distances, starts, places, shares)
    counts = np.diff(starts)
    kept = np.arange(places.shape[1]) < counts[:, None]
    return starts, places[kept], shares[kept]


def _directions(azimuths: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """East and north components, (azimuths,) each, of evenly spaced directions."""
    if azimuths < 4:
        raise GeometryError(f"azimuths: expected at least 4, found {azimuths}.")
    angle = 2 * math.pi * (np.arange(azimuths) + 0.5) / azimuths
    return np.sin(angle), np.cos(angle)


def _distances(limit: float) -> NDArray[np.float64]:
    """(n,) px at which terrain is looked at: every pixel at first, then in steps of a fixed share of the distance."""
    found = [1.0]
    while found[-1] < limit:
        found.append(found[-1] + max(1.0, found[-1] / CELLS_PER_DISTANCE))
    return np.array(found)


@numba.njit(inline="always")
def _normal(z, r, c, gsd):
    """East, north and up components of a facet's normal: central differences, one-sided at the edges and beside NaN."""
    east = _difference(z[r, max(c - 1, 0)], z[r, c], z[r, min(c + 1, z.shape[1] - 1)], c > 0, c < z.shape[1] - 1)
    north = _difference(z[min(r + 1, z.shape[0] - 1), c], z[r, c], z[max(r - 1, 0), c], r < z.shape[0] - 1, r > 0)
    east, north = east / gsd, north / gsd
    up = 1 / math.sqrt(1 + east * east + north * north)
    return -east * up, -north * up, up


@numba.njit(inline="always")
def _difference(before, here, after, has_before, has_after):
    has_before, has_after = has_before and before == before, has_after and after == after
    if has_before and has_after:
        return 0.5 * (after - before)
    if has_after:
        return after - here
    if has_before:
        return here - before
    return 0.0 * here


@numba.njit(inline="always")
def _share(nz, nh, t):
    """F(t) of a facet with these components of its normal; see the module's docstring."""
    level = 1 / (1 + t * t)
    return nz * level + nh * (0.5 * math.pi - math.atan(t) - t * level)


@numba.njit(inline="always")
def _bilinear(v, start, columns, r0, r1, c0, c1, fy, fx):
    upper, lower = start + r0 * columns, start + r1 * columns
    return (1 - fy) * ((1 - fx) * v[upper + c0] + fx * v[upper + c1]) + fy * (
        (1 - fx) * v[lower + c0] + fx * v[lower + c1]
    )


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _gather(
    z, bright, far_z, far_bright, levels, row, col, top, left, gsd, bend, summit, east, north, distances, level, light, sky
):  # fmt: skip
    near_z, near_bright = z.ravel(), bright.ravel()
    for i in numba.prange(light.shape[0]):
        for j in range(light.shape[1]):
            r, c = top + i, left + j
            here = z[r, c]
            ne, nn, nz = _normal(z, r, c, gsd)
            received, free = 0.0 * nz, 0.0 * nz
            for k in range(east.size):
                nh = ne * east[k] + nn * north[k]
                highest = -nh / nz
                seen = _share(nz, nh, highest)
                alone = True
                for n in range(distances.size):
                    d = distances[n]
                    metres = d * gsd
                    if summit - here <= highest * metres:
                        break  # nothing farther can stand higher
                    y, x = r - d * north[k], c + d * east[k]
                    if level[n] < 0:
                        if not (0 <= y <= z.shape[0] - 1 and 0 <= x <= z.shape[1] - 1):
                            break
                        r0, c0 = min(int(y), z.shape[0] - 1), min(int(x), z.shape[1] - 1)
                        r1, c1 = min(r0 + 1, z.shape[0] - 1), min(c0 + 1, z.shape[1] - 1)
                        fy, fx = y - r0, x - c0
                        h = _bilinear(near_z, 0, z.shape[1], r0, r1, c0, c1, fy, fx)
                    else:
                        cell, start, rows, columns = levels[level[n]]
                        y = (row + y - 0.5 * (cell - 1)) / cell
                        x = (col + x - 0.5 * (cell - 1)) / cell
                        if y < -0.5 or x < -0.5 or y > rows - 0.5 or x > columns - 0.5:
                            break
                        r0, c0 = int(math.floor(y)), int(math.floor(x))
                        fy, fx = y - r0, x - c0
                        r1, c1 = min(r0 + 1, rows - 1), min(c0 + 1, columns - 1)
                        r0, c0 = max(r0, 0), max(c0, 0)
                        h = _bilinear(far_z, start, columns, r0, r1, c0, c1, fy, fx)
                    t = (h - here) / metres - bend * metres
                    alone = alone and t != t
                    if t > highest:
                        share = _share(nz, nh, t)
                        if level[n] < 0:
                            glow = _bilinear(near_bright, 0, z.shape[1], r0, r1, c0, c1, fy, fx)
                        else:
                            glow = _bilinear(far_bright, start, columns, r0, r1, c0, c1, fy, fx)
                        received += (seen - share) * glow
                        highest, seen = t, share
                if alone and highest < 0:
                    seen = _share(nz, nh, 0.0)
                free += seen
            light[i, j] = received / east.size
            sky[i, j] = free / east.size


@numba.njit(inline="always")
def _mirrored(place, count):
    """A coordinate beyond either end folded back, the end itself repeated; within 0 .. count - 1."""
    place = abs((place + 0.5) % (2 * count))
    if place > count:
        place = 2 * count - place
    return min(max(place - 0.5, 0.0), count - 1.0)


@numba.njit(cache=True, error_model="numpy")
def _list_factors(z, gsd, east, north, distances, starts, places, shares):
    """March outwards as ``_gather`` does, at full resolution, and keep one entry of the matrix per rise of the horizon."""
    rows, columns = z.shape
    flat = z.ravel()
    starts[0] = 0
    for p in range(z.size):
        r, c = p // columns, p % columns
        ne, nn, nz = _normal(z, r, c, gsd)
        count = 0
        for k in range(east.size):
            nh = ne * east[k] + nn * north[k]
            highest = -nh / nz
            seen = _share(nz, nh, highest)
            for d in distances:
                y, x = _mirrored(r - d * north[k], rows), _mirrored(c + d * east[k], columns)
                r0, c0 = min(int(y), rows - 1), min(int(x), columns - 1)
                r1, c1 = min(r0 + 1, rows - 1), min(c0 + 1, columns - 1)
                fy, fx = y - r0, x - c0
                t = (_bilinear(flat, 0, columns, r0, r1, c0, c1, fy, fx) - z[r, c]) / (d * gsd)
                if t > highest:
                    share = _share(nz, nh, t)
                    places[p, count] = (r1 if fy > 0.5 else r0) * columns + (c1 if fx > 0.5 else c0)
                    shares[p, count] = (seen - share) / east.size
                    count += 1
                    highest, seen = t, share
        starts[p + 1] = starts[p] + count
