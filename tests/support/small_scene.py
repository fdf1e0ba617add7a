"""A small analytic scene written as a user's files: everything in it has a closed form that stages.physics had no part in."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.transform import Affine

RADIUS = 1737400.0
LON, LAT = 20.0, 10.0  # the scene's centre
GSD = 20.0
SIZE = 384
SUN = (-25.0, 1.0)  # sub-solar longitude and latitude: 45 deg west of the scene
A, B, C = 0.09, 0.03, 0.01  # the truth: I/F = a cos(i) + b cos(g) + c


def height(x, y):
    """Elevation in metres at metres east and north of the centre."""
    hill = 180 * np.exp(-((x - 900) ** 2 + (y + 700) ** 2) / (2 * 650**2))
    pit = -150 * np.exp(-((x + 1100) ** 2 + (y - 900) ** 2) / (2 * 500**2))
    return hill + pit + 8 * np.sin(x / 210) * np.cos(y / 260)


def slopes(x, y):
    """(dz/dx, dz/dy) of :func:`height`."""
    hill = 180 * np.exp(-((x - 900) ** 2 + (y + 700) ** 2) / (2 * 650**2))
    pit = -150 * np.exp(-((x + 1100) ** 2 + (y - 900) ** 2) / (2 * 500**2))
    dx = -hill * (x - 900) / 650**2 - pit * (x + 1100) / 500**2 + 8 / 210 * np.cos(x / 210) * np.cos(y / 260)
    dy = -hill * (y + 700) / 650**2 - pit * (y - 900) / 500**2 - 8 / 260 * np.sin(x / 210) * np.sin(y / 260)
    return dx, dy


def local_xy(lon, lat):
    """Oblique stereographic about the centre, on the sphere (Snyder 1987, eqs. 21-2 to 21-4)."""
    lam, phi, phi0 = np.radians(lon - LON), np.radians(lat), np.radians(LAT)
    k = 2 / (1 + np.sin(phi0) * np.sin(phi) + np.cos(phi0) * np.cos(phi) * np.cos(lam))
    x = RADIUS * k * np.cos(phi) * np.sin(lam)
    y = RADIUS * k * (np.cos(phi0) * np.sin(phi) - np.sin(phi0) * np.cos(phi) * np.cos(lam))
    return x, y


def sun_enu(lon=LON, lat=LAT, subsolar=SUN):
    """Direction to a Sun at infinity, by spherical trigonometry."""
    lam, phi, delta = np.radians(subsolar[0] - lon), np.radians(lat), np.radians(subsolar[1])
    east = np.cos(delta) * np.sin(lam)
    north = np.cos(phi) * np.sin(delta) - np.sin(phi) * np.cos(delta) * np.cos(lam)
    up = np.sin(phi) * np.sin(delta) + np.cos(phi) * np.cos(delta) * np.cos(lam)
    return np.stack([east, north, up], axis=-1)


def radiance_factor(x, y, a=A, b=B, c=C):
    """I/F of the truth under a vertical camera far away; the body's curvature is neglected over these few kilometres."""
    dx, dy = slopes(x, y)
    sun = sun_enu()
    mu0 = (sun[2] - dx * sun[0] - dy * sun[1]) / np.sqrt(1 + dx**2 + dy**2)
    return np.where(mu0 > 0, a * mu0 + b * sun[2] + c, 0)


@dataclass(frozen=True)
class Files:
    dem: Path
    images: Path
    folder: Path


def local_crs() -> CRS:
    return CRS.from_proj4(f"+proj=stere +lat_0={LAT} +lon_0={LON} +k=1 +x_0=0 +y_0=0 +R={RADIUS} +units=m +no_defs")


def write_raster(path: Path, array, crs, transform, nodata=None, **extra) -> Path:
    profile = {"driver": "GTiff", "height": array.shape[0], "width": array.shape[1], "count": 1, "dtype": array.dtype}
    with rasterio.open(path, "w", crs=crs, transform=transform, nodata=nodata, **profile, **extra) as out:
        out.write(array, 1)
    return path


def write_scene(folder: Path, images: int = 3, gain=None, nodata_hole: bool = True) -> Files:
    """DEM on a local metric grid; images in degrees at another resolution, ragged, as I/F or as dn = gain x I/F + offset."""
    half = SIZE * GSD / 2
    axis = (np.arange(SIZE) + 0.5) * GSD - half
    dem = height(axis[None, :], -axis[:, None]).astype(np.float32)
    if nodata_hole:
        dem[40:52, 300:330] = -9999
    folder.mkdir(parents=True, exist_ok=True)
    write_raster(folder / "dem.tif", dem, local_crs(), Affine(GSD, 0, -half, 0, -GSD, half), nodata=-9999.0)
    rows = []
    step = np.degrees(12.0 / RADIUS)  # finer than the DEM: project has to take area means
    extent = 1.05 * np.degrees(half / RADIUS)
    for k in range(images):
        n = int(2 * extent / step)
        lon = LON - extent / np.cos(np.radians(LAT)) + (np.arange(int(n / np.cos(np.radians(LAT)))) + 0.5) * step
        lat = LAT + extent - (np.arange(n) + 0.5) * step
        x, y = local_xy(lon[None, :], lat[:, None])
        image = radiance_factor(x, y).astype(np.float32)
        units = "iof"
        if gain is not None:
            image = (gain[k][0] * image + gain[k][1]).astype(np.float32)
            units = "dn"
        # A strip from north to south, tilted, each image farther east: they overlap by about half.
        middle = (k - (images - 1) / 2) * half * 0.5 + 0.12 * y
        image[np.abs(x - middle) > half * (0.75 if images > 1 else 5)] = -1e4
        transform = Affine(step, 0, lon[0] - step / 2, 0, -step, lat[0] + step / 2)
        write_raster(
            folder / f"image{k}.tif",
            image,
            CRS.from_proj4(f"+proj=longlat +R={RADIUS} +no_defs"),
            transform,
            nodata=-1e4,
        )
        rows.append(
            {
                "image_id": f"IMG{k}", "path": f"image{k}.tif", "units": units, "start_time": "",
                "subsolar_longitude_deg": SUN[0], "subsolar_latitude_deg": SUN[1], "solar_distance_au": 1.0,
                "spacecraft_longitude_deg": LON, "spacecraft_latitude_deg": LAT, "spacecraft_altitude_m": 5e7,
            }
        )  # fmt: skip
    with open(folder / "images.csv", "w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return Files(folder / "dem.tif", folder / "images.csv", folder)
