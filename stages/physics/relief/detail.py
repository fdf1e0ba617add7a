"""Invented relief below a DEM's pixels, as a function of place: craters, rocks and roughness that the DEM cannot show.

A rough surface with all scales up to a few DEM pixels is drawn without a look at the DEM; then its part that the DEM knows, the
means over the DEM's pixels, is exchanged for the DEM's own (conditional simulation: Journel & Huijbregts 1978, Mining
Geostatistics). What is exchanged is interpolated by quadratic splines whose means over the pixels are the given ones. So the mean
over a DEM pixel stays the DEM's, and what is added depends on the seed, the place on the body and the DEM near it alone.

Craters: production, equilibrium and decay as in ``craters``. Rocks: as in ``rocks``. Roughness: fractal noise with the Hurst
exponent of the highlands between kilometres and the footprints of a laser (0.95, Rosenburg et al. 2011, J. Geophys. Res. 116, E02001), as strong as the DEM near the place is rough beyond what its craters explain.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numba import njit, prange
from rasterio.transform import Affine
from scipy.ndimage import distance_transform_edt, spline_filter

from stages.common.arrays import Floats, Floats32
from stages.physics.maps.grid import Grid, local_metric_crs, unit_vectors
from stages.physics.maps.window import Window
from stages.physics.relief.cells import draw_places
from stages.physics.relief.craters import REACH, Craters, cumulative_density, depth_factors, diameters, stamp
from stages.physics.relief.noise import LACUNARITY, gradient_noise3
from stages.physics.relief.rocks import add_rocks, largest_rock, rock_density, rock_diameters

FINEST = 64  # pixels along one of the DEM
LARGEST_CRATER = 1.5  # DEM pixels: of larger ones the DEM has the bowl
SMALLEST = 3.0  # pixels of what is drawn, so that the grid shows its form
TRANSITION = 200.0  # m, from which on craters are not in equilibrium (a surface of some 3 Gyr)
HURST = 0.95
LONGEST_WAVE, SHORTEST_WAVE = 8.0, 2.5  # DEM pixels, pixels
MARGIN = 8  # DEM pixels from which on means no longer reach: 0.27 per pixel
NEAR = 32  # DEM pixels to either side, over which its roughness is measured
MEANS_FINER = 8  # most pixels along one of the DEM, from which its means are taken
TILE = 256  # pixels
MOST_TILES = 1024  # kept, 0.3 MB each
NODE = 16  # pixels between exact places
CELL_COUNT = 150  # craters or rocks in a cell


class Detail:
    """Refined heights of a DEM. elevation : (H, W), anything that slices, m, NaN = unknown; rock_abundance : share of ground under rocks"""

    def __init__(self, elevation: Any, grid: Grid, seed: int, rock_abundance: float) -> None:
        self.elevation, self.grid, self.seed, self.rock_abundance = elevation, grid, seed, rock_abundance
        self._tiles: OrderedDict[tuple[str, int, Window], Floats32] = OrderedDict()

    def heights(self, window: Window, finer: int) -> Floats32:
        """(h finer, w finer) m of a window of the DEM's pixels."""
        return self._assemble(window, finer, finer, self._refined)

    def _assemble(self, window: Window, finer: int, scale: int, make: Callable[[Window, int], Floats32]) -> Floats32:
        """(h scale, w scale) from tiles that ``make`` makes for ``finer``; the DEM may end within a tile."""
        edge = max(MARGIN, TILE // finer)
        result = np.empty((window.height * scale, window.width * scale), np.float32)
        for i in range(window.row // edge, (window.row + window.height - 1) // edge + 1):
            for j in range(window.col // edge, (window.col + window.width - 1) // edge + 1):
                tile = Window(i * edge, j * edge, edge, edge)
                top, left = max(tile.row, window.row), max(tile.col, window.col)
                bottom = min(tile.row + edge, window.row + window.height)
                right = min(tile.col + edge, window.col + window.width)
                shared = Window(*(scale * n for n in (top, left, bottom - top, right - left)))
                corners = (Window(w.row * scale, w.col * scale, 0, 0) for w in (window, tile))
                there, here = (shared.within(corner).part for corner in corners)
                result[there] = self._kept(make, tile, finer)[here]
        return result

    def _kept(self, make: Callable[[Window, int], Floats32], tile: Window, finer: int) -> Floats32:
        """What ``make`` gives for a tile, made once."""
        key = (make.__name__, finer, tile)
        values = self._tiles.pop(key, None)
        self._tiles[key] = values = make(tile, finer) if values is None else values
        while len(self._tiles) > MOST_TILES:
            self._tiles.popitem(last=False)
        return values

    def _refined(self, tile: Window, finer: int) -> Floats32:
        """Heights of a tile: the free relief with its means over DEM pixels exchanged for the DEM's."""
        wide = _grown(tile, MARGIN)
        known = self._dem(wide)
        means = self._assemble(wide, min(finer, MEANS_FINER), 1, self._means)
        inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
        part = Window(MARGIN, MARGIN, tile.height, tile.width)
        base = spline_through_means(_filled(known) - means, finer)[Window(*(n * finer for n in part)).part]
        free = self._kept(self.free, tile, finer)
        # what smaller features than those in ``means`` add, millimetres, goes by a bump in each pixel that ends flat at its border
        bump = 1 - np.cos(2 * math.pi * (np.arange(finer) + 0.5) / finer)
        excess = _block_means(free, finer) - means[inner]
        heights = base + free - np.kron(excess, np.outer(bump, bump))
        heights[np.kron(np.isnan(known[inner]), np.ones((finer, finer), bool))] = np.nan
        return heights.astype(np.float32)

    def _means(self, tile: Window, finer: int) -> Floats32:
        """(h, w) means of the free relief over the DEM's pixels."""
        return _block_means(self._kept(self.free, tile, finer), finer)

    def free(self, window: Window, finer: int) -> Floats32:
        """(h finer, w finer) m: relief that knows nothing of the DEM's heights."""
        margin = NEAR + 3
        known = self._dem(_grown(window, margin))
        rough = np.maximum(mean_curvature(known, NEAR) - self._usual[0], 0.0) / self._usual[1]
        rough = np.sqrt(rough[margin - 2 : 2 - margin, margin - 2 : 2 - margin])
        shape = (window.height * finer, window.width * finer)
        place = (np.arange(n) / finer + 0.5 / finer + 0.5 for n in shape)
        row, col = (v.astype(np.float32) for v in np.meshgrid(*place, indexing="ij"))
        amplitude = cv2.remap(rough.astype(np.float32), col, row, cv2.INTER_LINEAR)
        return amplitude * self._noise(self.grid, window, finer) + self._things(self.grid, window, finer)

    def _dem(self, window: Window) -> Floats32:
        """(h, w) m, NaN outside."""
        result = np.full((window.height, window.width), np.nan, np.float32)
        rows, cols = self.elevation.shape
        top, left = max(0, window.row), max(0, window.col)
        bottom, right = min(rows, window.row + window.height), min(cols, window.col + window.width)
        if bottom > top and right > left:
            result[top - window.row : bottom - window.row, left - window.col : right - window.col] = self.elevation[
                top:bottom, left:right
            ]
        return result

    @cached_property
    def _usual(self) -> tuple[float, float]:
        """Mean squared curvature of the means over DEM pixels of craters, the DEM's own among them, and of noise of amplitude 1."""
        n, gsd, finer = 192, self.grid.gsd, 4
        crs = local_metric_crs(0.0, 0.0, self.grid.radius)
        grid = Grid(crs.to_wkt(), Affine(gsd, 0, -n * gsd / 2, 0, -gsd, n * gsd / 2), n, n, self.grid.radius)
        patch = Window(0, 0, n, n)
        fields = self._things(grid, patch, finer, n / 6), self._noise(grid, patch, finer)
        things, noise = (float(squared_curvature(_block_means(field, finer)).mean()) for field in fields)
        return things, noise

    def _noise(self, grid: Grid, window: Window, finer: int) -> Floats32:
        """Fractal noise; a wave as long as a DEM pixel has about the amplitude of one octave of unit gradients."""
        rows, cols = window.height * finer, window.width * finer
        at_row, at_col = (np.arange(-(-n // NODE) + 1) * NODE for n in (rows, cols))
        row, col = np.meshgrid(
            (at_row + 0.5) / finer - 0.5 + window.row, (at_col + 0.5) / finer - 0.5 + window.col, indexing="ij"
        )
        places = unit_vectors(*grid.lonlat(row, col)) * grid.radius
        out = np.zeros((rows, cols), np.float32)
        longest, shortest = LONGEST_WAVE * grid.gsd, SHORTEST_WAVE * grid.gsd / finer
        # wave lengths are the same everywhere, whatever the DEM's pixels
        for octave in range(math.ceil(-math.log(longest, LACUNARITY)), math.floor(-math.log(shortest, LACUNARITY)) + 1):
            wave = LACUNARITY**-octave
            fade = min(1.0, (wave / shortest - 1) / (LACUNARITY - 1)) * min(
                1.0, (longest / wave - 1) / (LACUNARITY - 1)
            )
            turn = np.linalg.qr(np.random.default_rng(octave + 1000).normal(size=(3, 3)))[0]
            _add_octave(out, places @ turn / wave, fade * (wave / grid.gsd) ** HURST, self.seed % 2**31 * 131 + octave)
        return out

    def _things(self, grid: Grid, window: Window, finer: int, largest: float | None = None) -> Floats32:
        """Craters, up to a diameter in DEM pixels, and rocks."""
        fine = grid.gsd / finer
        piece = grid.window(*window)
        x0, y0 = (float(v) for v in piece.xy(0.5 / finer - 0.5, 0.5 / finer - 0.5))
        shape = (window.height * finer, window.width * finer)
        heights = stamp(
            self._craters(grid, window, SMALLEST * fine, (largest or LARGEST_CRATER) * grid.gsd), x0, y0, fine, shape
        )[0]
        for size in _octaves(SMALLEST * fine, largest_rock(self.rock_abundance)):
            density = float(rock_density(size, self.rock_abundance) - rock_density(2 * size, self.rock_abundance))
            x, y, u = self._draw(grid, window, size, density, 1, size)
            d = rock_diameters(u[:, 0], size, 2 * size, self.rock_abundance)
            d = np.where(d >= SMALLEST * fine, d, 0.0)
            add_rocks(heights, x0, y0, fine, x, y, d)
        return heights

    def _craters(self, grid: Grid, window: Window, smallest: float, largest: float) -> Craters:
        """The craters of a window and its surroundings between two diameters, m, largest first."""
        parts = []
        for size in _octaves(smallest, largest):
            many, few = (float(cumulative_density(d, 1.0, TRANSITION)) for d in (size, 2 * size))
            x, y, u = self._draw(grid, window, size, many - few, 0, REACH * size)
            d = diameters(u[:, 0], size, 2 * size, 1.0, TRANSITION)
            age = u[:, 1] * np.minimum(1.0, TRANSITION / d)
            scatter = 1.0 + 0.16 * (u[:, 2] + u[:, 3] - 1.0)
            shape = (u[:, 4] * 2**30).astype(np.int64) + 1
            whole = Craters(x, y, d, age, depth_factors(scatter, d), shape)
            parts.append(whole.select((d >= smallest) & (d < largest)))
        joined = Craters(
            *(
                np.concatenate([getattr(p, n) for p in parts])
                for n in ("x", "y", "diameter", "age", "depth_factor", "seed")
            )
        )
        return joined.select(np.argsort(-joined.diameter, kind="stable"))

    def _draw(
        self, grid: Grid, window: Window, size: float, density: float, kind: int, reach: float
    ) -> tuple[Floats, Floats, Floats]:
        """Places within ``reach`` (m) of a window with five numbers each; density : per m2; kind : 0 craters, 1 rocks"""
        margin = reach / grid.gsd
        rows = (window.row - 0.5 - margin, window.row + window.height - 0.5 + margin)
        cols = (window.col - 0.5 - margin, window.col + window.width - 0.5 + margin)
        key = (self.seed, kind, round(math.log2(size)) + 64)
        return draw_places(grid, rows, cols, math.sqrt(CELL_COUNT / density), density, key, 5)


def spline_through_means(means: Floats, finer: int) -> Floats:
    """(h finer, w finer) from means over pixels (h, w): a quadratic spline, smooth to the slope, with just these means."""
    coefficients = spline_filter(
        means, 3, mode="mirror"
    )  # a pixel's mean weighs its coefficients as a cubic spline its nodes
    edge = np.arange(finer + 1) / finer - 0.5
    antiderivatives = ((edge - 0.5) ** 3 / 6, 0.75 * edge - edge**3 / 3, (edge + 0.5) ** 3 / 6)
    weights = (
        np.diff(np.stack(antiderivatives), axis=1) * finer
    )  # (3, finer): of the pixel before, the pixel, the one after
    for axis in (0, 1):
        padded = np.pad(np.moveaxis(coefficients, axis, 0), ((1, 1), (0, 0)), mode="reflect")
        parts = sum(weights[k][:, None] * padded[k : k + len(padded) - 2, None] for k in range(3))
        coefficients = np.moveaxis(np.reshape(parts, (-1, padded.shape[1])), 0, axis)
    return coefficients


def squared_curvature(heights: Floats32) -> Floats32:
    """(h - 2, w - 2) m2: mean of the squared second differences along rows and along columns."""
    z = np.asarray(heights, np.float64)
    down = z[2:, 1:-1] - 2 * z[1:-1, 1:-1] + z[:-2, 1:-1]
    across = z[1:-1, 2:] - 2 * z[1:-1, 1:-1] + z[1:-1, :-2]
    return np.asarray(0.5 * (down**2 + across**2), np.float32)


def mean_curvature(heights: Floats32, near: int) -> Floats32:
    """(h - 2, w - 2) m2: the squared curvature, mean over what is known within ``near`` pixels; 0 where nothing is."""
    squares = squared_curvature(heights)
    known = np.isfinite(squares)
    size, border = (2 * near + 1, 2 * near + 1), cv2.BORDER_ISOLATED | cv2.BORDER_REFLECT
    parts = (np.where(known, squares, 0.0), known.astype(np.float64))
    total, share = (cv2.blur(v, size, borderType=border) for v in parts)
    return np.where(share > 1e-6, total / np.maximum(share, 1e-6), 0.0).astype(np.float32)


def _octaves(smallest: float, largest: float) -> list[float]:
    """Powers of 2 from the one below ``smallest`` to the last one below ``largest``."""
    return [2.0**k for k in range(math.floor(math.log2(smallest)), math.ceil(math.log2(largest)))]


def _grown(window: Window, margin: int) -> Window:
    return Window(window.row - margin, window.col - margin, window.height + 2 * margin, window.width + 2 * margin)


def _filled(heights: Floats32) -> Floats:
    """Unknown heights as the nearest known ones, 0 where there are none."""
    unknown = np.isnan(heights)
    if unknown.all():
        return np.zeros(heights.shape)
    if not unknown.any():
        return heights.astype(float)
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return heights[tuple(nearest)].astype(float)


def _block_means(values: Floats32, finer: int) -> Floats32:
    height, width = values.shape
    means = values.reshape(height // finer, finer, width // finer, finer).mean(axis=(1, 3), dtype=np.float64)
    return means.astype(np.float32)


@njit(parallel=True, fastmath=True, cache=True)
def _add_octave(out, places, amplitude, seed):
    """Add noise at places that are known at every NODE-th pixel, (a, b, 3), in wave lengths."""
    height, width = out.shape
    for r in prange(height):
        i = r // NODE
        v = (r - i * NODE) / NODE
        for c in range(width):
            j = c // NODE
            u = (c - j * NODE) / NODE
            a, b, d, e = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
            x = a * places[i, j, 0] + b * places[i, j + 1, 0] + d * places[i + 1, j, 0] + e * places[i + 1, j + 1, 0]
            y = a * places[i, j, 1] + b * places[i, j + 1, 1] + d * places[i + 1, j, 1] + e * places[i + 1, j + 1, 1]
            z = a * places[i, j, 2] + b * places[i, j + 1, 2] + d * places[i + 1, j, 2] + e * places[i + 1, j + 1, 2]
            out[r, c] += np.float32(amplitude * gradient_noise3(x, y, z, seed))
