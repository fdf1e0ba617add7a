"""A small scene whose albedo is known, for the tests of albedo: plain numpy makes its photographs."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import small_scene
from rasterio.transform import Affine
from render_scene import write_svbrdf
from small_scene import GSD, LAT, LON, RADIUS, A, B, C, local_crs, slopes, sun_enu, write_raster

from stages import ingest
from stages.physics.maps.grid import Grid

SIZE = 256
SUNS = ((-25.0, 1.0), (-10.0, -1.0), (55.0, 1.0), (70.0, 0.5), (20.0, -30.0), (-20.0, 1.2))  # sub-solar points
NOISE = 4e-4  # I/F


@dataclass
class Planted:
    """A scene and a map of its terrain; albedo : (H, W), what the photographs show beyond the map; images : (H, W) each."""

    folder: Path
    scene: Path
    map: Path
    albedo: np.ndarray
    images: list[np.ndarray]


def texture(rng, contrast: float = 0.08) -> np.ndarray:
    """Log albedo with structure of all sizes, (SIZE, SIZE)."""
    layers = [cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), s) for s in (1.0, 3.0, 9.0, 27.0)]
    return contrast * sum(layer / layer.std() for layer in layers) / 2


def axes():
    half = SIZE * GSD / 2
    axis = (np.arange(SIZE) + 0.5) * GSD - half
    return axis[None, :], -axis[:, None]


def photograph(albedo: np.ndarray, sun) -> np.ndarray:
    """I/F of M2 times the albedo under a vertical camera far away."""
    x, y = axes()
    east, north = slopes(x, y)
    s = sun_enu(subsolar=sun)
    mu0 = (s[2] - east * s[0] - north * s[1]) / np.sqrt(1 + east**2 + north**2)
    return albedo * np.where(mu0 > 0, A * mu0 + B * s[2] + C, 0)


def photographs(rng, albedo: np.ndarray, count: int = len(SUNS)) -> list[np.ndarray]:
    return [photograph(albedo, sun) + NOISE * rng.normal(size=albedo.shape) for sun in SUNS[:count]]


def plant(folder: Path, albedo: np.ndarray, images: list[np.ndarray], units: str = "iof") -> Planted:
    """Write DEM and images, ingest them, and write a map that knows all but the albedo. NaN in images is nodata."""
    folder.mkdir(parents=True, exist_ok=True)
    x, y = axes()
    half = SIZE * GSD / 2
    transform = Affine(GSD, 0, -half, 0, -GSD, half)
    dem = small_scene.height(x, y).astype(np.float32)
    write_raster(folder / "dem.tif", dem, local_crs(), transform, nodata=-9999.0)
    rows = []
    for k, image in enumerate(images):
        values = np.where(np.isfinite(image), image, -1e4).astype(np.float32)
        write_raster(folder / f"image{k}.tif", values, local_crs(), transform, nodata=-1e4)
        lon, lat = SUNS[k]
        rows.append(
            {
                "image_id": f"IMG{k}", "path": f"image{k}.tif", "units": units, "start_time": "",
                "subsolar_longitude_deg": lon, "subsolar_latitude_deg": lat, "solar_distance_au": 1.0,
                "spacecraft_longitude_deg": LON, "spacecraft_latitude_deg": LAT, "spacecraft_altitude_m": 5e7,
            }
        )  # fmt: skip
    with open(folder / "images.csv", "w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    scene = folder / "scene.h5"
    ingest.run(folder / "dem.tif", folder / "images.csv", scene, ingest.Config(gsd=GSD, crop=32))
    import h5py

    from stages.physics.maps.grid import read_grid

    with h5py.File(scene) as file:
        grid: Grid = read_grid(file, scene)
        elevation = file["elevation"][...]
    coefficients = np.stack([np.full(elevation.shape, v) for v in (A, B, C)])
    coefficients[:, ~np.isfinite(elevation)] = np.nan
    svbrdf = write_svbrdf(folder / "svbrdf.h5", grid, elevation, coefficients)
    assert grid.radius == RADIUS
    return Planted(folder, scene, svbrdf, albedo, images)
