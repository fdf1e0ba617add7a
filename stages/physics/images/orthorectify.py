"""Orthorectification: what a camera saw of each ground pixel, through the terrain to the detector.

For every pixel the four corners of its patch of terrain are followed to the detector; the image is averaged over the
quadrilateral between them, so that a grid coarser than the image gets area means and a finer one is interpolated.
Terrain between a patch and the camera hides it. Only the window of the image that a crop needs is read.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.physics.cameras import Camera
from stages.physics.images.area_means import ReadWindow, area_means
from stages.physics.maps.grid import CSM_CENTRE, Grid, lonlat_of_points, unit_vectors

# (row, col) arrays -> (dx, dy), px along columns and rows
Displacement = Callable[[NDArray, NDArray], tuple[NDArray, NDArray]]

BLOCK = 256  # px a side of the ground that is worked on at a time
OUTLINE = 33  # lines and samples, or more, that a footprint is taken from
FARTHEST_PX = 2048  # from which terrain can hide a crop


@dataclass(frozen=True)
class Terrain:
    """A piece of the scene: the ground to orthorectify, with the surroundings that can hide it.

    elevation : (H, W), m above the sphere, NaN = unknown; grid : where it lies
    """

    elevation: NDArray
    grid: Grid


@dataclass(frozen=True)
class Ortho:
    """An image on the ground's grid, all (h, w).

    image : NaN where not seen; valid : seen, with every contributing pixel valid; hidden : by terrain, or turned away
    detector_line, detector_sample : array indices on the detector, NaN off it
    emission, phase : rad, between the true ray and the terrain's normal, and the true ray and the Sun (NaN without Sun)
    camera_position : (3,) body-fixed, m, while the middle of the crop was taken
    """

    image: NDArray[np.float32]
    valid: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    detector_line: NDArray[np.float32]
    detector_sample: NDArray[np.float32]
    emission: NDArray[np.float32]
    phase: NDArray[np.float32]
    camera_position: Floats


def orthorectify(
    read_window: ReadWindow,
    camera: Camera,
    terrain: Terrain,
    box: tuple[int, int, int, int],
    sun_position: Floats | None = None,
    displacement: Displacement | None = None,
) -> Ortho:
    """What ``camera`` saw of the pixels ``box`` = (row, col, height, width) of ``terrain``.

    read_window : (line, sample, lines, samples) -> pixels, NaN = nodata; only asked for windows inside the image
    sun_position : (3,) body-fixed, m; the camera model's own where None
    displacement : of the image: pixel (row, col) is looked up where the camera model sees the place (row + dy, col + dx)
        at the height of (row, col)
    """
    row, col, height, width = box
    pixels = np.meshgrid(np.arange(row, row + height), np.arange(col, col + width), indexing="ij")
    centres = _ground(terrain, *pixels)
    line, sample = camera.ground_to_image(centres if displacement is None else _ground(terrain, *pixels, displacement))
    seen = camera.inside(line, sample)
    view, view_position = _view(camera, centres, line, sample, seen)
    emission, hidden = _visibility(terrain, box, centres, view)
    sun = _sun(camera, line, seen, sun_position)
    phase = np.full((height, width), np.nan)
    if sun is not None:
        to_sun = sun - centres
        cosine = (to_sun * view).sum(-1) / np.linalg.norm(to_sun, axis=-1)
        phase = np.arccos(np.clip(cosine, -1, 1))
    image = np.full((height, width), np.nan, np.float32)
    complete = np.zeros((height, width), bool)
    wanted = seen & ~hidden & np.isfinite(emission)
    for r in range(0, height, BLOCK):
        for c in range(0, width, BLOCK):
            part = np.s_[r : r + BLOCK, c : c + BLOCK]
            h, w = wanted[part].shape
            if wanted[part].any():
                corners = _corners(terrain, camera, (row + r, col + c, h, w), line[part], displacement)
                image[part], complete[part] = area_means(
                    read_window, (camera.lines, camera.samples), *corners, wanted[part]
                )
    known = seen & np.isfinite(centres[..., 0])
    return Ortho(
        image=image,
        valid=complete & wanted,
        hidden=hidden & seen,
        detector_line=np.where(known, line - CSM_CENTRE, np.nan).astype(np.float32),
        detector_sample=np.where(known, sample - CSM_CENTRE, np.nan).astype(np.float32),
        emission=np.where(known, emission, np.nan).astype(np.float32),
        phase=np.where(known, phase, np.nan).astype(np.float32),
        camera_position=view_position,
    )


def footprint(camera: Camera, grid: Grid, heights: tuple[float, float]) -> tuple[int, int, int, int] | None:
    """(row, col, height, width) on ``grid`` that holds what the image shows at any of these heights, None for nothing.

    heights : lowest and highest elevation, m. Pixels that look past the body do not count.
    """
    places = np.meshgrid(camera.edge_lines(OUTLINE), np.linspace(0, camera.samples, OUTLINE), indexing="ij")
    # above the grid's own sphere, which the camera model need not share
    points = np.stack([camera.image_to_ground(*places, h + grid.radius - camera.semi_axes[0]) for h in heights])
    points = points[np.isfinite(points).all(-1)]
    if not len(points):
        return None
    row, col = grid.rowcol_of_lonlat(*lonlat_of_points(points))
    good = np.isfinite(row) & np.isfinite(col)
    if not good.any():
        return None
    row, col = row[good], col[good]
    r0, c0 = max(0, math.floor(row.min()) - 1), max(0, math.floor(col.min()) - 1)
    r1, c1 = min(grid.height, math.ceil(row.max()) + 2), min(grid.width, math.ceil(col.max()) + 2)
    return (r0, c0, r1 - r0, c1 - c0) if r1 > r0 and c1 > c0 else None


def reach_px(relief: float, emission: float, gsd: float) -> int:
    """Pixels around a crop from which terrain can hide it from a camera: relief x tan(emission), and two for the corners.

    relief : m; emission : rad; gsd : m
    """
    slope = math.tan(min(emission, math.radians(89)))
    return min(FARTHEST_PX, math.ceil(relief * slope / gsd) + 2)


# --- ground ---------------------------------------------------------------------------------------------------------


def _ground(terrain: Terrain, row: NDArray, col: NDArray, displacement: Displacement | None = None) -> Floats:
    """(..., 3) body-fixed points of the terrain at fractional (row, col), NaN where it is unknown."""
    height = bilinear(terrain.elevation, row, col)
    if displacement is not None:
        dx, dy = displacement(np.asarray(row, float), np.asarray(col, float))
        row, col = row + dy, col + dx
    return unit_vectors(*terrain.grid.lonlat(row, col)) * (terrain.grid.radius + height)[..., None]


def bilinear(values: NDArray, row: NDArray, col: NDArray) -> Floats:
    """Bilinear samples between pixel centres, extrapolated beyond the outermost.

    values : (H, W); row, col : (...,) px; returns (...,)
    """
    row, col = np.asarray(row, float), np.asarray(col, float)
    r = np.clip(np.floor(row).astype(int), 0, max(0, values.shape[0] - 2))
    c = np.clip(np.floor(col).astype(int), 0, max(0, values.shape[1] - 2))
    r1, c1 = np.minimum(r + 1, values.shape[0] - 1), np.minimum(c + 1, values.shape[1] - 1)
    f, g = np.clip(row - r, 0, 1), np.clip(col - c, 0, 1)
    total = np.zeros(row.shape)
    for a, b, weight in ((r, c, (1 - f) * (1 - g)), (r, c1, (1 - f) * g), (r1, c, f * (1 - g)), (r1, c1, f * g)):
        total += np.where(weight > 0, values[a, b] * np.where(weight > 0, weight, 1), 0)
    return total


def _view(
    camera: Camera, centres: Floats, line: Floats, sample: Floats, seen: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """(h, w, 3) unit vectors along the true rays towards the camera, and its position (3,) for the middle of the crop."""
    known = np.isfinite(line) & np.isfinite(sample)
    at = np.where(known, line, camera.lines / 2)
    across = np.where(known, sample, camera.samples / 2)
    _, direction = camera.rays(at, across)
    # A camera infinitely far away has parallel rays; for the others this is the direction from the point to it.
    view = np.where(known[..., None], -direction, np.nan)
    inside = np.argwhere(seen)
    middle = inside[len(inside) // 2] if len(inside) else np.array(line.shape) // 2
    return view, np.asarray(camera.position(at[tuple(middle)], across[tuple(middle)]), float)


def _visibility(
    terrain: Terrain, box: tuple[int, int, int, int], centres: Floats, view: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """(h, w) emission angle, rad, and whether the facet faces away from the camera or other terrain hides it."""
    row, col, height, width = box
    z, grid = np.asarray(terrain.elevation, float), terrain.grid
    cosine = (_normals(terrain, box) * view).sum(-1)
    emission = np.arccos(np.clip(cosine, -1, 1))
    # horizontal path of the ray along the grid's own axes; _march lets the ground fall away beneath it
    up = centres / np.linalg.norm(centres, axis=-1, keepdims=True)
    rise = (up * view).sum(-1)
    across = view - rise[..., None] * up
    axes = grid.local_frames(row + (height - 1) / 2, col + (width - 1) / 2).axes[0]  # rows east, north, up
    east, north = across @ axes[0], across @ axes[1]
    level = np.hypot(east, north)
    hidden = np.zeros((height, width), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.isfinite(rise) & np.isfinite(z[row : row + height, col : col + width])
        slope = np.where(level > 1e-9, rise / level, np.inf)
        step_row, step_col = np.where(level > 1e-9, -north / level, 0.0), np.where(level > 1e-9, east / level, 0.0)
    highest = float(z.max(where=np.isfinite(z), initial=-np.inf))
    slope = np.where(known, slope, np.nan)
    _march(z, row, col, slope, step_row, step_col, grid.gsd, grid.radius, highest, hidden)
    return emission, hidden | (known & (cosine <= 0))


def _normals(terrain: Terrain, box: tuple[int, int, int, int]) -> Floats:
    """(h, w, 3) unit normals, body-fixed, by central differences of the terrain's points (one-sided at its edges)."""
    row, col, height, width = box
    limit_r, limit_c = terrain.elevation.shape[0] - 1, terrain.elevation.shape[1] - 1
    r, c = np.arange(row, row + height), np.arange(col, col + width)
    below, above = np.minimum(r + 1, limit_r), np.maximum(r - 1, 0)
    right, left = np.minimum(c + 1, limit_c), np.maximum(c - 1, 0)
    north = _ground(terrain, *np.meshgrid(above, c, indexing="ij")) - _ground(
        terrain, *np.meshgrid(below, c, indexing="ij")
    )
    east = _ground(terrain, *np.meshgrid(r, right, indexing="ij")) - _ground(
        terrain, *np.meshgrid(r, left, indexing="ij")
    )
    normal = np.cross(east, north)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


