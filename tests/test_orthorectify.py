"""Orthorectification: what is known in closed form, and a NAC line-scan frame."""

from __future__ import annotations

import json
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from camera_rays import image_to_terrain, looking_at
from rasterio.transform import Affine

from schemas.errors import InputError
from stages.physics.cameras import open_camera
from stages.physics.cameras.orthographic import Orthographic
from stages.physics.images.camera_image import open_camera_image
from stages.physics.images.orthorectify import Terrain, footprint, orthorectify, reach_px
from stages.physics.maps.grid import Grid, local_metric_crs

MOON = 1737400.0


def ground(size=96, gsd=10.0, latitude=0.0, longitude=0.0) -> Grid:
    half = size / 2 * gsd
    return Grid(
        local_metric_crs(longitude, latitude, MOON).to_wkt(), Affine(gsd, 0, -half, 0, -gsd, half), size, size, MOON
    )


def overhead(grid: Grid, pixel: float, size: int, emission_deg: float = 0.0, towards: str = "east") -> Orthographic:
    """An orthographic camera over the middle of the grid, lines running south, tilted towards an azimuth."""
    row = (grid.height - 1) / 2
    east, north, up = grid.local_frames(row, row).axes[0]
    tilt = math.radians(emission_deg)
    side = {"east": east, "north": north}[towards]
    forward = -(math.cos(tilt) * up + math.sin(tilt) * side)
    right = east - (east @ forward) * forward
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Orthographic(size, size, (pixel, pixel), (size / 2, size / 2), MOON * up - 1e5 * forward, rotation)


def reader(image):
    return lambda line, sample, lines, samples: image[line : line + lines, sample : sample + samples]


def whole(grid):
    return (0, 0, grid.height, grid.width)


def test_an_aligned_image_comes_back_as_block_means(rng):
    """Overhead, four image pixels per ground pixel a side: exactly the mean of each 4 x 4 block."""
    grid = ground(48)
    camera = overhead(grid, 2.5, 4 * 48)
    image = rng.random((192, 192)).astype(np.float32)
    smooth = image.copy()
    for axis in (0, 1):  # the mean over an area of what is linear between pixel centres
        smooth = sum(w * np.roll(smooth, k, axis) for k, w in ((-1, 0.125), (0, 0.75), (1, 0.125)))
    found = orthorectify(reader(image), camera, Terrain(np.zeros((48, 48)), grid), whole(grid))
    expected = smooth.reshape(48, 4, 48, 4).mean(axis=(1, 3))
    inner = np.s_[2:-2, 2:-2]
    assert found.valid[inner].all()
    np.testing.assert_allclose(found.image[inner], expected[inner], atol=1e-3)


@pytest.mark.parametrize("kind", ["pinhole", "orthographic"])
def test_a_pattern_on_the_terrain_is_put_back(kind):
    """A picture is taken of a pattern painted on relief (by intersection) and orthorectified (by projection)."""
    grid = ground(64, 20.0, latitude=20.0, longitude=15.0)
    rows, cols = np.meshgrid(np.arange(64), np.arange(64), indexing="ij")
    relief = 60 * np.sin(rows / 9) * np.cos(cols / 7)
    terrain = Terrain(relief, grid)
    if kind == "pinhole":
        up = grid.local_frames(31.5, 31.5).axes[0]
        camera = looking_at(up[2] * (MOON + 30e3) + up[0] * 9e3 + up[1] * 4e3, up[2] * MOON, 0.05, (320, 320))
    else:
        camera = overhead(grid, 5.0, 320, 15.0)

    def height_at(longitude, latitude):
        r, c = grid.rowcol_of_lonlat(longitude, latitude)
        return 60 * np.sin(r / 9) * np.cos(c / 7)

    def pattern(r, c):
        return 1 + 0.5 * np.sin(r / 5 + 0.3) * np.cos(c / 6)

    line, sample = np.meshgrid(np.arange(320) + 0.5, np.arange(320) + 0.5, indexing="ij")
    points = image_to_terrain(camera, line, sample, height_at)
    radius = np.linalg.norm(points, axis=-1)
    image = pattern(
        *grid.rowcol_of_lonlat(
            np.degrees(np.arctan2(points[..., 1], points[..., 0])), np.degrees(np.arcsin(points[..., 2] / radius))
        )
    ).astype(np.float32)
    found = orthorectify(reader(image), camera, terrain, (16, 16, 32, 32))
    assert found.valid.all() and not found.hidden.any()
    np.testing.assert_allclose(found.image, pattern(rows, cols)[16:48, 16:48], atol=4e-3)
    np.testing.assert_array_less(np.degrees(found.emission), 60)


