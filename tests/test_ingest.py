"""ingest: the DEM's grid, its nodata, and positions where whole crops are valid."""

from __future__ import annotations

import re

import h5py
import numpy as np
import pytest
import rasterio
import small_scene
from rasterio.transform import Affine

from schemas import ConfigError, GeometryError, InputError
from stages import ingest, sample
from stages.ingest import elevation
from stages.physics.maps import rasters
from stages.physics.maps.positions import valid_positions


def test_scene_holds_the_dem_on_its_own_grid(small_files, tmp_path):
    ingest.run(small_files.dem, None, tmp_path / "scene.h5", ingest.Config())
    with rasterio.open(small_files.dem) as dem, h5py.File(tmp_path / "scene.h5") as scene:
        expected = dem.read(1, masked=True)
        np.testing.assert_array_equal(scene["elevation"][...], expected.filled(np.nan))
        np.testing.assert_array_equal(scene["dem_valid"][...], ~expected.mask)
        assert scene["x"][0] == dem.xy(0, 0)[0]
        assert scene["y"][-1] == dem.xy(dem.height - 1, 0)[1]


def test_integer_factor_is_the_area_mean_of_valid_pixels(small_files, tmp_path):
    found = ingest.run(small_files.dem, None, tmp_path / "scene.h5", ingest.Config(gsd=60, block=37))
    assert not found.resampled
    with rasterio.open(small_files.dem) as dem, h5py.File(tmp_path / "scene.h5") as scene:
        fine = dem.read(1, masked=True).filled(np.nan).astype(float)
        cells = fine.reshape(128, 3, 128, 3)
        share = np.isfinite(cells).mean(axis=(1, 3))
        count = np.isfinite(cells).sum(axis=(1, 3))
        mean = np.where(share >= 0.5, np.nansum(cells, axis=(1, 3)) / np.maximum(count, 1), np.nan)
        np.testing.assert_allclose(scene["elevation"][...], mean, rtol=1e-6)


# means of 3 x 3, and a reprojection (no multiple of the DEM's 20 m)
@pytest.mark.parametrize("gsd", [60, pytest.param(50, marks=pytest.mark.slow)])
def test_pieces_however_small_give_the_same_scene(small_files, tmp_path, monkeypatch, gsd):
    """What is read at a time, which the source's strips and the memory decide, does not show in the result."""
    strips = tmp_path / "strips.tif"
    with rasterio.open(small_files.dem) as dem:
        small_scene.write_raster(strips, dem.read(1), dem.crs, dem.transform, nodata=dem.nodata, blockysize=1)
    for name, dem in (("a", small_files.dem), ("b", strips)):
        ingest.run(dem, small_files.images, tmp_path / f"{name}.h5", ingest.Config(gsd=gsd, crop=32, block=64))
        monkeypatch.setattr(elevation, "STRIP_PX", 100)
        monkeypatch.setattr(elevation, "STRIP_CACHE", 384 * 4 * 100)
        monkeypatch.setattr(rasters, "LARGEST_WINDOW", 5000)
    with h5py.File(tmp_path / "a.h5") as a, h5py.File(tmp_path / "b.h5") as b:
        np.testing.assert_allclose(a["elevation"][...], b["elevation"][...], atol=1e-4, rtol=0)
        for name in ("dem_valid", "valid"):  # GDAL rounds a pixel on the edge of nodata to one side or the other
            assert (a[name][...] != b[name][...]).mean() < 1e-4


def test_degrees_become_a_metric_grid_true_to_the_terrain(tmp_path):
    """The same analytic terrain given in degrees comes out on metres where its formula says."""
    step = np.degrees(20 / small_scene.RADIUS)
    n = 300
    lon = small_scene.LON + (np.arange(n) + 0.5 - n / 2) * step
    lat = small_scene.LAT - (np.arange(n) + 0.5 - n / 2) * step
    x, y = small_scene.local_xy(lon[None, :], lat[:, None])
    z = small_scene.height(x, y)
    crs = rasterio.CRS.from_proj4(f"+proj=longlat +R={small_scene.RADIUS} +no_defs")
    transform = Affine(step, 0, lon[0] - step / 2, 0, -step, lat[0] + step / 2)
    small_scene.write_raster(tmp_path / "dem.tif", np.round(z * 2).astype(np.int16), crs, transform, nodata=-32768)
    with rasterio.open(tmp_path / "dem.tif", "r+") as dem:
        dem.scales, dem.offsets = (0.5,), (0.0,)
    found = ingest.run(tmp_path / "dem.tif", None, tmp_path / "scene.h5", ingest.Config(gsd=20, block=128))
    assert found.resampled
    assert found.grid.crs.is_projected
    with h5py.File(tmp_path / "scene.h5") as scene:
        got = scene["elevation"][...]
        row, col = np.nonzero(np.isfinite(got))
        where = found.grid.lonlat(row, col)
        expected = small_scene.height(*small_scene.local_xy(*where))
    inner = np.abs(expected) < 1e9
    assert np.abs(got[row, col] - expected)[inner].max() < 0.6  # half a step of 0.5 m, and the interpolation
    assert np.isfinite(got).mean() > 0.9


