"""Position of the Sun for a rendered scene: from its azimuth and elevation, the sub-solar point or a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from schemas.errors import GeometryError
from stages.common.arrays import Floats
from stages.common.sun_given import sun_given
from stages.physics.bodies.ephemeris import AU, subsolar_point
from stages.physics.bodies.spheres import Body
from stages.physics.light.sun_disc import SUN_RADIUS
from stages.physics.maps.grid import Grid, unit_vectors


@dataclass(frozen=True)
class Sun:
    """A source of light. position : (3,), body-fixed, m; radius : angular, rad"""

    position: Floats
    radius: float

    def directions(self, points: Floats) -> Floats:
        """(..., 3) unit vectors towards the Sun from body-fixed points."""
        towards = self.position - points
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)

    def over(self, grid: Grid, row: float, col: float) -> tuple[float, float]:
        """(azimuth from grid north, elevation) over a place on a map, rad."""
        axes = grid.local_frames(row, col).axes[0]
        east, north, up = axes @ self.directions(axes[2] * grid.radius)
        return math.atan2(east, north) % (2 * math.pi), math.asin(max(-1.0, min(1.0, float(up))))


def sun_from_angles(azimuth_deg: float, elevation_deg: float, grid: Grid, distance_au: float = 1.0) -> Sun:
    """The Sun at an azimuth (clockwise from true north) and elevation over the middle of a map. Raises GeometryError."""
    if not 0.0 < elevation_deg <= 90.0:
        raise GeometryError(
            f"`sun_elevation_deg`: expected degrees above the horizon (0..90), found {elevation_deg:g}; the Sun is below the horizon."
            if elevation_deg <= 0
            else f"`sun_elevation_deg`: expected degrees in 0..90, found {elevation_deg:g}."
        )
    return Sun(place_over(grid, azimuth_deg, elevation_deg, distance_au * AU), SUN_RADIUS / distance_au)


def place_over(grid: Grid, azimuth_deg: float, elevation_deg: float, distance: float) -> Floats:
    """(3,) body-fixed, m, at an azimuth (from true north), elevation and distance, m, from the middle of a map."""
    frame = grid.local_frames((grid.height - 1) / 2, (grid.width - 1) / 2)
    # azimuth from true north -> from the grid's rows
    azimuth = math.radians(azimuth_deg + float(frame.convergence_deg[0]))
    elevation = math.radians(elevation_deg)
    local = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    axes = frame.axes[0]
    return axes[2] * grid.radius + local @ axes * distance


def sun_from_subsolar(longitude_deg: float, latitude_deg: float, distance_au: float = 1.0) -> Sun:
    """The Sun over its sub-solar point. Raises GeometryError."""
    if not -90.0 <= latitude_deg <= 90.0:
        raise GeometryError(f"`subsolar_latitude_deg`: expected degrees in -90..90, found {latitude_deg:g}.")
    return Sun(unit_vectors(longitude_deg, latitude_deg) * distance_au * AU, SUN_RADIUS / distance_au)


def find_sun(
    grid: Grid,
    body: Body,
    *,
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
    subsolar_longitude_deg: float | None = None,
    subsolar_latitude_deg: float | None = None,
    time: str | None = None,
    distance_au: float | None = None,
) -> Sun:
    """The Sun from exactly one of its three descriptions. Raises ConfigError or GeometryError."""
    given = sun_given(azimuth_deg, elevation_deg, subsolar_longitude_deg, subsolar_latitude_deg, time)
    if time is not None:
        point = subsolar_point(time, body)
        return sun_from_subsolar(point.longitude_deg, point.latitude_deg, point.distance_au)
    if given == "subsolar":
        return sun_from_subsolar(
            cast(float, subsolar_longitude_deg), cast(float, subsolar_latitude_deg), distance_au or 1.0
        )
    return sun_from_angles(cast(float, azimuth_deg), cast(float, elevation_deg), grid, distance_au or 1.0)


def check_sun_is_up(sun: Sun, grid: Grid, relief: float, name: str = "Sun") -> None:
    """Refuse a source of light that no point of the map can see. Raises GeometryError.

    relief : m between the lowest and highest point: a summit looks this far over the edge of the sphere
    """
    low, high = elevation_range(sun, grid)
    if high < -(sun.radius + math.sqrt(2.0 * max(relief, 0.0) / grid.radius)):
        raise GeometryError(
            f"the {name} is below the horizon everywhere on the map: its elevation is {math.degrees(low):.1f} to "
            f"{math.degrees(high):.1f} deg; choose another time or {name} direction."
        )


def elevation_range(sun: Sun, grid: Grid) -> tuple[float, float]:
    """Lowest and highest elevation of a source of light over a map, rad."""
    rows = np.linspace(0, grid.height - 1, 9)
    cols = np.linspace(0, grid.width - 1, 9)
    row, col = (v.ravel() for v in np.meshgrid(rows, cols))
    up = grid.local_frames(row, col).up
    elevation = np.arcsin(np.clip((up * sun.directions(up * grid.radius)).sum(1), -1.0, 1.0))
    return float(elevation.min()), float(elevation.max())