@pytest.mark.parametrize(("towards", "emission_deg"), [("east", 40.0), ("north", 60.0)])
def test_a_wall_hides_what_lies_behind_it(towards, emission_deg):
    """A plateau of height H towards the camera hides H tan(emission) of the plain behind its edge."""
    grid, height = ground(96), 100.0
    z = np.zeros((96, 96))
    if towards == "east":
        z[:, 60:] = height  # the edge rises from column 59 to 60
    else:
        z[:36] = height
    camera = overhead(grid, 5.0, 400, emission_deg, towards)
    found = orthorectify(reader(np.ones((400, 400), np.float32)), camera, Terrain(z, grid), whole(grid))
    shadow = height * math.tan(math.radians(emission_deg)) / grid.gsd
    hidden = found.hidden[48] if towards == "east" else found.hidden[::-1, 48]
    first = np.flatnonzero(hidden)
    assert first[-1] in (59, 60)  # up to the foot of the wall, or the slope that its edge has in central differences
    assert first[0] == pytest.approx(60 - shadow, abs=1.01)
    assert hidden[first[0] : 60].all()
    assert not found.valid[found.hidden].any()
    expected = math.radians(emission_deg)
    at = (48, 20) if towards == "east" else (76, 48)
    assert found.emission[at] == pytest.approx(expected, abs=1e-3)


def test_slopes_turned_away_are_hidden():
    grid = ground(48)
    z = np.repeat(
        np.arange(48)[None] * 15.0, 48, axis=0
    )  # falls to the west at 56 deg, the camera stands low in the east
    camera = overhead(grid, 5.0, 300, 50.0, "east")
    found = orthorectify(reader(np.ones((300, 300), np.float32)), camera, Terrain(z, grid), (20, 20, 8, 8))
    assert found.hidden.all() and not found.valid.any()


def test_nodata_and_the_image_edge_are_invalid(rng):
    grid = ground(40)
    camera = overhead(grid, 10.0, 20)  # sees the middle half only
    image = rng.random((20, 20)).astype(np.float32)
    image[7, 11] = np.nan
    found = orthorectify(reader(image), camera, Terrain(np.zeros((40, 40)), grid), whole(grid))
    expected = np.zeros((40, 40), bool)
    expected[10:30, 10:30] = True
    assert not found.valid[~expected].any()
    assert not found.valid[17, 21]
    assert found.valid[11:29, 11:29].sum() >= 18 * 18 - 4
    np.testing.assert_allclose(found.detector_line[12, 15], 2, atol=1e-3)
    np.testing.assert_allclose(found.detector_sample[12, 15], 5, atol=1e-3)
    hole = np.full((40, 40), 0.0)
    hole[20, 20] = np.nan
    assert not orthorectify(reader(image), camera, Terrain(hole, grid), whole(grid)).valid[20, 20]