def test_radii_become_elevations(shared, tmp_path):
    """ldem_4.cub stores radii through a scale and an offset; Mare Tranquillitatis lies 1 to 2 km below the sphere."""
    with rasterio.open(shared / "data/formats/ldem_4.cub") as cube:
        row, col = cube.index(*(np.radians(v) * 1737400 for v in (31.0 - 180.0, 8.0)))
        window = rasterio.windows.Window(col - 16, row - 16, 32, 32)
        cut = cube.read(1, window=window)
        path = small_scene.write_raster(
            tmp_path / "cut.tif", cut, cube.crs, cube.window_transform(window), nodata=-32768
        )
        scale, offset = cube.scales, cube.offsets
    with rasterio.open(path, "r+") as out:
        out.scales, out.offsets = scale, offset
    found = ingest.run(path, None, tmp_path / "scene.h5", ingest.Config())
    assert -3000 < found.elevation_range[0] < found.elevation_range[1] < 500
    with h5py.File(tmp_path / "scene.h5") as scene:
        assert -2200 < np.nanmedian(scene["elevation"][...]) < -500


def test_a_globe_is_no_local_map(shared, tmp_path):
    with pytest.raises(GeometryError, match="cut a region"):
        ingest.run(shared / "data/formats/ldem_4.cub", None, tmp_path / "scene.h5", ingest.Config(gsd=20000))


def test_polar_stereographic_dem_keeps_its_grid(shared, tmp_path):
    found = ingest.run(shared / "data/dem/shoemaker_lola_5m.tif", None, tmp_path / "scene.h5", ingest.Config())
    assert (found.grid.height, found.grid.width, found.grid.gsd) == (256, 256, 5.0)
    assert not found.resampled


@pytest.mark.parametrize("block", [(0, 0, 60, 70), (10, 20, 17, 13)])
@pytest.mark.parametrize("crop", [16, 22])
def test_valid_positions_are_exactly_those_of_whole_crops(rng, block, crop):
    valid = rng.random((60, 70)) > 0.003
    got = valid_positions(valid.astype("u1"), 60, 70, block, crop)
    half = crop // 2
    for r in range(block[2]):
        for c in range(block[3]):
            row, col = block[0] + r, block[1] + c
            inside = row >= half and col >= half and row + half <= 60 and col + half <= 70
            assert got[r, c] == (inside and valid[row - half : row + half, col - half : col + half].all())


def test_masks_agree_with_the_footprint(small_files, tmp_path):
    ingest.run(small_files.dem, small_files.images, tmp_path / "s.h5", ingest.Config(crop=32, block=64))
    with h5py.File(tmp_path / "s.h5") as scene:
        valid, dem_valid = scene["valid"][...].astype(bool), scene["dem_valid"][...].astype(bool)
        x, y = np.meshgrid(scene["x"][...], scene["y"][...])
        half = small_scene.SIZE * small_scene.GSD / 2
        for k in range(3):
            offset = np.abs(x - (k - 1) * half * 0.5 - 0.12 * y)
            assert not (valid[k] & (offset > half * 0.75)).any()
            assert (valid[k] | ~dem_valid)[offset < half * 0.75 - 40].all()
            assert not (valid[k] & ~dem_valid).any()
        r, c, h, w = scene["frame_window"][0]
        outside = valid[0].copy()
        outside[r : r + h, c : c + w] = False
        assert not outside.any()


def damaged(tmp_path, **change):
    """A DEM with something wrong."""
    options = {"z": None, "crs": small_scene.local_crs(), "nodata": None} | change
    axis = (np.arange(128) - 63.5) * 20
    z = small_scene.height(axis[None, :], -axis[:, None]).astype(np.float32) if options["z"] is None else options["z"]
    return small_scene.write_raster(
        tmp_path / "dem.tif", z, options["crs"], Affine(20, 0, 0, 0, -20, 0), nodata=options["nodata"]
    )


def test_bad_dems_get_one_clear_line(tmp_path):
    out = tmp_path / "scene.h5"
    mars = rasterio.CRS.from_proj4("+proj=stere +lat_0=10 +lon_0=20 +R=3389500 +units=m +no_defs")
    axis = (np.arange(128) - 63.5) * 20
    terrain = small_scene.height(axis[None, :], -axis[:, None]).astype(np.float32)
    cases = [
        ({"crs": mars}, GeometryError, "`body`"),
        ({"z": np.full((128, 128), np.nan, np.float32)}, InputError, "only nodata"),
        ({"z": np.full((128, 128), -1, np.float32), "nodata": -1}, InputError, "only nodata"),
        ({"z": terrain / 1000}, InputError, "kilometres"),
        ({"z": (terrain + 1737400) / 1000}, InputError, "kilometres"),
        ({"z": terrain * 1000}, InputError, "units"),
        ({"crs": None}, InputError, "no CRS"),
    ]
    for change, kind, words in cases:
        dem = damaged(tmp_path, **change)
        with pytest.raises(kind, match=words) as caught:
            ingest.run(dem, None, out, ingest.Config())
        assert "\n" not in str(caught.value)
        assert not out.exists()
        dem.unlink()
    with pytest.raises(InputError, match="no such file"):
        ingest.run(tmp_path / "absent.tif", None, out, ingest.Config())
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(InputError, match="GDAL"):
        ingest.run(tmp_path / "text.tif", None, out, ingest.Config())