@numba.njit(cache=True, parallel=True)
def _march(z, row, col, slope, step_row, step_col, gsd, radius, highest, hidden):
    """Follow every ray from its pixel towards the camera until it is above all terrain.

    slope : rise over run of the ray, inf straight up, NaN to skip; heights between pixels are bilinear. The ray gains
    run^2 / 2R on the ground, which falls away beneath it.
    """
    rows, cols = z.shape
    for i in numba.prange(slope.shape[0]):
        for j in range(slope.shape[1]):
            s = slope[i, j]
            if not math.isfinite(s):
                continue
            start = z[row + i, col + j]
            k = 1
            while True:
                run = k * gsd
                height = start + run * s + run * run / (2 * radius)
                if height > highest and s > 0:
                    break
                r, c = row + i + k * step_row[i, j], col + j + k * step_col[i, j]
                if not (0 <= r <= rows - 1 and 0 <= c <= cols - 1):
                    break
                r0, c0 = min(int(r), max(rows - 2, 0)), min(int(c), max(cols - 2, 0))
                r1, c1 = min(r0 + 1, rows - 1), min(c0 + 1, cols - 1)
                f, g = r - r0, c - c0
                ground = (1 - f) * ((1 - g) * z[r0, c0] + g * z[r0, c1]) + f * ((1 - g) * z[r1, c0] + g * z[r1, c1])
                if ground > height:  # never true for unknown terrain (NaN)
                    hidden[i, j] = True
                    break
                k += 1


