"""Formats that users bring: real cubes, every special pixel, PDS3 and PDS4, and projections against PROJ's own cases."""

from __future__ import annotations

import csv
import math
import re
import struct

import numpy as np
import pytest
import rasterio
import rasterio.warp
from conftest import SHARED
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.windows import Window

from schemas.errors import InputError
from stages.physics.images.labels import find_block, find_value, parse_pvl, read_label
from stages.physics.maps import rasters
from stages.physics.maps.grid import Grid, local_metric_crs, sphere_crs

MOON = 1737400.0


def read_all(path):
    with rasters.open_raster(path) as dataset:
        return rasters.read_window(dataset, Window(0, 0, dataset.width, dataset.height))


# --- real files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("ldem_4.cub", MOON - 9200, MOON + 10800),  # LOLA: the Moon's relief above its sphere
        ("M143947267L.cal.echo.crop.cub", 0.0, 1.0),  # I/F
        ("M1181493219CE.vis.odd.reduced.cub", 0.0, 4095.0),  # raw counts
        ("wac_backplanes.reduced.cub", -360.0, 360.0),
    ],
)
def test_real_cubes_open(shared, name, low, high):
    values = read_all(shared / "data/formats" / name)
    known = values[np.isfinite(values)]
    assert known.size > 0.2 * values.size
    assert low <= known.min() and known.max() <= high


def test_a_real_cube_is_what_isis_says(shared):
    """The same pixels, exported by somebody else from the same cube."""
    values = read_all(shared / "data/formats/M143947267L.cal.echo.crop.cub")
    np.testing.assert_array_equal(
        values.astype(np.float32), np.load(shared / "oracles/nac_M143947267LE_crop_iof_400x400.npy").astype(np.float32)
    )


def test_real_dem_has_the_moons_grid(shared):
    """LOLA at 4 px per degree on 0..360: the Sun's longitudes go either way round."""
    with rasters.open_raster(shared / "data/formats/ldem_4.cub") as dataset:
        grid = Grid(dataset.crs.to_wkt(), dataset.transform, dataset.height, dataset.width, MOON)
        west, east = grid.rowcol_of_lonlat(-90.0, 10.0), grid.rowcol_of_lonlat(270.0, 10.0)
        lon, lat = grid.lonlat(0, 0)
    np.testing.assert_allclose(west, east, atol=1e-6)
    assert (lon % 360, lat) == (
        pytest.approx(0.125, abs=1e-3),
        pytest.approx(89.875, abs=1e-3),
    )  # its corner is rounded


# --- special pixels -------------------------------------------------------------------------------------------------


def isis_cube(path, array, pixel_type, groups=""):
    """A minimal band-sequential cube, by hand; ``groups`` add to its label."""
    label = f"""Object = IsisCube
  Object = Core
    StartByte = 1025
    Format = BandSequential
    Group = Dimensions
      Samples = {array.shape[1]}
      Lines   = {array.shape[0]}
      Bands   = 1
    End_Group
    Group = Pixels
      Type       = {pixel_type}
      ByteOrder  = Lsb
      Base       = 0.0
      Multiplier = 1.0
    End_Group
  End_Object
  {groups}
End_Object
Object = Label
  Bytes = 1024
End_Object
End
"""
    path.write_bytes(label.encode().ljust(1024, b"\0") + array.tobytes())
    return path


def test_every_special_pixel_of_32_bit_cubes_is_masked(tmp_path):
    specials = [struct.unpack("<f", struct.pack("<I", 0xFF7FFFFB + k))[0] for k in range(5)]  # NULL LRS LIS HIS HRS
    array = np.array([[*specials, 0.5], [1e-30, -2.0, 0.0, 3e30, 1.0, 2.0]], "<f4")
    values = read_all(isis_cube(tmp_path / "real.cub", array, "Real"))
    assert np.isnan(values[0, :5]).all()
    np.testing.assert_allclose(values.ravel()[5:], array.ravel()[5:])


