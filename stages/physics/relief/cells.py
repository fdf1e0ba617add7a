"""Random places on a body that depend on the place alone: cells of nearly equal area, each with draws of its own."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.physics.maps.grid import Grid

LATTICE = 9  # points a side that tell which cells a piece of a map touches


def draw_places(
    grid: Grid,
    rows: tuple[float, float],
    cols: tuple[float, float],
    edge: float,
    density: float,
    key: tuple[int, ...],
    draws: int,
) -> tuple[Floats, Floats, NDArray]:
    """Places in a piece of a map: x and y (n,), map coordinates, and (n, draws) numbers 0..1 of each.

    rows, cols : first and last, px; edge : of a cell, m; density : places per m2; key : of the draws, numbers of at least 0
    """
    row, col = np.meshgrid(np.linspace(*rows, LATTICE), np.linspace(*cols, LATTICE), indexing="ij")
    lon, lat = (np.radians(v) for v in grid.lonlat(row, col))
    middle = math.atan2(float(np.sin(lon).mean()), float(np.cos(lon).mean()))
    away = np.mod(lon - middle + math.pi, 2 * math.pi) - math.pi
    step = edge / grid.radius
    low, high, west, east = float(lat.min()), float(lat.max()), float(away.min()), float(away.max())
    low, high, west, east = (
        low - 0.02 * (high - low),
        high + 0.02 * (high - low),
        west - 0.02 * (east - west),
        east + 0.02 * (east - west),
    )
    for pole in (-90.0, 90.0):
        r, c = (float(v) for v in grid.rowcol_of_lonlat(0.0, pole))
        if rows[0] <= r <= rows[1] and cols[0] <= c <= cols[1]:
            low, high, west, east = min(low, math.radians(pole)), max(high, math.radians(pole)), -math.pi, math.pi
    found = []
    for band in range(
        int((max(low, -math.pi / 2) + math.pi / 2) / step), int((min(high, math.pi / 2) + math.pi / 2) / step) + 1
    ):
        bottom = -math.pi / 2 + band * step
        top = min(bottom + step, math.pi / 2)
        count = max(1, round(2 * math.pi * math.cos(0.5 * (bottom + top)) / step))
        width = 2 * math.pi / count
        first, last = math.floor((middle + west + math.pi) / width), math.floor((middle + east + math.pi) / width)
        area = grid.radius**2 * width * (math.sin(top) - math.sin(bottom))
        for cell in range(first, min(last, first + count - 1) + 1):
            rng = np.random.default_rng([*key, band, cell % count])
            numbers = rng.random((rng.poisson(density * area), 2 + draws))
            numbers[:, 0] = -math.pi + (cell + numbers[:, 0]) * width
            numbers[:, 1] = np.arcsin(math.sin(bottom) + numbers[:, 1] * (math.sin(top) - math.sin(bottom)))
            found.append(numbers)
    everything = np.concatenate(found)
    longitude = np.degrees(np.mod(everything[:, 0] + math.pi, 2 * math.pi) - math.pi)
    row, col = grid.rowcol_of_lonlat(longitude, np.degrees(everything[:, 1]))
    inside = (row >= rows[0]) & (row <= rows[1]) & (col >= cols[0]) & (col <= cols[1])
    x, y = grid.xy(row[inside], col[inside])
    return x, y, everything[inside, 2:]
