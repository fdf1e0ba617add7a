"""What a camera can see of a map: the window, how finely, and from how far."""

from __future__ import annotations

import math

import numpy as np

from schemas.errors import GeometryError
from stages.common.arrays import Floats
from stages.physics.cameras.base import Camera
from stages.physics.maps.window import Window
from stages.physics.terrain.surface import Surface
from stages.render.grounds import LARGEST_REFINED, Ground
from stages.render.motion import over_exposure
from stages.render.raycast import HIT, cast
from stages.render.viewpoint import pixel_footprint

MOST_SAMPLES = 8  # rays per pixel and axis; beyond, the terrain itself is averaged first
LATTICE = 33  # rays per axis of the first look
LEVELS = (64, 32, 16, 8, 4, 2)  # pixels of refined ground along one of a surface


def seen_window(
    surface: Surface, camera: Camera, relief: tuple[float, float], samples: int | None
) -> tuple[Window, int, int, float]:
    """Which window of the map a camera can see, rays per pixel and axis, coarsening factor, distance to the ground (m).

    samples : rays per pixel and axis, None for as many as the pixel's footprint asks for; relief : lowest and highest elevation, m. Raises GeometryError where the view misses the map or starts under it.
    """
    grid = surface.grid
    line = np.linspace(0, camera.lines, LATTICE)
    sample = np.linspace(0, camera.samples, LATTICE)
    lines, columns = (v.ravel() for v in np.meshgrid(line, sample, indexing="ij"))
    looks = [pose.rays(lines, columns) for pose in over_exposure(camera)]
    origins, directions = (np.concatenate(parts) for parts in zip(*looks, strict=True))
    _check_above_ground(surface, origins, relief)
    near, far = shell_crossing(origins, directions, grid.radius + relief[0] - 1.0, grid.radius + relief[1] + 1.0)
    steps = np.linspace(0.0, 1.0, 9)
    distances = near[:, None] + (far - near)[:, None] * steps
    points = origins[:, None] + distances[..., None] * directions[:, None]
    known = np.isfinite(distances)
    if not known.any():
        raise GeometryError(
            "the camera does not see the body; check its place, `look_at` (or `quaternion`) and `fov_deg`."
        )
    points, distances = points[known], distances[known]
    lon = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    lat = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    row, col = grid.rowcol_of_lonlat(lon, lat)
    inside = np.isfinite(row) & np.isfinite(col)
    if not inside.any():
        raise GeometryError(_misses(surface))
    row, col, distances = row[inside], col[inside], distances[inside]
    # beyond the map by more than its own size is no place that a neighbouring ray leads back from
    row, col = np.clip(row, -grid.height, 2 * grid.height), np.clip(col, -grid.width, 2 * grid.width)
    pad_row, pad_col = (4 + np.ptp(places) * 1.5 / (LATTICE - 1) for places in (row, col))
    top, bottom = max(0, int(row.min() - pad_row)), min(grid.height, int(row.max() + pad_row) + 2)
    left, right = max(0, int(col.min() - pad_col)), min(grid.width, int(col.max() + pad_col) + 2)
    if bottom - top < 2 or right - left < 2:
        raise GeometryError(_misses(surface))
    on_map = (row > -0.5) & (row < grid.height) & (col > -0.5) & (col < grid.width)
    distance = float(np.median(distances[on_map] if on_map.any() else distances))
    footprint = pixel_footprint(camera, distance) / grid.gsd
    wanted = samples or min(MOST_SAMPLES, max(2, math.ceil(footprint)))
    factor = max(1, int(footprint / wanted))
    return Window(top, left, bottom - top, right - left), wanted, factor, distance


def shell_crossing(origins: Floats, directions: Floats, inner: float, outer: float) -> tuple[Floats, Floats]:
    """Distances along rays at which they enter and leave the shell between two spheres; NaN where they miss it.

    origins, directions : (n, 3), m and unit; inner, outer : radii, m; returns (n,) each, m
    """
    along = (origins * directions).sum(-1)
    closest2 = (origins * origins).sum(-1) - along**2
    with np.errstate(invalid="ignore"):
        half_outer = np.sqrt(outer**2 - closest2)
        half_inner = np.sqrt(inner**2 - closest2)
    near = np.maximum(-along - half_outer, 0.0)
    far = -along + half_outer
    enters = -along - half_inner
    far = np.where(enters > 0, enters, far)
    missed = ~(far > near)
    return np.where(missed, np.nan, near), np.where(missed, np.nan, far)