@pytest.mark.parametrize(
    ("dtype", "pixel_type", "specials"),
    [
        ("<i2", "SignedWord", (-32768, -32767, -32766, -32765, -32764)),
        ("<u2", "UnsignedWord", (0, 1, 2, 65534, 65535)),
        ("u1", "UnsignedByte", (0, 255)),
    ],
)
def test_every_special_pixel_of_integer_cubes_is_masked(tmp_path, dtype, pixel_type, specials):
    array = np.array([[*specials, 17, 200, 100]], dtype)
    values = read_all(isis_cube(tmp_path / "words.cub", array, pixel_type))
    assert np.isnan(values[0, : len(specials)]).all()
    np.testing.assert_array_equal(values[0, len(specials) :], [17, 200, 100])


@pytest.mark.parametrize(
    ("dtype", "bad", "tag"),
    [
        ("float32", -3.4028227e38, -3.4028227e38),
        ("float32", -3.4028227e38, None),
        ("float32", float("nan"), None),
        ("float32", float("inf"), None),
        ("float32", -9999.0, -9999.0),
        ("int16", -32768, None),
        ("int16", -32768, -32768),
        ("uint8", 0, 0),
    ],
)
def test_nodata_in_its_spellings(tmp_path, dtype, bad, tag):
    array = np.full((4, 4), 7, dtype)
    array[1, 2] = bad
    profile = {"driver": "GTiff", "height": 4, "width": 4, "count": 1, "dtype": dtype, "nodata": tag}
    with rasterio.open(
        tmp_path / "a.tif", "w", crs=sphere_crs(MOON), transform=Affine(1, 0, 0, 0, -1, 4), **profile
    ) as out:
        out.write(array, 1)
    values = read_all(tmp_path / "a.tif")
    assert np.isnan(values[1, 2]) and np.isfinite(values).sum() == 15


# --- PDS ------------------------------------------------------------------------------------------------------------


def test_pds3_with_attached_label(tmp_path):
    label = (
        "PDS_VERSION_ID = PDS3\r\nRECORD_TYPE = FIXED_LENGTH\r\nRECORD_BYTES = 1024\r\nFILE_RECORDS = 2\r\nLABEL_RECORDS = 1\r\n"
        "^IMAGE = 2\r\nSTART_TIME = 2010-11-09T13:06:40.356\r\nOBJECT = IMAGE\r\n  LINES = 16\r\n  LINE_SAMPLES = 32\r\n"
        "  SAMPLE_TYPE = LSB_INTEGER\r\n  SAMPLE_BITS = 16\r\nEND_OBJECT = IMAGE\r\nEND\r\n"
    )
    array = np.arange(512, dtype="<i2").reshape(16, 32)
    array[3, 4] = -32768
    (tmp_path / "a.img").write_bytes(label.encode().ljust(1024) + array.tobytes())
    values = read_all(tmp_path / "a.img")
    assert np.isnan(values[3, 4])
    assert values[15, 31] == 511
    assert find_value(read_label(tmp_path / "a.img"), "lines") == 16


def test_pds4_label_and_image(tmp_path):
    array = np.arange(48, dtype="<f4").reshape(6, 8)
    array[0, 0] = -3.4028227e38
    profile = {"driver": "PDS4", "height": 6, "width": 8, "count": 1, "dtype": "float32", "nodata": -3.4028227e38}
    with rasterio.open(
        tmp_path / "a.xml", "w", crs=sphere_crs(MOON), transform=Affine(1, 0, 0, 0, -1, 6), **profile
    ) as out:
        out.write(array, 1)
    values = read_all(tmp_path / "a.xml")
    assert np.isnan(values[0, 0]) and values[5, 7] == 47


def test_pvl_in_its_spellings():
    label = parse_pvl(
        "A = 1 <ms> /* note */\nB = (1, 2.5,\n \"three\")\nGROUP = G\n C = 'text'\n OBJECT = O\n  D = {X, Y}\n END_OBJECT\nEND_GROUP = G\n"
        "LONG = data/a-\n   b.cub\nEND\njunk = (",
        "label",
    )
    assert label["A"] == 1 and label["B"] == [1, 2.5, "three"]
    assert find_block(label, "G")["C"] == "text" and find_value(label, "d") == {"X", "Y"}
    assert label["LONG"] == "data/ab.cub"
    for broken in ("END_GROUP = G\nEND", "A 1\nEND"):
        with pytest.raises(InputError, match="expected a PVL label"):
            parse_pvl(broken, "label")


