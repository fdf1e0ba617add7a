"""Maps that reach beyond 180 degrees from their central meridian, or whose ends meet: every pixel against a closed form."""

from __future__ import annotations

import math

import h5py
import numpy as np
import pytest
import rasterio
import small_scene
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.warp import Resampling

from stages import ingest
from stages.physics.images.source_images import MapSource
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid

R = 1737400.0
DEGREE = math.radians(1) * R  # m
STEP, N = 0.008, 40  # degrees and pixels of every map here
LATITUDE = 5.0  # of its middle

# name -> (PROJ, central meridian)
FORMS = {
    "eqc 0": ("+proj=eqc +lon_0=0", 0.0),
    "eqc 180": ("+proj=eqc +lon_0=180", 180.0),
    "eqc -180": ("+proj=eqc +lon_0=-180", -180.0),
    "sinusoidal": ("+proj=sinu +lon_0=0", 0.0),
    "mercator": ("+proj=merc +lon_0=0", 0.0),
    "degrees": ("+proj=longlat", 0.0),
}
# longitude of the ground's middle, and the same in the turn that a map counts in
DOMAINS = [(180.0, 180.0), (180.0, -180.0), (200.0, 200.0), (0.05, 360.05)]


class Map:
    """A small map of the ground about (``middle``, LATITUDE), its own closed form beside PROJ's."""

    def __init__(self, form: str, middle: float, size: int = N) -> None:
        proj, self.meridian = FORMS[form]
        self.form, self.size = form.split()[0], size
        self.crs = CRS.from_proj4(f"{proj} +R={R} +no_defs")
        self.unit = 1.0 if self.form == "degrees" else DEGREE
        x, y = self.place(middle, LATITUDE)
        step = STEP * self.unit
        self.transform = Affine(step, 0, x - step * size / 2, 0, -step, y + step * size / 2)
        self.grid = Grid(self.crs.to_wkt(), self.transform, size, size, R)

    def place(self, lon, lat):
        """Map coordinates of a longitude in the map's own turn (Snyder 1987)."""
        x, y = (lon - self.meridian) * self.unit, lat * self.unit
        if self.form == "sinusoidal":
            x = x * np.cos(np.radians(lat))
        if self.form == "mercator":
            y = R * np.log(np.tan(np.pi / 4 + np.radians(lat) / 2))
        return x, y

    def lonlat(self):
        """(size, size) each: longitude in the map's own turn, and latitude, of pixel centres."""
        col, row = np.meshgrid(np.arange(self.size) + 0.5, np.arange(self.size) + 0.5)
        x, y = self.transform @ (col, row)
        lat = y / self.unit
        if self.form == "mercator":
            lat = np.degrees(2 * np.arctan(np.exp(y / R)) - np.pi / 2)
        x = x / np.cos(np.radians(lat)) if self.form == "sinusoidal" else x
        return x / self.unit + self.meridian, lat

    def write(self, path):
        lon, lat = self.lonlat()
        return small_scene.write_raster(path, ground(lon, lat).astype(np.float32), self.crs, self.transform)


def ground(lon, lat):
    """A smooth field on the body; the same for every turn of longitude."""
    lon = np.radians(lon)
    return 1500 * np.cos(lon) + 900 * np.sin(lon) + 20 * np.sin(180 * lon) + 15 * np.cos(np.radians(200 * lat))


CURVED = 0.05  # m: (pixel size)^2 / 8 x curvature of ``ground``, with room


@pytest.mark.parametrize(("place", "middle"), DOMAINS)
@pytest.mark.parametrize("form", FORMS)
def test_places_of_any_turn_fall_on_the_map_that_shows_them(form, place, middle):
    chart = Map(form, middle)
    lon, lat = chart.lonlat()
    row, col = np.meshgrid(np.arange(N), np.arange(N), indexing="ij")
    for turn in (-360.0, 0.0, 360.0):
        found = chart.grid.rowcol_of_lonlat(lon + turn, lat)
        np.testing.assert_allclose(found, [row, col], atol=1e-6)
    back, latitude = chart.grid.lonlat(row, col)
    assert np.abs(back).max() <= 180
    np.testing.assert_allclose((back - lon + 180) % 360, 180, atol=1e-9)
    np.testing.assert_allclose(latitude, lat, atol=1e-9)