def test_truncated_dem_is_refused(small_files, tmp_path):
    data = small_files.dem.read_bytes()
    (tmp_path / "dem.tif").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"damaged|truncated"):
        ingest.run(tmp_path / "dem.tif", None, tmp_path / "scene.h5", ingest.Config())
    assert not (tmp_path / "scene.h5").exists()


def edit_table(files, tmp_path, **change):
    """images.csv with some columns of its first image changed."""
    lines = files.images.read_text().splitlines()
    header, first = lines[0].split(","), lines[1].split(",")
    for key, value in change.items():
        first[header.index(key)] = value
    first[header.index("path")] = change.get("path", str(files.folder / first[header.index("path")]))
    table = tmp_path / "images.csv"
    table.write_text("\n".join([lines[0], ",".join(first)]))
    return table


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"units": "radiance"}, InputError, "units"),
        ({"subsolar_longitude_deg": "abc"}, InputError, "subsolar_longitude_deg"),
        ({"spacecraft_altitude_m": "nan"}, InputError, "spacecraft_altitude_m"),
        ({"path": "absent.tif"}, InputError, "no such file"),
        ({"subsolar_longitude_deg": "200"}, GeometryError, "below the horizon"),
    ],
)
def test_bad_tables_get_one_clear_line(small_files, tmp_path, change, kind, words):
    table = edit_table(small_files, tmp_path, **change)
    with pytest.raises(kind, match=words):
        ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(crop=32))
    assert not (tmp_path / "scene.h5").exists()


def test_image_elsewhere_is_refused_or_skipped(small_files, tmp_path):
    with rasterio.open(small_files.folder / "image0.tif") as image:
        t = image.transform
        moved = Affine(t.a, 0, t.c + 30, 0, t.e, t.f)
        small_scene.write_raster(tmp_path / "far.tif", image.read(1), image.crs, moved, nodata=-1e4)
    table = edit_table(small_files, tmp_path, path="far.tif")
    with pytest.raises(InputError, match="does not touch the DEM"):
        ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(crop=32))
    with pytest.raises(InputError, match="no image touches"):
        ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(crop=32, skip_outside=True))


def test_images_without_valid_ground_are_refused(small_files, tmp_path):
    with rasterio.open(small_files.folder / "image0.tif") as image:
        blank = np.full_like(image.read(1), -1e4)
        small_scene.write_raster(tmp_path / "blank.tif", blank, image.crs, image.transform, nodata=-1e4)
    table = edit_table(small_files, tmp_path, path="blank.tif")
    with pytest.raises(GeometryError, match="expected valid ground under some image, found none"):
        ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(crop=32))
    with pytest.raises(ConfigError, match="even"):
        ingest.run(small_files.dem, small_files.images, tmp_path / "scene.h5", ingest.Config(crop=33))


def test_a_dem_too_coarse_for_an_image_is_told_how_fine_it_must_be(small_files, tmp_path):
    """A strip 240 m wide holds crops of 32 px on grids of 7.5 m and finer, none of the 20 m here and none of 16 px either."""
    with rasterio.open(small_files.folder / "image0.tif") as image:
        values, t = image.read(1), image.transform
        middle = values.shape[1] // 2
        values[:, : middle - 10] = values[:, middle + 10 :] = -1e4  # 20 pixels of 12 m
        small_scene.write_raster(tmp_path / "strip.tif", values, image.crs, t, nodata=-1e4)
    table = edit_table(small_files, tmp_path, path="strip.tif")
    ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(crop=32))
    with pytest.raises(GeometryError, match=r"larger than any valid region of any image, where (\d+) m") as caught:
        sample.run(tmp_path / "scene.h5", tmp_path / "crops.h5", sample.Config(tile_m=1000))
    assert "choose a `crop`" not in str(caught.value)
    assert 5 < float(re.search(r"a grid of (\S+) m or finer", str(caught.value))[1]) <= 7.5


def test_heights_above_another_sphere_are_noted(small_files, tmp_path):
    other = rasterio.CRS.from_proj4("+proj=stere +lat_0=10 +lon_0=20 +R=1738000 +units=m +no_defs")
    with rasterio.open(small_files.dem) as dem:
        path = small_scene.write_raster(tmp_path / "dem.tif", dem.read(1), other, dem.transform, nodata=dem.nodata)
    said: list[str] = []
    ingest.run(path, None, tmp_path / "a.h5", ingest.Config(), said.append)
    assert len(said) == 1 and "sphere of 1738000 m, its heights are taken as above 1737400 m" in said[0]
    ingest.run(path, None, tmp_path / "b.h5", ingest.Config(body="1738000"), said.append)
    ingest.run(small_files.dem, None, tmp_path / "c.h5", ingest.Config(), said.append)
    assert len(said) == 1
