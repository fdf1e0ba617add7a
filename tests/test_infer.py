"""infer: one seamless, georeferenced map whatever the windows; nodata masked and never spread."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import rasterio
import small_scene
import torch
from rasterio.transform import Affine

from schemas import ArtefactError, ConfigError
from stages import infer, ingest, merge, train
from stages.infer import windows
from stages.network.predictor import load_predictor

FULL = {"device": "cpu", "precision": "fp32"}


@pytest.fixture(scope="module")
def checkpoint(small_artefacts, tmp_path_factory):
    """All five stages of the U-Net, briefly trained on coefficients that vary: the reach of the real network."""
    path = tmp_path_factory.mktemp("infer") / "checkpoint.h5"
    config = train.Config(
        model="M2",
        epochs=2,
        batch=16,
        lr=3e-2,
        schedule="constant",
        widths=(4, 4, 8, 8, 8),
        device="cpu",
        precision="fp32",
    )
    train.run(small_artefacts["pairs"], path, config)
    return path


def maps(scene, checkpoint, out, **options):
    infer.run(scene, checkpoint, out, infer.Config(**(FULL | options)))
    with h5py.File(out) as file:
        return file["coefficients"][...], file["valid"][...].astype(bool)


@pytest.fixture(scope="module")
def whole(small_artefacts, checkpoint, tmp_path_factory):
    """The map in one window, with its GeoTIFF."""
    path = tmp_path_factory.mktemp("whole") / "map.h5"
    maps(small_artefacts["scene"], checkpoint, path, window=512)
    return path


@pytest.fixture(scope="module")
def reference(whole):
    with h5py.File(whole) as file:
        return file["coefficients"][...], file["valid"][...].astype(bool)


@pytest.fixture(scope="module")
def in_windows(small_artefacts, checkpoint, tmp_path_factory):
    """The map in windows of 77 px, which its size is no multiple of."""
    return maps(small_artefacts["scene"], checkpoint, tmp_path_factory.mktemp("windows") / "map.h5", window=77)


def test_the_size_of_windows_does_not_matter(in_windows, reference):
    """The bar is 2 % of a coefficient's standard deviation; windows with their whole context reach 0.1 %."""
    got, valid = in_windows
    np.testing.assert_array_equal(valid, reference[1])
    for k in range(got.shape[0]):
        spread = np.nanstd(reference[0][k])
        assert spread > 0
        assert np.nanmax(np.abs(got[k] - reference[0][k])) < 1e-3 * spread


def test_no_squares_at_window_borders(in_windows, reference):
    """Mean step of a coefficient across window borders, over the same pixels of a map made in one piece: at most 1.05.

    The same pixels, since five borders on this small map cross other terrain than the rest does.
    """
    for layer, seamless in zip(in_windows[0], reference[0], strict=True):
        for axis in (0, 1):
            borders = np.arange(76, layer.shape[axis] - 1, 77)
            across = np.nanmean(np.abs(np.diff(layer, axis=axis).take(borders, axis)))
            without = np.nanmean(np.abs(np.diff(seamless, axis=axis).take(borders, axis)))
            assert across / without <= 1.05


def test_the_map_is_the_networks_output_on_the_whole_terrain(small_artefacts, checkpoint, reference):
    with h5py.File(small_artefacts["scene"]) as file:
        z, valid = file["elevation"][...], file["dem_valid"][...].astype(bool)
    from stages.pairs.holes import fill_holes

    whole = load_predictor(checkpoint).coefficients(torch.from_numpy(fill_holes(z, valid))[None])[0].numpy()
    far = ~np.isnan(reference[0][0])
    np.testing.assert_allclose(reference[0][:, far], whole[:, far], rtol=2e-3, atol=2e-5)


def test_nodata_is_masked_and_never_spread(small_artefacts, reference):
    with h5py.File(small_artefacts["scene"]) as file:
        valid = file["dem_valid"][...].astype(bool)
    assert (~valid).any()
    np.testing.assert_array_equal(np.isfinite(reference[0]).all(axis=0), valid)
    np.testing.assert_array_equal(reference[1], valid)


def test_geotiff_aligns_with_the_dem_and_says_what_it_holds(small_files, whole):
    with rasterio.open(whole.with_suffix(".tif")) as tiff, rasterio.open(small_files.dem) as dem:
        assert tiff.transform == dem.transform
        assert (tiff.height, tiff.width) == (dem.height, dem.width)
        assert tiff.crs == dem.crs
        assert tiff.descriptions == ("a", "b", "c", "a_std", "b_std", "c_std")
        assert tiff.tags()["model"] == "M2"
        assert "I/F" in tiff.tags()["quantity"]
        assert tiff.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        np.testing.assert_array_equal(tiff.read(1, masked=True).mask, dem.read(1, masked=True).mask)


def test_without_a_geotiff_the_map_is_the_same(small_artefacts, checkpoint, reference, tmp_path):
    got, _ = maps(small_artefacts["scene"], checkpoint, tmp_path / "map.h5", window=512, geotiff=False)
    assert [p.name for p in tmp_path.iterdir()] == ["map.h5"]
    np.testing.assert_array_equal(got, reference[0])


