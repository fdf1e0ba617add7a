"""The files of a scene: DEM, images, image table, truth. Written like real products, each whole or absent."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from schemas import TRUTH, ArtefactWriter, atomic_path
from schemas.provenance import pack_record
from schemas.rasters import TIFF_TAG
from stages.common.arrays import Floats32
from stages.physics.formation.geometry import Angles
from stages.physics.maps.geotiff import MapTiff
from stages.physics.maps.grid import Grid
from stages.simulate.hidden import CHOICES, Hidden
from stages.simulate.orbits import Pass, direction, sub_point
from stages.simulate.radiance import Scene
from stages.simulate.recipe import Config
from stages.simulate.sensor import Detector

NODATA_FLOAT = -3.4028226550889045e38  # the NULL of 32-bit ISIS cubes, as LROC's products carry it
NODATA_INT16 = -32768
NODATA_DN = 0
IOF_STEP = 2e-5  # I/F of one count of a packed image

COLUMNS = (
    "image_id",
    "path",
    "units",
    "start_time",
    "subsolar_longitude_deg",
    "subsolar_latitude_deg",
    "solar_distance_au",
    "spacecraft_longitude_deg",
    "spacecraft_latitude_deg",
    "spacecraft_altitude_m",
)


def open_geotiff(path: Path, grid: Grid, dtype: str, nodata: float) -> rasterio.io.DatasetWriter:
    """A tiled, deflated GeoTIFF of one band, open for writing."""
    return rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=grid.width,
        height=grid.height,
        count=1,
        dtype=dtype,
        nodata=nodata,
        crs=grid.crs,
        transform=grid.transform,
        tiled=True,
        blockxsize=256,
        blockysize=256,
        bigtiff="IF_SAFER",
        compress="deflate",
        zlevel=1,
        predictor=3 if dtype == "float32" else 2,
    )


class ImageFile:
    """One ortho image, written in bands of rows: float32, int16 with a scale, or uint16 DN."""

    def __init__(self, path: Path, grid: Grid, units: str, packed: bool, shot: Pass) -> None:
        self.units, self.packed, self.grid = units, packed, grid
        nodata: float
        dtype, nodata = ("uint16", NODATA_DN) if units == "dn" else ("int16", NODATA_INT16)
        if units == "iof" and not packed:
            dtype, nodata = "float32", NODATA_FLOAT
        self.file = open_geotiff(path, grid, dtype, nodata)
        if dtype == "int16":
            self.file.scales, self.file.offsets = (IOF_STEP,), (0.0,)
        self.file.set_band_description(1, "DN" if units == "dn" else "radiance factor I/F")
        self.file.update_tags(IMAGE_ID=shot.image_id, START_TIME=shot.start_time)

    def write(self, first: int, image: Floats32, inside: NDArray[np.bool_], detector: Detector) -> None:
        """Write lines from ``first`` on; image : (h, W) I/F; inside : (h, W), where there is data."""
        window = Window(0, first, self.grid.width, len(image))
        if self.units == "dn":
            counts = np.clip(np.rint(detector.gain * image + detector.offset), 1, detector.top)
            data = np.where(inside, counts, NODATA_DN).astype(np.uint16)
        elif self.packed:
            counts = np.clip(np.rint(image / IOF_STEP), -32767, 32767)
            data = np.where(inside, counts, NODATA_INT16).astype(np.int16)
        else:
            data = np.where(inside, image, np.float32(NODATA_FLOAT)).astype(np.float32)
        self.file.write(data, 1, window=window)


def table_row(config: Config, shot: Pass, path: str, hidden: Hidden) -> dict[str, Any]:
    """An image's row of images.csv: the truth, but for a planted error of the Sun's direction.

    With such an error the row has no time, which would tell where the Sun was.
    """
    lon, lat = shot.sun.longitude_deg, shot.sun.latitude_deg
    azimuth, elevation = hidden.get("sun_azimuth"), hidden.get("sun_elevation")
    if azimuth or elevation:
        zenith, towards = direction(config.longitude_deg, config.latitude_deg, lon, lat)
        given_zenith = zenith + (elevation["error_deg"] if elevation else 0.0)
        given_azimuth = towards - (azimuth["error_deg"] if azimuth else 0.0)
        lon, lat = sub_point(config.longitude_deg, config.latitude_deg, given_zenith, given_azimuth)
    return {
        "image_id": shot.image_id,
        "path": path,
        "units": config.units,
        "start_time": "" if azimuth or elevation else shot.start_time,
        "subsolar_longitude_deg": f"{lon:.6f}",
        "subsolar_latitude_deg": f"{lat:.6f}",
        "solar_distance_au": f"{shot.sun.distance_au:.8f}",
        "spacecraft_longitude_deg": f"{shot.spacecraft_longitude_deg:.6f}",
        "spacecraft_latitude_deg": f"{shot.spacecraft_latitude_deg:.6f}",
        "spacecraft_altitude_m": f"{shot.spacecraft_altitude:.1f}",
    }


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write images.csv, whole or not at all."""
    with atomic_path(path) as partial, open(partial, "w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


@dataclasses.dataclass
class ImageTruth:
    """What truth.h5 records of one image."""

    shot: Pass
    detector: Detector
    mean_iof: float
    noise_iof: float


def write_truth(
    path: Path,
    config: Config,
    scene: Scene,
    working: Grid,
    craters: Any,
    images: Sequence[ImageTruth],
    hidden: Hidden,
) -> None:
    """truth.h5 and, beside it, truth.tif with the mapped coefficients and the standard I/F."""
    names = scene.truth.mapped
    inside = (np.abs(craters.x) < config.extent / 2) & (np.abs(craters.y) < config.extent / 2)
    kept = craters.select(inside)
    sizes = {
        "y": working.height,
        "x": working.width,
        "coefficient": len(names),
        "frame": len(images),
        "crater": len(kept),
    }
    described = [
        {
            "effect": effect,
            "parameters": {k: {"value": v, "unit": CHOICES[effect][k][3]} for k, v in parameters.items()},
        }
        for effect, parameters in hidden.items()
    ]
    attributes = {
        "gsd_m": working.gsd,
        "dem_gsd_m": scene.grid.gsd,
        "body_radius_m": working.radius,
        "model": scene.truth.model.name,
        "parameters": json.dumps({k: v for k, v in scene.truth.constants.items() if k not in names}),
        "hidden": json.dumps(described),
        "units": config.units,
    }
    raster = path.with_suffix(".tif")
    with (
        ArtefactWriter(
            path,
            TRUTH,
            sizes,
            config=dataclasses.asdict(config),
            seed=config.seed,
            attributes=attributes,
        ) as out,
        atomic_path(raster) as partial,
    ):
        out.write_crs(working.crs_wkt, working.transform)
        out.write("x", working.xy(0, np.arange(working.width))[0])
        out.write("y", working.xy(np.arange(working.height), 0)[1])
        out.write("coefficient_name", names)
        bands = [*names, "standard_iof"]
        tags = {"model": scene.truth.model.name, "quantity": "I/F", TIFF_TAG: pack_record(out.file.attrs)}
        with MapTiff(partial, working, bands, tags, ["1"] * len(bands)) as tif:
            for first in range(0, working.height, 256):
                _write_truth_rows(out, tif, config, scene, first, min(256, working.height - first))
        _write_images(out, images)
        out.write("crater_x", kept.x)
        out.write("crater_y", kept.y)
        out.write("crater_diameter", kept.diameter)
        out.write("crater_age", kept.age)


def _write_truth_rows(out: ArtefactWriter, tif: MapTiff, config: Config, scene: Scene, first: int, count: int) -> None:
    factor = config.factor
    rows = slice(first * factor, (first + count) * factor)
    geometry, free = np.asarray(scene.log_geometry[rows]), np.asarray(scene.log_free[rows])
    maps = {name: area_mean(values, factor) for name, values in scene.truth.maps(geometry, free).items()}
    here = slice(first, first + count)
    for k, values in enumerate(maps.values()):
        out.dataset("coefficients")[k, here] = values
    standard = standard_iof(scene, maps)
    out.dataset("standard_iof")[here] = standard
    tif.put(first, 0, np.stack([*maps.values(), standard]).astype(np.float32))
    out.dataset("elevation")[here] = area_mean(np.asarray(scene.elevation[rows]), factor)
    out.dataset("log_albedo_geometry")[here] = area_mean(geometry, factor)
    out.dataset("log_albedo_free")[here] = area_mean(free, factor)


def standard_iof(scene: Scene, maps: dict[str, Floats32]) -> Floats32:
    """I/F of level ground at incidence 30, emission 0, phase 30 deg.

    maps : (H, W) by name; returns (H, W)
    """
    import torch

    angles = [torch.deg2rad(torch.tensor(v)) for v in (30.0, 0.0, 30.0)]
    parameters = {k: torch.tensor(v, dtype=torch.float32) for k, v in scene.truth.constants.items()}
    parameters |= {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in maps.items()}
    return scene.truth.model.radiance_factor(parameters, Angles.from_angles(*angles)).numpy()


def _write_images(out: ArtefactWriter, images: Sequence[ImageTruth]) -> None:
    out.write("image_id", [i.shot.image_id for i in images])
    out.write("start_time", [i.shot.start_time for i in images])
    columns = {
        "subsolar_longitude_deg": [i.shot.sun.longitude_deg for i in images],
        "subsolar_latitude_deg": [i.shot.sun.latitude_deg for i in images],
        "solar_distance_au": [i.shot.sun.distance_au for i in images],
        "incidence_deg": [i.shot.incidence_deg for i in images],
        "emission_deg": [i.shot.emission_deg for i in images],
        "phase_deg": [i.shot.phase_deg for i in images],
        "sun_azimuth_deg": [i.shot.sun_azimuth_deg for i in images],
        "camera_azimuth_deg": [i.shot.camera_azimuth_deg for i in images],
        "image_gsd": [i.shot.gsd for i in images],
        "gain": [i.detector.gain for i in images],
        "offset": [i.detector.offset for i in images],
        "response": [i.detector.response for i in images],
        "shift_east": [i.detector.shift[0] for i in images],
        "shift_north": [i.detector.shift[1] for i in images],
        "noise_iof": [i.noise_iof for i in images],
        "mean_iof": [i.mean_iof for i in images],
    }
    for name, values in columns.items():
        out.write(name, np.array(values, float))


def area_mean(values: Floats32, factor: int) -> Floats32:
    """(H, W) -> (H / factor, W / factor) means over whole blocks."""
    height, width = values.shape
    blocks = values.reshape(height // factor, factor, width // factor, factor)
    return blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
