"""What a raster, an image or a camera of other programs is: facts for `lunargr inspect`, before anything is made of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rasterio.enums import Resampling
from rasterio.io import DatasetReader

from schemas.errors import GeometryError, InputError
from stages.common.arrays import Floats
from stages.physics.bodies.ephemeris import et_to_utc, place_of, subsolar_point
from stages.physics.bodies.spheres import RADII, Body
from stages.physics.cameras import Camera, is_cube, open_camera
from stages.physics.images.labels import find_block, label_time, product_time, read_label
from stages.physics.maps import rasters
from stages.physics.maps.grid import BODY_TOLERANCE, Grid, crs_radius, lonlat_of_points, require_crs, unit_vectors
from stages.physics.maps.projections import near_longitude

CROP = 128  # px, the default of ingest
OUTLINE = 33  # points along each edge
LOOK = 512  # px a side of the reduced image that values are taken from
BRIGHTEST = 2.0  # I/F that calibrated images stay below


@dataclass(frozen=True)
class Footprint:
    """Ground that an image or a map shows. longitude_deg, latitude_deg : west to east (any turn) and south to north;
    size : m along rows and columns, at the middle; pixel : m, of one pixel along rows and columns there
    middle : (3,) body-fixed unit vector
    """

    longitude_deg: tuple[float, float]
    latitude_deg: tuple[float, float]
    size: tuple[float, float]
    pixel: tuple[float, float]
    middle: Floats

    def facts(self) -> dict[str, str]:
        """As text."""
        (west, east), (south, north) = self.longitude_deg, self.latitude_deg
        return {
            "longitude": f"{west:.4f} to {east:.4f} deg east",
            "latitude": f"{south:.4f} to {north:.4f} deg",
            "size on the ground": f"{self.size[1]:.4g} x {self.size[0]:.4g} m (height x width)",
            "ground sampling": f"{self.pixel[1]:.4g} x {self.pixel[0]:.4g} m a pixel",
        }

    def dem(self) -> dict[str, str]:
        """How fine a DEM an image with this footprint needs."""
        coarsest, full = min(self.size) / CROP, max(self.pixel)
        return {
            "DEM": f"{full:.3g} m a pixel shows all that the image does; {coarsest:.3g} m is the coarsest grid on which a "
            f"crop of {CROP} px fits"
        }


def describe(path: Path) -> tuple[str, dict[str, str]]:
    """A title, and facts by name, of a raster that GDAL reads, an ISIS cube or a camera model. Raises LunargrError."""
    if path.suffix.lower() == ".json":
        return "a camera model", _camera_facts(open_camera(path))
    with rasters.open_raster(path, "a raster, an image or a camera") as dataset:
        facts = _values(dataset)
        if dataset.crs is not None:
            return "a map (a DEM, or a map-projected image)", facts | _map_facts(path, dataset)
    if is_cube(path) and find_block(read_label(path) or {}, "NaifKeywords") is not None:
        return "an image as its camera took it, with its camera", facts | _camera_facts(open_camera(path))
    time = _time(path)
    return "an image without map projection", facts | ({"time": time} if time else {}) | {
        "camera": "none in the file; name one in the column 'camera' of images.csv"
    }


def _values(dataset: DatasetReader) -> dict[str, str]:
    """Size, type and range of a raster's values, from a reduced reading."""
    shape = min(LOOK, dataset.height), min(LOOK, dataset.width)
    steps = [np.unique(np.linspace(0, n - 1, m).astype(int)) for n, m in zip(dataset.shape, shape, strict=True)]
    window = rasters.Window(0, 0, dataset.width, dataset.height)
    if dataset.width * dataset.height > rasters.LARGEST_WINDOW:
        raw = dataset.read(1, out_shape=shape, resampling=Resampling.nearest, masked=True)
        values = np.ma.filled(raw.astype(float), np.nan) * dataset.scales[0] + dataset.offsets[0]
        values[~(np.abs(values) < rasters.SPECIAL)] = np.nan
    else:
        values = rasters.read_window(dataset, window)[np.ix_(*steps)]
    facts = {
        "format": dataset.driver,
        "size": f"{dataset.height} lines x {dataset.width} samples, {dataset.count} band{'s' if dataset.count > 1 else ''}",
        "type": dataset.dtypes[0],
    }
    known = values[np.isfinite(values)]
    if not known.size:
        return facts | {"values": "only nodata"}
    low, high = np.percentile(known, [1, 99])
    negative = float((known < 0).mean())
    unit = f" {dataset.units[0]}" if dataset.units[0] else ""
    facts["values"] = f"{low:.6g} to {high:.6g}{unit} (1 to 99 %), {known.size / values.size:.1%} known"
    if high <= BRIGHTEST and low > -1 and negative:
        facts["values"] += f", {negative:.1%} below 0"
    return facts


def _map_facts(path: Path, dataset: DatasetReader) -> dict[str, str]:
    radius = crs_radius(dataset.crs) or RADII["moon"]
    body = _body(radius)
    require_crs(str(path), dataset.crs, dataset.transform, Body(body.name, radius))
    found = _map_footprint(str(path), rasters.grid_of(dataset, radius))
    facts = {"CRS": dataset.crs.to_wkt().split('"')[1], "body": f"sphere of {radius:.10g} m ({body.name})"}
    facts |= found.facts()
    time = _time(path)
    if time:
        facts |= {"time": time} | _sun_facts(found, _sun_of(time, body))
    return facts | found.dem()