def test_svbrdf_opens_in_xarray_with_coordinates(whole):
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(whole, engine="h5netcdf") as data:
        assert list(data["coefficient_name"].values) == ["a", "b", "c"]
        b = data["coefficients"].sel(coefficient="b")
        np.testing.assert_array_equal(b, data["coefficients"][1])
        assert b.dims == ("y", "x") and data["coefficients_std"].sel(map="c").dims == ("y", "x")
        assert data["coefficients"].attrs["grid_mapping"] == "crs"
        assert float(data["y"][0]) > float(data["y"][-1])
        assert data["x"].attrs["standard_name"] == "projection_x_coordinate" or data["x"].attrs["units"] == "m"


def test_gdal_places_the_netcdf_variable(small_artefacts, whole):
    """docs name NETCDF:file:variable; rasterio's own GDAL may be built without that driver."""
    from rasterio.drivers import raster_driver_extensions

    if "nc" not in raster_driver_extensions():
        pytest.skip("this GDAL has no netCDF driver")
    with rasterio.open(f"NETCDF:{whole}:elevation") as data, h5py.File(small_artefacts["scene"]) as scene:
        np.testing.assert_allclose(data.xy(0, 0), (scene["x"][0], scene["y"][0]), atol=1e-6)


def test_the_georeference_is_that_of_the_coordinates(whole):
    with h5py.File(whole) as file:
        left, width, _, top, _, height = map(float, file["crs"].attrs["GeoTransform"].split())
        x, y = file["x"][...], file["y"][...]
    np.testing.assert_allclose(x, left + width * (np.arange(len(x)) + 0.5), atol=1e-6)
    np.testing.assert_allclose(y, top + height * (np.arange(len(y)) + 0.5), atol=1e-6)


def test_shards_make_the_same_map(small_artefacts, checkpoint, in_windows, tmp_path):
    parts = []
    for k in range(3):
        parts.append(tmp_path / f"part{k}.h5")
        infer.run(small_artefacts["scene"], checkpoint, parts[-1], infer.Config(window=77, shard=(k, 3), **FULL))
        assert not parts[-1].with_suffix(".tif").exists()
    merge.run([parts[1], parts[2], parts[0]], tmp_path / "whole.h5")
    with rasterio.open(tmp_path / "whole.tif") as tiff:
        np.testing.assert_array_equal(tiff.read([1, 2, 3]), in_windows[0])
    with h5py.File(tmp_path / "whole.h5") as file:  # equal to the bit in equal windows
        np.testing.assert_array_equal(file["coefficients"][...], in_windows[0])
        np.testing.assert_array_equal(file["valid"][...].astype(bool), in_windows[1])
    with pytest.raises(ArtefactError, match="every shard"):
        merge.run(parts[:2], tmp_path / "two.h5")
    with h5py.File(parts[1], "r+") as file:  # a shard of another checkpoint of the same name
        inputs = json.loads(file.attrs["inputs"])
        inputs[0]["sha256"] = "0" * 64
        file.attrs["inputs"] = json.dumps(inputs)
    with pytest.raises(ArtefactError, match=r"part1.*made from, found others"):
        merge.run(parts, tmp_path / "mixed.h5")


@pytest.mark.parametrize("window", [None, 16, 77, 4000])
def test_windows_of_all_shards_cover_every_pixel_once(window):
    count = np.zeros((3000, 500), int)
    for k in range(3):
        for row, col, height, width in windows.list_windows(count.shape, infer.Config(window=window, shard=(k, 3)), 2):
            count[row : row + height, col : col + width] += 1
    assert (count == 1).all()


def test_wrong_inputs_are_refused(small_files, small_artefacts, checkpoint, tmp_path):
    coarse = tmp_path / "coarse.h5"
    ingest.run(small_files.dem, None, coarse, ingest.Config(gsd=60))
    with pytest.raises(ConfigError, match="`any_gsd`"):
        infer.run(coarse, checkpoint, tmp_path / "m.h5", infer.Config(**FULL))
    with pytest.raises(ArtefactError, match="expected a 'checkpoint'"):
        infer.run(small_artefacts["scene"], small_artefacts["pairs"], tmp_path / "m.h5", infer.Config(**FULL))
    with pytest.raises(ConfigError, match="`window`"):
        infer.run(small_artefacts["scene"], checkpoint, tmp_path / "m.h5", infer.Config(window=15, **FULL))
    assert not (tmp_path / "m.h5").exists()


def test_a_dem_with_nothing_at_its_edges(checkpoint, tmp_path):
    """Scene corners that a reprojection leaves empty: their values must not reach the map, in any window grid."""
    axis = (np.arange(300) - 149.5) * 20
    z = small_scene.height(axis[None, :], -axis[:, None]).astype(np.float32)
    z[:120, :150] = np.nan
    small_scene.write_raster(tmp_path / "dem.tif", z, small_scene.local_crs(), Affine(20, 0, -3000, 0, -20, 3000))
    ingest.run(tmp_path / "dem.tif", None, tmp_path / "s.h5", ingest.Config())
    one, valid = maps(tmp_path / "s.h5", checkpoint, tmp_path / "a.h5", window=512)
    two, _ = maps(tmp_path / "s.h5", checkpoint, tmp_path / "b.h5", window=80)
    np.testing.assert_array_equal(valid, np.isfinite(z))
    assert np.nanmax(np.abs(one - two)) < 1e-3 * np.nanstd(one[0])
