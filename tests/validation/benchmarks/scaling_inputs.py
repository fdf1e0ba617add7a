"""Inputs of any size for bench_scaling.py, written in blocks: a rough DEM, long images of it, maps, pairs."""

from __future__ import annotations

import csv
import math
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.windows import Window

from schemas import SCENE, SVBRDF, ArtefactWriter, open_artefact

RADIUS = 1737400.0
LON, LAT = -11.2, -43.3  # Tycho
PERIOD = 2048  # px after which the terrain repeats
SUN_AZIMUTH, SUN_ELEVATION = math.radians(100), math.radians(35)
LUNARGR = [sys.executable, "-m", "lunargr_cli.main"]


def crs() -> CRS:
    return CRS.from_proj4(f"+proj=stere +lat_0={LAT} +lon_0={LON} +k=1 +x_0=0 +y_0=0 +R={RADIUS} +units=m +no_defs")


def relief(gsd: float, slope_deg: float = 8.0) -> np.ndarray:
    """(PERIOD, PERIOD) float32 m: self-affine terrain that joins itself at its edges, of a given rms slope."""
    rng = np.random.default_rng(0)
    k = np.hypot(np.fft.fftfreq(PERIOD)[:, None], np.fft.rfftfreq(PERIOD)[None, :])
    k[0, 0] = 1.0
    noise = np.fft.rfft2(rng.standard_normal((PERIOD, PERIOD)))
    z = np.fft.irfft2(noise * np.minimum(k**-1.9, (4 / PERIOD) ** -1.9), (PERIOD, PERIOD))
    z *= math.tan(math.radians(slope_deg)) * gsd / np.std(np.diff(z, axis=1))
    return (z - z.mean()).astype(np.float32)


def brightness(z: np.ndarray, gsd: float) -> np.ndarray:
    """I/F of that terrain, a Lambert surface of albedo 0.1."""
    dy, dx = (np.roll(z, -1, axis) - np.roll(z, 1, axis) for axis in (0, 1))
    dx, dy = dx / (2 * gsd), -dy / (2 * gsd)
    east, north = (math.cos(SUN_ELEVATION) * f(SUN_AZIMUTH) for f in (math.sin, math.cos))
    cosine = (math.sin(SUN_ELEVATION) - dx * east - dy * north) / np.sqrt(1 + dx**2 + dy**2)
    return (0.1 * np.maximum(cosine, 0)).astype(np.float32)


def write_raster(path: Path, tile: np.ndarray, height: int, width: int, gsd: float, tiled: bool) -> Path:
    """``tile`` repeated over a GeoTIFF about the scene's centre, block by block; strips of one row where not tiled."""
    transform = Affine(gsd, 0, -gsd * width / 2, 0, -gsd, gsd * height / 2)
    how = {"tiled": True, "blockxsize": 512, "blockysize": 512} if tiled else {"blockysize": 1}
    profile = {
        "driver": "GTiff",
        "height": height,
        "width": width,
        "count": 1,
        "dtype": "float32",
        "BIGTIFF": "IF_SAFER",
    }
    with rasterio.open(path, "w", crs=crs(), transform=transform, **profile, **how) as out:
        for row in range(0, height, PERIOD):
            for col in range(0, width, PERIOD):
                h, w = min(PERIOD, height - row), min(PERIOD, width - col)
                out.write(tile[:h, :w], 1, window=Window(col, row, w, h))
    return path


STRIP_PX, TILT, LOOKS = 640, 0.2, 6  # width of a strip, columns a row, images over each pixel


