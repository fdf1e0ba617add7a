"""Rasters without a CRS of the body: one line that says how to assign one, and what it says works."""

from __future__ import annotations

import re

import numpy as np
import pytest
import rasterio
import small_scene
from evaluation_scene import run_command
from rasterio.crs import CRS
from test_formats import isis_cube

from schemas import GeometryError, InputError
from stages import ingest
from stages.physics.bodies.spheres import find_body
from stages.physics.images.table import read_frames

LOCAL = (
    'LOCAL_CS["local",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]',
    'ENGCRS["rover",EDATUM["lander"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]',
    "EPSG:4978",
)


def with_crs(source, path, crs):
    with rasterio.open(source) as raster:
        return small_scene.write_raster(path, raster.read(1), crs, raster.transform, nodata=raster.nodata)


@pytest.mark.parametrize("crs", LOCAL)
def test_a_local_crs_is_refused_in_one_line(crs, small_files, tmp_path):
    dem = with_crs(small_files.dem, tmp_path / "dem.tif", CRS.from_user_input(crs))
    light = ("--model", "M2", "--sun-azimuth", "90", "--sun-elevation", "30")
    for command in (
        ("ingest", dem, "-o", tmp_path / "out.h5"),
        ("render", "--dem", dem, *light, "-o", tmp_path / "out.exr"),
    ):
        code, message = run_command(*command)
        assert code == 3 and "\n" not in message
        assert re.search(r"dem\.tif: expected .* map projection, found another CRS .*IAU_2015:30100", message)


@pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:4326"])
def test_a_moon_map_tagged_as_the_earth_is_mended_by_the_advice(crs, small_files, tmp_path):
    """The CRS that the message names makes the DEM good: its true one instead of another body."""
    if crs == "EPSG:4326":
        with rasterio.open(small_files.folder / "image0.tif") as raster:
            z = np.where(raster.read(1) == raster.nodata, np.nan, 100 * raster.read(1))
            dem = small_scene.write_raster(tmp_path / "dem.tif", z, CRS.from_user_input(crs), raster.transform)
    else:
        dem = with_crs(small_files.dem, tmp_path / "dem.tif", CRS.from_user_input(crs))
    with pytest.raises(GeometryError, match=r"the Earth.*assign the CRS") as caught:
        ingest.run(dem, None, tmp_path / "scene.h5", ingest.Config())
    assert "name the body" not in str(caught.value)
    degrees, metres = re.search(r"-a_srs (\S+) for degrees, '([^']*)'", str(caught.value)).groups()
    with rasterio.open(dem, "r+") as raster:
        raster.crs = CRS.from_user_input(degrees if crs == "EPSG:4326" else metres)
    ingest.run(dem, None, tmp_path / "scene.h5", ingest.Config())
    assert (tmp_path / "scene.h5").is_file()


def test_an_unprojected_cube_is_told_that_it_lacks_its_camera(tmp_path):
    isis_cube(tmp_path / "raw.cub", np.full((8, 8), 0.05, "<f4"), "Real")
    table = tmp_path / "images.csv"
    table.write_text("image_id,path,units,start_time\nA,raw.cub,iof,2010-01-01T00:00:00Z\n")
    with pytest.raises(InputError, match=r"raw\.cub: .*no CRS; give the camera"):
        read_frames(table, find_body("moon"))
    instrument = "Group = Instrument\n InstrumentId = METRIC\n End_Group\n"
    isis_cube(tmp_path / "raw.cub", np.full((8, 8), 0.05, "<f4"), "Real", instrument)
    with pytest.raises(InputError, match=r"raw\.cub: .*found none; run spiceinit on it first"):
        read_frames(table, find_body("moon"))
    mapped = instrument + "Group = Mapping\n ProjectionName = Sinusoidal\n End_Group\n"
    isis_cube(tmp_path / "raw.cub", np.full((8, 8), 0.05, "<f4"), "Real", mapped)
    columns = "subsolar_longitude_deg,subsolar_latitude_deg,solar_distance_au,spacecraft_longitude_deg"
    columns += ",spacecraft_latitude_deg,spacecraft_altitude_m"
    table.write_text(f"image_id,path,units,start_time,{columns}\nA,raw.cub,iof,2010-01-01,0,0,1,0,0,1e5\n")
    assert read_frames(table, find_body("moon"))[0].camera is None
    table.write_text(table.read_text().replace("raw.cub", "a" * 300))  # a name that no file can have: ingest says so
    assert read_frames(table, find_body("moon"))[0].camera is None
