"""How far away the terrain stands that makes the horizon: the farther, the less an error of its height turns the horizon."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

STEP = 0.5  # px along the ray
NEXT = 1.0  # px: what is nearer belongs to the pixel's own slope
SAME = 1e-3  # rad: terrain this little below the horizon makes it, as well as two programs agree about one DEM
OUTSIDE = 3e-2  # rad: where nothing in the grid comes nearer than this, terrain beyond its border makes it


def occluder_distance(
    elevation: NDArray[np.float32],
    gsd: float,
    azimuth: float,
    horizon: NDArray[np.float32],
    wanted: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Distance of the terrain that stands highest in one azimuth; where it lies outside the grid, the distance to the border.

    elevation : (H, W), m, rows run south; gsd : m; azimuth : rad, clockwise from north
    horizon : (H, W), rad, as :func:`stages.physics.horizon.horizon` gives it for all terrain
    wanted : (H, W), where it is asked for; 0 elsewhere
    returns (H, W) float32, px
    """
    grid, angle = np.ascontiguousarray(elevation, np.float64), np.ascontiguousarray(horizon, np.float64)
    return _march(grid, gsd, math.sin(azimuth), -math.cos(azimuth), angle, np.ascontiguousarray(wanted))


@numba.njit(cache=True, nogil=True)
def _march(dem, gsd, right, down, horizon, wanted):
    rows, columns = dem.shape
    out = np.zeros((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            if not wanted[r, c]:
                continue
            enough = math.tan(horizon[r, c] - SAME)
            highest, at, distance = -np.inf, 0.0, NEXT
            while highest < enough:
                y, x = r + down * distance, c + right * distance
                if y < 0 or x < 0 or y > rows - 1 or x > columns - 1:
                    break
                i, j = min(int(y), rows - 2), min(int(x), columns - 2)
                v, u = y - i, x - j
                height = (1 - v) * (dem[i, j] * (1 - u) + dem[i, j + 1] * u)
                height += v * (dem[i + 1, j] * (1 - u) + dem[i + 1, j + 1] * u)
                slope = (height - dem[r, c]) / (distance * gsd)
                if slope > highest:
                    highest, at = slope, distance
                distance += STEP
            inside = at > 0 and math.atan(highest) > horizon[r, c] - OUTSIDE
            out[r, c] = at if inside else distance
    return out


__all__ = ["occluder_distance"]