def write_strips(folder: Path, edge: int, gsd: float) -> list[Path]:
    """Tilted strips across a square map, nodata on both sides of each, so many that LOOKS show every pixel."""
    tile = brightness(relief(gsd), gsd)
    width = STRIP_PX + math.ceil(TILT * edge)
    paths = []
    for k, left in enumerate(range(-width, edge, STRIP_PX // LOOKS)):
        first, last = max(0, left), min(edge, left + width)
        if last <= first:
            continue
        rows, cols = np.arange(edge)[:, None], np.arange(first, last)[None, :]
        image = tile[rows % PERIOD, cols % PERIOD]
        image[np.abs(cols - left - TILT * rows - STRIP_PX / 2) > STRIP_PX / 2] = np.nan
        path = folder / f"strip-{edge}-{k}.tif"
        transform = Affine(gsd, 0, gsd * (first - edge / 2), 0, -gsd, gsd * edge / 2)
        size = {"height": edge, "width": last - first, "count": 1, "dtype": "float32", "nodata": math.nan}
        with rasterio.open(path, "w", driver="GTiff", crs=crs(), transform=transform, **size) as out:
            out.write(image, 1)
        paths.append(path)
    return paths


def write_table(path: Path, images: list[Path]) -> Path:
    """An image table for one Sun, and a camera straight above."""
    azimuth, distance = SUN_AZIMUTH, math.pi / 2 - SUN_ELEVATION
    lat0 = math.radians(LAT)
    lat = math.asin(math.sin(lat0) * math.cos(distance) + math.cos(lat0) * math.sin(distance) * math.cos(azimuth))
    lon = math.atan2(
        math.sin(azimuth) * math.sin(distance) * math.cos(lat0), math.cos(distance) - math.sin(lat0) * math.sin(lat)
    )
    rows = [
        {
            "image_id": f"IMG{k}", "path": image.name, "units": "iof", "start_time": "",
            "subsolar_longitude_deg": LON + math.degrees(lon), "subsolar_latitude_deg": math.degrees(lat),
            "solar_distance_au": 1.0, "spacecraft_longitude_deg": LON, "spacecraft_latitude_deg": LAT,
            "spacecraft_altitude_m": 1e5,
        }
        for k, image in enumerate(images)
    ]  # fmt: skip
    with open(path, "w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return path


def lunargr(*arguments: object) -> None:
    """A command that only prepares; its output is shown where it fails."""
    done = subprocess.run([*LUNARGR, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"lunargr {' '.join(map(str, arguments))}: {done.stderr}")


def write_map(scene: Path, output: Path) -> Path:
    """Coefficients of M2 for a scene, as `infer` would leave them."""
    with open_artefact(scene, SCENE) as file:
        height, width = file["elevation"].shape
        names = {"gsd_m": file.attrs["gsd_m"], "body_radius_m": file.attrs["body_radius_m"], "model": "M2"}
        sizes = {"coefficient": 3, "y": height, "x": width}
        with ArtefactWriter(output, SVBRDF, sizes, attributes=names | {"quantity": "I/F"}) as writer:
            file.copy("crs", writer.file, "crs")
            writer.write("x", file["x"][...])
            writer.write("y", file["y"][...])
            from stages.physics.photometry import get_model

            writer.write("coefficient_name", [p.name for p in get_model("M2").parameters])
            coefficients, valid, elevation = (writer.dataset(n) for n in ("coefficients", "valid", "elevation"))
            for row in range(0, height, 256):
                part = slice(row, min(height, row + 256))
                elevation[part] = file["elevation"][part]
                valid[part] = 1
                band = np.empty((3, part.stop - row, width), np.float32)
                band[:] = np.array([0.09, 0.03, 0.01])[:, None, None]
                coefficients[:, part] = band
    return output


def repeat_pairs(pairs: Path, count: int, output: Path, places: bool = False) -> Path:
    """The same pairs again and again, as they are stored; each repetition another place where ``places``."""
    with h5py.File(pairs) as file:
        own = file["site"].shape[0]
        sites = int(file["site"][...].max()) + 1
    times = math.ceil(count / own)
    lunargr("merge", *[pairs] * times, "-o", output, "--overwrite")
    if places:
        with h5py.File(output, "r+") as file:
            file["site"][...] = file["site"][...] + np.repeat(np.arange(times), own) * sites
    return output