def _sun(camera: Camera, line: Floats, seen: NDArray[np.bool_], given: Floats | None) -> Floats | None:
    """(3,) body-fixed, m: as given, else the camera model's own in the middle of what is seen, else None."""
    if given is not None:
        return np.asarray(given, float)
    middle = float(np.median(line[seen])) if seen.any() else camera.lines / 2
    return camera.sun_position(middle)


# --- image ----------------------------------------------------------------------------------------------------------


def _corners(
    terrain: Terrain, camera: Camera, box: tuple[int, int, int, int], line: Floats, displacement: Displacement | None
) -> tuple[Floats, Floats]:
    """(line, sample), each (h, w, 2, 2): CSM coordinates of every pixel's corners, by row and by column.

    line : (h, w) of the pixels' centres. A pixel's corners are looked up in the framelet that shows its centre: the
    neighbouring framelet of the image may lie anywhere on the ground.
    """
    row, col, height, width = box
    r, c = np.meshgrid(np.arange(height + 1) + row - 0.5, np.arange(width + 1) + col - 0.5, indexing="ij")
    points = _ground(terrain, r, c, displacement)
    framelet = camera.framelet(line)
    if framelet is not None:
        corners = np.moveaxis(sliding_window_view(points, (2, 2), axis=(0, 1)), 2, -1)
        return camera.ground_to_framelet(corners, framelet[..., None, None])
    found = camera.ground_to_image(points)
    return sliding_window_view(found[0], (2, 2)), sliding_window_view(found[1], (2, 2))