def no_ground(surface: Surface) -> str:
    """The error line of a view whose rays all miss valid ground."""
    return (
        f"the view misses {surface.path.name}: no pixel sees valid ground; "
        "check the camera's place, `look_at` (or `quaternion`) and `fov_deg`."
    )


def ground_height(surface: Surface, longitude_deg: float, latitude_deg: float, unknown: float) -> float:
    """Bilinear height of the ground, m; ``unknown`` off the map and where one of the four pixels around is."""
    grid = surface.grid
    row, col = (float(v) for v in grid.rowcol_of_lonlat(longitude_deg, latitude_deg))
    if not (0 <= row <= grid.height - 1 and 0 <= col <= grid.width - 1):
        return unknown
    r, c = min(int(row), grid.height - 2), min(int(col), grid.width - 2)
    u, v = col - c, row - r
    height = float(np.array([1 - v, v]) @ surface.elevation[r : r + 2, c : c + 2] @ np.array([1 - u, u]))
    return height if math.isfinite(height) else unknown


def _misses(surface: Surface) -> str:
    grid = surface.grid
    lon, lat = grid.lonlat((grid.height - 1) / 2, (grid.width - 1) / 2)
    return (
        f"the view misses {surface.path.name}, whose middle is at longitude {float(lon):.4f}, latitude {float(lat):.4f} deg; "
        "check the camera's place, `look_at` (or `quaternion`) and `fov_deg`."
    )


def _check_above_ground(surface: Surface, origins: Floats, relief: tuple[float, float]) -> None:
    """Refuse a camera inside the ground. Raises GeometryError."""
    grid = surface.grid
    for origin in (origins[0], origins[-1]):
        altitude = float(np.linalg.norm(origin)) - grid.radius
        if altitude > relief[1]:
            continue
        lon = math.degrees(math.atan2(origin[1], origin[0]))
        lat = math.degrees(math.asin(origin[2] / np.linalg.norm(origin)))
        ground = ground_height(surface, lon, lat, relief[0])
        if altitude <= ground:
            raise GeometryError(
                f"the camera is under the ground: it stands {altitude:.1f} m above the sphere, the ground there at {ground:.1f} m; raise the altitude in `position`."
            )


def finer_windows(camera: Camera, ground: Ground, surface: Surface) -> list[tuple[Window, int]]:
    """Windows of the surface that the camera sees with several image pixels to one of them, and how many are wanted; coarsest first.

    Where not all can be refined, what is near the camera is.
    """
    line, sample = (
        v.ravel() for v in np.meshgrid(*(np.linspace(0, n, LATTICE) for n in (camera.lines, camera.samples)))
    )
    hits = cast(ground.field, *camera.rays(line, sample))
    seen = hits.status == HIT
    depth, (row, col) = hits.depth[seen], (v[seen] for v in ground.on_surface(hits))
    wanted = surface.grid.gsd / (pixel_footprint(camera, 1.0) * depth)
    left, found = np.ones(len(depth), bool), []
    for finer in LEVELS:
        here = left & (wanted > finer / 2)
        for share in (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1) if here.any() else ():
            near = here & (depth <= np.quantile(depth[here], share))
            window = _around(row[near], col[near], ground.window)
            if window.height * window.width * finer**2 <= LARGEST_REFINED:
                found.append((window, finer))
                inner = (row >= window.row) & (row <= window.row + window.height - 1)
                left &= ~(inner & (col >= window.col) & (col <= window.col + window.width - 1))
                break
    return found[::-1]


def _around(row: Floats, col: Floats, within: Window) -> Window:
    """The window of a lattice's places and some room for what lies between them, inside another one."""
    pad_row, pad_col = (2 + np.ptp(places) * 1.5 / (LATTICE - 1) for places in (row, col))
    top, left = max(within.row, int(row.min() - pad_row)), max(within.col, int(col.min() - pad_col))
    bottom = min(within.row + within.height, int(row.max() + pad_row) + 2)
    right = min(within.col + within.width, int(col.max() + pad_col) + 2)
    return Window(top, left, bottom - top, right - left)