# --- projections ----------------------------------------------------------------------------------------------------

OURS = ("eqc", "stere", "ups", "sinu", "ortho")
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "nm": 1e-9}


def proj_cases():
    path = SHARED / "oracles/proj_gie_projection_cases.csv"
    if not path.exists():
        return []
    with path.open() as file:
        rows = [r for r in csv.DictReader(file) if r["proj"] in OURS and "NaN" not in r["expect"]]
    # PROJ has had ellipsoidal formulas for eqc since January 2026 (OSGeo/PROJ pull request 4656); before, 9.7 and older
    # apply the spherical ones to any figure, and no CRS string asks for others.
    if tuple(map(int, rasterio.__proj_version__.split(".")[:2])) < (9, 8):
        rows = [r for r in rows if (r["proj"], r["figure"]) != ("eqc", "other")]
    return [pytest.param(r, id=f"{k}-{r['proj']}-{r['figure']}-{r['direction']}") for k, r in enumerate(rows)]


@pytest.mark.parametrize("case", proj_cases())
def test_projections_agree_with_proj(case):
    """Through the calls that grids make: longitude and latitude on the same figure to map metres and back."""
    operation = case["operation"]
    figure = " ".join(re.findall(r"\+(?:a|b|R|rf|f|es|ellps|datum)=\S+", operation)) or "+ellps=GRS80"
    geographic, projected = (CRS.from_proj4(f"{text} +no_defs") for text in (f"+proj=longlat {figure}", operation))
    accept = [float(v) for v in case["accept(lon_deg lat_deg or E N)"].split()[:2]]
    expect = [float(v) for v in case["expect"].split()[:2]]
    number, unit = re.fullmatch(r"([0-9.e+-]+)\s*([a-z]*)", case["tolerance"]).groups()
    tolerance = max(float(number) * METRES.get(unit, 1.0), 1e-3)  # the table keeps no more digits
    forward = case["direction"] == "forward"
    source, target = (geographic, projected) if forward else (projected, geographic)
    x, y = (v[0] for v in rasterio.warp.transform(source, target, [accept[0]], [accept[1]]))
    if forward:
        assert math.hypot(x - expect[0], y - expect[1]) <= tolerance
    else:
        east = (x - expect[0] + 180) % 360 - 180
        metres = math.radians(1) * 6.4e6
        assert abs(east) * math.cos(math.radians(expect[1])) * metres <= max(tolerance, 1e-3)
        assert abs(y - expect[1]) * metres <= max(tolerance, 1e-3)


@pytest.mark.parametrize(
    "projection",
    [
        "+proj=eqc +lat_ts=30 +lon_0=180",
        "+proj=stere +lat_0=-90",
        "+proj=sinu +lon_0=20",
        "+proj=ortho +lat_0=10 +lon_0=30",
    ],
)
@pytest.mark.parametrize("radius", [MOON, 3396190.0, 255000.0])
def test_grids_of_any_body_come_back(projection, radius, rng):
    crs = CRS.from_proj4(f"{projection} +R={radius} +units=m +no_defs")
    lon, lat = rng.uniform(10, 50, 50), rng.uniform(-20, 30, 50) - (60 if "-90" in projection else 0)
    grid = Grid(crs.to_wkt(), Affine(20, 0, -1e5, 0, -20, 1e5), 1000, 1000, radius)
    row, col = grid.rowcol_of_lonlat(lon, lat)
    back_lon, back_lat = grid.lonlat(row, col)
    np.testing.assert_allclose((back_lon - lon + 180) % 360 - 180, 0, atol=1e-9)
    np.testing.assert_allclose(back_lat, lat, atol=1e-9)
    np.testing.assert_allclose(grid.rowcol_of_lonlat(lon + 360, lat), [row, col], atol=1e-6)
    np.testing.assert_allclose(grid.rowcol_of_lonlat(lon - 360, lat), [row, col], atol=1e-6)


