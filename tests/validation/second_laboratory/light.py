"""Sunlight, shadows and light that the terrain scatters."""

from typing import NamedTuple

import numpy as np

SUN_RADIUS_DEG = 0.2666


class Window(NamedTuple):
    """A rectangle of a grid: first row and column, and size in cells."""

    top: int
    left: int
    rows: int
    cols: int


def shifted(field: np.ndarray, window: Window, row_step: float, col_step: float) -> np.ndarray:
    """The field seen a fixed step away from each cell of the window, linear; beyond the edge the edge goes on."""
    row, col = int(np.floor(row_step)), int(np.floor(col_step))
    u, v = np.float32(row_step - row), np.float32(col_step - col)
    top, left = window.top + row, window.left + col
    if top >= 0 and left >= 0 and top + window.rows < field.shape[0] and left + window.cols < field.shape[1]:
        block = field[top : top + window.rows + 1, left : left + window.cols + 1]
    else:
        rows = np.clip(np.arange(top, top + window.rows + 1), 0, field.shape[0] - 1)
        cols = np.clip(np.arange(left, left + window.cols + 1), 0, field.shape[1] - 1)
        block = field[np.ix_(rows, cols)]
    block = block[:-1] + u * (block[1:] - block[:-1])
    return block[:, :-1] + v * (block[:, 1:] - block[:, :-1])


def horizon_tangent(
    height: np.ndarray, window: Window, cell_px: float, azimuth_deg: float, lowest_tangent: float = 0.0
) -> np.ndarray:
    """Tangent of the horizon's elevation towards an azimuth; heights and cell_px in map pixels.

    The march ends where nothing can rise above lowest_tangent any more (0: at the end of the grid).
    """
    base = shifted(height, window, 0.0, 0.0)
    relief = float(height.max() - base.min())
    reach = float(np.hypot(*height.shape))
    if lowest_tangent > 0:
        reach = min(reach, relief / lowest_tangent / cell_px)
    north, east = np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    horizon = np.full(base.shape, -1.0, np.float32)
    distance = 1.0
    while distance <= max(reach, 2.0):
        far = shifted(height, window, -north * distance, east * distance)
        np.maximum(horizon, (far - base) * np.float32(1 / (distance * cell_px)), out=horizon)
        distance += max(1.0, 0.02 * distance)
    return horizon


def visible_disc(sun_elevation_deg: float, tangent: np.ndarray, radius_deg: float) -> np.ndarray:
    """Share of the Sun's disc (uniform, angular radius in deg) above a straight horizon."""
    x = np.clip((sun_elevation_deg - np.degrees(np.arctan(tangent))) / radius_deg, -1, 1)
    return ((np.arccos(-x) + x * np.sqrt(1 - x * x)) / np.pi).astype(np.float32)


def normals(height: np.ndarray, cell_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit normals (east, north, up) of a height field whose cells are cell_px wide."""
    by_row, by_col = np.gradient(height, cell_px)
    up = 1 / np.sqrt(1 + by_row**2 + by_col**2)
    return -by_col * up, by_row * up, up


def direction(azimuth_deg: float, elevation_deg: float) -> tuple[float, float, float]:
    """Unit vector (east, north, up) of a direction in degrees."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    flat = np.cos(elevation)
    return float(np.sin(azimuth) * flat), float(np.cos(azimuth) * flat), float(np.sin(elevation))


def scattered_light(height: np.ndarray, cell_px: float, radiance: np.ndarray, azimuths: int = 12) -> np.ndarray:
    """Irradiance over pi, in units of the radiance given, that each facet gets from the terrain in its view.

    Along each azimuth a facet sees what rises above all that is nearer; each rise is a band of its sky.
    """
    window = Window(0, 0, *height.shape)
    normal = normals(height, cell_px)
    total = np.zeros(height.shape, np.float32)
    for azimuth_deg in np.arange(azimuths) * 360.0 / azimuths:
        east, north, _ = direction(azimuth_deg, 0.0)
        along = normal[0] * east + normal[1] * north
        # Facets tilted away from this side see the sky below level, too; the march starts at their own plane.
        seen = np.arctan2(-along, normal[2])
        distance = 1.0
        while distance < max(height.shape) / 2:
            far = shifted(height, window, -north * distance, east * distance)
            rise = np.arctan((far - height) / (distance * cell_px))
            band = np.maximum(rise - seen, 0)
            middle = seen + band / 2
            cosine = np.maximum(along * np.cos(middle) + normal[2] * np.sin(middle), 0)
            source = shifted(radiance, window, -north * distance, east * distance)
            total += (source * cosine * np.cos(middle) * band).astype(np.float32)
            seen = np.maximum(seen, rise)
            distance += max(1.0, 0.35 * distance)
    return total * np.float32(2 * np.pi / azimuths / np.pi)
