"""What `lunargr render` is tested on: a hilly map with known coefficients, DEMs, and the command itself."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest
from relief import RADIUS, hills, metric_grid
from small_scene import write_raster

from lunargr_cli import main as cli
from schemas import SVBRDF, ArtefactWriter
from stages.physics.maps.grid import Grid
from stages.physics.photometry import get_model

LON, LAT = -42.0, 17.0
SUN = ("--sun-azimuth", "100", "--sun-elevation", "35")


def make_grid(height: int, width: int, gsd: float) -> Grid:
    return metric_grid(height, width, gsd, LON, LAT)


def write_svbrdf(path, grid: Grid, elevation: np.ndarray, coefficients: np.ndarray, model: str = "M2"):
    names = [p.name for p in get_model(model).parameters]
    attributes = {"gsd_m": grid.gsd, "body_radius_m": RADIUS, "model": model, "quantity": "I/F"}
    sizes = {"coefficient": len(names), "y": grid.height, "x": grid.width}
    with ArtefactWriter(path, SVBRDF, sizes, attributes=attributes) as writer:
        x, y = grid.xy(np.arange(grid.height)[:, None], np.arange(grid.width))
        writer.write("x", x[0])
        writer.write("y", y[:, 0])
        writer.write("coefficients", coefficients.astype(np.float32))
        writer.write("coefficient_name", names)
        writer.write("elevation", elevation.astype(np.float32))
        writer.write("valid", np.isfinite(coefficients).all(axis=0).astype(np.uint8))
        writer.write_crs(grid.crs_wkt, grid.transform)
    return path


def write_dem(path, grid: Grid, elevation: np.ndarray, crs=None, transform=None):
    """A DEM as a user's GeoTIFF on ``grid``, or as if it were on another."""
    heights = np.nan_to_num(elevation, nan=-9999.0).astype(np.float32)
    return write_raster(path, heights, crs or grid.crs, transform or grid.transform, nodata=-9999.0)


def smooth_maps(rng, shape, count=3):
    smooth = np.stack([hills(rng, max(shape), 1.0)[: shape[0], : shape[1]] for _ in range(count)])
    return 0.05 + 0.01 * smooth / np.abs(smooth).max()


def write_hilly_map(rng, path):
    """A hilly 160 x 200 map with varying M2 coefficients and a hole: path, grid, elevation, coefficients."""
    grid = make_grid(160, 200, 5.0)
    elevation = hills(rng, 200, 5.0)[:160]
    coefficients = smooth_maps(rng, (160, 200))
    coefficients[:, 20:40, 60:90] = np.nan
    return write_svbrdf(path, grid, elevation, coefficients), grid, elevation, coefficients


def lunargr_render(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    """Exit code and standard error of `lunargr render`, as the shell would see them."""
    return run_lunargr(monkeypatch, capsys, "render", *arguments)


def run_lunargr(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    """The same of any command."""
    monkeypatch.setattr(os, "_exit", sys.exit)  # the command line leaves Python at once after an error
    monkeypatch.setattr(sys, "argv", ["lunargr", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0), capsys.readouterr().err