# --- planetographic latitudes ---------------------------------------------------------------------------------------

MARS = (3396190.0, 3376200.0)


def planetographic(latitude_deg):
    """Of a planetocentric latitude on Mars' ellipsoid."""
    return np.degrees(np.arctan(np.tan(np.radians(latitude_deg)) * (MARS[0] / MARS[1]) ** 2))


@pytest.mark.parametrize("kind", ["longlat", "stere"])
def test_planetographic_rasters_meet_planetocentric_grids(tmp_path, kind):
    """A raster whose pixels hold their own planetographic latitude, read on a grid on the sphere."""
    figure = f"+a={MARS[0]} +b={MARS[1]} +no_defs"
    if kind == "longlat":
        crs, step, x0, y0 = CRS.from_proj4(f"+proj=longlat {figure}"), 0.002, 9.8, 45.6
    else:
        crs, step, x0, y0 = (
            CRS.from_proj4(f"+proj=stere +lat_0=45.3 +lon_0=10 {figure} +units=m"),
            120.0,
            -15000.0,
            15000.0,
        )
    n = 250
    move = Affine(step, 0, x0, 0, -step, y0)
    own = Grid(crs.to_wkt(), move, n, n, MARS[0])
    rows, cols = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    lon, ocentric = own.lonlat(rows, cols)
    if kind == "longlat":
        np.testing.assert_allclose(planetographic(ocentric), y0 - (rows + 0.5) * step, atol=1e-9)
    array = (planetographic(ocentric) - 45).astype(np.float32)
    profile = {
        "driver": "GTiff",
        "height": n,
        "width": n,
        "count": 1,
        "dtype": "float32",
        "crs": crs,
        "transform": move,
    }
    with rasterio.open(tmp_path / "a.tif", "w", **profile) as out:
        out.write(array, 1)
    sphere = CRS.from_proj4(f"+proj=stere +lat_0=45 +lon_0=10 +R={MARS[0]} +units=m +no_defs")
    grid = Grid(sphere.to_wkt(), Affine(200, 0, -3000, 0, -200, 3000), 30, 30, MARS[0])
    with rasters.open_raster(tmp_path / "a.tif") as dataset:
        values, valid = rasters.warp(dataset, grid, rasterio.warp.Resampling.bilinear)
        size = rasters.pixel_size(dataset, MARS[0], 10.0, 45.0)
    assert valid.all()
    _, latitude = grid.lonlat(*np.meshgrid(np.arange(30), np.arange(30), indexing="ij"))
    # to a tenth of a pixel of the raster; without the conversion it would be 20 km
    np.testing.assert_allclose(values + 45, planetographic(latitude), atol=2e-4)
    assert size == (pytest.approx(85 if kind == "longlat" else 120, rel=0.03), pytest.approx(120, rel=0.03))
    back = own.rowcol_of_lonlat(lon, ocentric)
    np.testing.assert_allclose(back, [rows, cols], atol=1e-5)


def test_the_first_pixel_lies_half_a_pixel_within_the_corner():
    """Rows and columns count pixel centres: on a grid of 30 m whose corner is (1000, 5000), row 2 and column 1."""
    crs = local_metric_crs(20.0, 10.0, 1737400.0)
    grid = Grid(crs.to_wkt(), Affine(30, 0, 1000, 0, -30, 5000), 40, 50, 1737400.0)
    assert [float(v) for v in grid.xy(0, 0)] == pytest.approx([1015, 4985])
    assert [float(v) for v in grid.xy(2, 1)] == pytest.approx([1045, 4925])
    assert [float(v) for v in grid.rowcol(1045, 4925)] == pytest.approx([2, 1])
    assert [float(v) for v in grid.window(2, 1, 4, 5).xy(0, 0)] == pytest.approx([1045, 4925])