def test_a_nac_crop_keeps_its_angles_and_places(shared):
    """On the sphere: ISIS-anchored emission and phase, and the detector's own coordinates."""
    camera = open_camera(shared / "data/formats/M143947267L.cal.echo.crop.cub")
    truth = json.loads((shared / "oracles/nac_M143947267LE_crop_geometry_and_expected.json").read_text())
    truth = truth["independent_check"]["geometry"]
    grid = ground(64, 1.0, truth["lat"], truth["lon"])
    with open_camera_image(shared / "data/formats/M143947267L.cal.echo.crop.cub", camera, "the crop") as image:
        found = orthorectify(image.read, camera, Terrain(np.zeros((64, 64)), grid), whole(grid))
    assert found.valid.all()
    middle = np.s_[31:33, 31:33]
    np.testing.assert_allclose(np.degrees(found.emission[middle]), truth["ema"], atol=2e-3)
    np.testing.assert_allclose(np.degrees(found.phase[middle]), truth["phase"], atol=2e-3)
    np.testing.assert_allclose(found.detector_line[middle].mean(), 299.0, atol=1e-2)
    np.testing.assert_allclose(found.detector_sample[middle].mean(), 300.0, atol=1e-2)
    np.testing.assert_allclose(found.camera_position, camera.position(299.5), atol=200)
    pixels = np.load(shared / "oracles/nac_M143947267LE_crop_iof_400x400.npy")
    around = pixels[280:320, 280:320]
    assert around.min() < np.median(found.image) < around.max()


def test_a_large_image_never_sits_in_memory_whole():
    """A frame of 50,000 x 5,000 px on a coarse grid: windows stay small."""
    grid = ground(48, 1000.0)
    camera = replace(overhead(grid, 1.0, 50000), samples=5000, principal_point_px=(2500.0, 25000.0))
    largest = 0

    def read_window(line, sample, lines, samples):
        nonlocal largest
        largest = max(largest, lines * samples)
        return np.ones((lines, samples), np.float32)

    tracemalloc.start()
    found = orthorectify(read_window, camera, Terrain(np.zeros((48, 48)), grid), whole(grid))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.valid.sum() >= 46 * 4
    np.testing.assert_allclose(found.image[found.valid], 1.0, rtol=1e-6)
    assert largest <= 1 << 23
    assert peak < 200e6  # the image is 2.5e8 pixels of 4 bytes


def test_footprints_hold_what_is_seen():
    grid = ground(96)
    camera = overhead(grid, 10.0, 20)
    row, col, height, width = footprint(camera, grid, (0.0, 50.0))
    assert row <= 38 and col <= 38 and row + height >= 58 and col + width >= 58
    assert height < 30 and width < 30
    assert footprint(overhead(ground(96, latitude=40.0), 10.0, 20), grid, (0.0, 50.0)) is None
    assert reach_px(100.0, math.radians(45), 10.0) == 12


def test_the_image_must_have_its_cameras_size(shared, tmp_path):
    camera = open_camera(shared / "oracles/ale_lrolroc_M103595705LE.isd.json")
    path = shared / "data/formats/M143947267L.cal.echo.crop.cub"
    with (
        pytest.raises(InputError, match="expected 400 lines x 5064 samples as its camera model has, found 400 x 400"),
        open_camera_image(path, camera, "the image"),
    ):
        pass


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
def test_pictures_are_read_by_windows(tmp_path, rng, suffix):
    import OpenImageIO as oiio

    pixels = rng.integers(0, 60000, (600, 70)).astype(np.uint16)
    path = tmp_path / f"image{suffix}"
    kind = oiio.FLOAT if suffix == ".exr" else oiio.UINT16
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), oiio.ImageSpec(70, 600, 1, kind))
    assert output.write_image(pixels[..., None] if kind == oiio.UINT16 else pixels[..., None].astype(np.float32))
    output.close()
    camera = Orthographic(600, 70, (1.0, 1.0), (35.0, 300.0), np.array([2e6, 0, 0]), np.eye(3))
    with open_camera_image(path, camera, "the image") as image:
        np.testing.assert_array_equal(image.read(100, 10, 400, 50), pixels[100:500, 10:60])
        np.testing.assert_array_equal(image.read(0, 0, 1, 70), pixels[:1])