def _map_footprint(where: str, grid: Grid) -> Footprint:
    down, right = np.linspace(-0.5, grid.height - 0.5, OUTLINE), np.linspace(-0.5, grid.width - 0.5, OUTLINE)
    rows, cols = (v.ravel() for v in np.meshgrid(down, right, indexing="ij"))
    lon, lat = grid.counted_longitude(*grid.xy(rows, cols)), grid.lonlat(rows, cols)[1]
    good = np.isfinite(lon) & np.isfinite(lat)
    lon, lat = lon[good], lat[good]
    if not lon.size:
        raise GeometryError(f"{where}: its georeference puts it off the body; check its CRS and transform.")
    if not grid.continued:
        lon = near_longitude(lon, grid.middle_longitude_deg)
    poles = [v for v in (-90.0, 90.0) if _within(grid, *grid.rowcol_of_lonlat(0.0, v))]
    if poles and not grid.continued:
        lon = np.array([-180.0, 180.0])
    middle = (grid.height - 1) / 2, (grid.width - 1) / 2
    north, east = (float(v) for v in grid.local_frames(*middle).pixel_size[0])
    return Footprint(
        (float(lon.min()), float(lon.max())),
        (min([float(lat.min()), *poles]), max([float(lat.max()), *poles])),
        (grid.width * east, grid.height * north),
        (east, north),
        unit_vectors(*grid.lonlat(*middle)),
    )


def _within(grid: Grid, row: Floats, col: Floats) -> bool:
    return bool(-0.5 <= row <= grid.height - 0.5 and -0.5 <= col <= grid.width - 0.5)


def _camera_facts(camera: Camera) -> dict[str, str]:
    radius = camera.semi_axes[0]
    body = _body(radius)
    facts = {
        "camera": camera.kind,
        "camera's size": f"{camera.lines} lines x {camera.samples} samples",
        "body": f"{radius:.10g} m ({body.name})",
    }
    et = camera.ephemeris_time(camera.lines / 2)
    time = "" if et is None else et_to_utc(float(et))
    if time:
        facts["time"] = f"{time} (middle line)"
    found = _camera_footprint(camera)
    if found is None:
        return facts | {"ground": "the camera's middle looks past the body"}
    facts |= found.facts()
    position = camera.position(camera.lines / 2)
    sun = camera.sun_position(camera.lines / 2)
    if sun is None and time:
        sun = _sun_of(time, body)
    facts |= _sun_facts(found, sun)
    ground = found.middle * radius
    to_camera = position - ground
    emission = math.degrees(math.acos(float(found.middle @ to_camera / np.linalg.norm(to_camera))))
    lon, lat, distance = place_of(position)
    facts["spacecraft"] = f"over {lon % 360:.4f} E {lat:.4f} N, altitude {distance - radius:.6g} m"
    facts["emission"] = f"{emission:.2f} deg at the middle"
    return facts | found.dem() | {f"note {k + 1}": note for k, note in enumerate(camera.notes)}


def _camera_footprint(camera: Camera) -> Footprint | None:
    places = np.meshgrid(camera.edge_lines(OUTLINE), np.linspace(0, camera.samples, OUTLINE), indexing="ij")
    points = camera.image_to_ground(*places)
    line, sample = camera.lines / 2, camera.samples / 2
    lines, samples = line + np.array([0, -0.5, 0.5, 0, 0]), sample + np.array([0, 0, 0, -0.5, 0.5])
    cross = camera.image_to_ground(lines, samples)
    if not np.isfinite(cross).all():
        return None
    down, across = (float(np.linalg.norm(cross[a] - cross[a + 1])) for a in (1, 3))
    points = points[np.isfinite(points).all(-1)]
    lon, lat = lonlat_of_points(points)
    middle_lon, _ = lonlat_of_points(cross[0])
    around = near_longitude(lon, float(middle_lon))
    return Footprint(
        (float(around.min()), float(around.max())),
        (float(lat.min()), float(lat.max())),
        (across * camera.samples, down * camera.lines),
        (across, down),
        cross[0] / np.linalg.norm(cross[0]),
    )


def _sun_facts(found: Footprint, sun: Floats | None) -> dict[str, str]:
    """sun : (3,) body-fixed, m, or any vector towards it from the body's centre"""
    if sun is None:
        return {}
    lon, lat, distance = place_of(sun)
    incidence = math.degrees(math.acos(max(-1.0, min(1.0, float(found.middle @ sun / distance)))))
    return {"Sun": f"over {lon % 360:.4f} E {lat:.4f} N, incidence {incidence:.2f} deg on the level at the middle"}


def _sun_of(time: str, body: Body) -> Floats | None:
    if body.name not in RADII:
        return None
    point = subsolar_point(time, body)
    return unit_vectors(point.longitude_deg, point.latitude_deg)


def _time(path: Path) -> str:
    """UTC from the label or the product id, empty where neither tells it."""
    try:
        return label_time(path) or product_time(path.name) or ""
    except InputError:
        return ""


def _body(radius: float) -> Body:
    """The named body nearest to a radius, m."""
    name = min(RADII, key=lambda k: abs(RADII[k] - radius))
    return Body(name if abs(RADII[name] - radius) < BODY_TOLERANCE * radius else "no known body", radius)