@pytest.mark.parametrize(("place", "middle"), DOMAINS)
@pytest.mark.parametrize("source", FORMS)
def test_every_map_is_read_on_every_other(source, place, middle, tmp_path):
    """As a DEM or a map-projected image on the grid of a scene: nothing is lost, each pixel has the ground's own value."""
    image = Map(source, middle, 2 * N)  # a sinusoidal map so far from its meridian is sheared
    with rasters.open_raster(image.write(tmp_path / "a.tif")) as dataset:
        for form in FORMS:
            for other in {m for p, m in DOMAINS if p == place}:
                target = Map(form, other)
                values, valid = rasters.warp(dataset, target.grid, Resampling.bilinear)
                assert valid.all(), (form, other)
                np.testing.assert_allclose(values, ground(*target.lonlat()), atol=CURVED)
                assert MapSource(dataset, target.grid, None, np.zeros(3)).box() == (0, 0, N, N)


@pytest.mark.parametrize("left", [0.0, -180.05])
@pytest.mark.parametrize("form", ["degrees", "eqc 0", "sinusoidal"])
@pytest.mark.parametrize("middle", [0.0, 180.0])
def test_a_map_of_the_whole_body_is_read_across_its_ends(form, left, middle, tmp_path):
    chart = Map(form, 0.0)
    step = 0.05
    width = math.ceil(360 / step - 1e-9) + 1  # as in maps whose pixels do not divide a turn
    size = step * chart.unit
    transform = Affine(size, 0, left * chart.unit, 0, -size, 8 * chart.unit)
    col, row = np.meshgrid(np.arange(width) + 0.5, np.arange(120) + 0.5)
    x, y = transform @ (col, row)
    lat = y / chart.unit
    lon = x / chart.unit / (np.cos(np.radians(lat)) if form == "sinusoidal" else 1.0)
    field = 1500 * np.cos(np.radians(lon)) + 900 * np.sin(np.radians(lon)) + 300 * lat
    field[np.abs(lon - left - 180) > 180 + 2 * step] = np.nan
    path = small_scene.write_raster(tmp_path / "a.tif", field.astype(np.float32), chart.crs, transform)
    local = CRS.from_proj4(f"+proj=stere +lat_0=5 +lon_0={middle} +R={R} +units=m +no_defs")
    grid = Grid(local.to_wkt(), Affine(700, 0, -35000, 0, -700, 35000), 100, 100, R)
    with rasters.open_raster(path) as dataset:
        values, valid = rasters.warp(dataset, grid, Resampling.bilinear)
        box = MapSource(dataset, grid, None, np.zeros(3)).box()
    assert valid.all() and box == (0, 0, 100, 100)
    lon, lat = grid.lonlat(*np.meshgrid(np.arange(100), np.arange(100), indexing="ij"))
    truth = 1500 * np.cos(np.radians(lon)) + 900 * np.sin(np.radians(lon)) + 300 * lat
    steepest = 1.0 * step * 26  # half a pixel of the map, at its ends alone
    np.testing.assert_allclose(values, truth, atol=steepest)


@pytest.mark.parametrize(("dem", "image"), [("eqc 0", "degrees"), ("degrees", "eqc 0"), ("mercator", "sinusoidal")])
def test_a_scene_at_180_degrees_is_whole(dem, image, tmp_path):
    """The DEM's own grid where it is metric, a local one otherwise; images with the same ground in another turn."""
    elevation = Map(dem, 180.0)
    elevation.write(tmp_path / "dem.tif")
    Map(image, -180.0 if image == "degrees" else 180.0, 2 * N).write(tmp_path / "image.tif")
    (tmp_path / "images.csv").write_text(
        "image_id,path,units,subsolar_longitude_deg,subsolar_latitude_deg,solar_distance_au,spacecraft_longitude_deg,"
        "spacecraft_latitude_deg,spacecraft_altitude_m\nA,image.tif,dn,150,0,1,180,5,1e5\n"
    )
    found = ingest.run(tmp_path / "dem.tif", tmp_path / "images.csv", tmp_path / "scene.h5", ingest.Config(crop=16))
    grid = found.grid
    with h5py.File(tmp_path / "scene.h5") as file:
        known = file["elevation"][...]
        inner = np.s_[6 : grid.height - 6, 6 : grid.width - 6]
        row, col = np.meshgrid(np.arange(grid.height), np.arange(grid.width), indexing="ij")
        np.testing.assert_allclose(known[inner], ground(*grid.lonlat(row, col))[inner], atol=CURVED)
        assert file["valid"][0][inner].all()
    with rasterio.open(tmp_path / "dem.tif") as raster:
        assert grid.height * grid.width > 0.95 * raster.height * raster.width
