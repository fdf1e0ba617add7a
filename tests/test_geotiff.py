"""Overviews of maps: means of what is known, down to one block, whatever the map's size."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import rasterio
import small_scene
from rasterio.transform import Affine

from stages.physics.maps.geotiff import MapTiff
from stages.physics.maps.grid import Grid

ATTRIBUTES = {"model": "M2", "quantity": "I/F", "gsd_m": 5.0, "body_radius_m": 1737400.0}


def grid_of(height, width):
    return Grid(small_scene.local_crs().to_wkt(), Affine(5, 0, 100, 0, -5, 200), height, width, 1737400.0)


@pytest.fixture
def relief(rng):
    values = rng.normal(size=(2, 1088, 4736)).astype(np.float32)
    values[:, 300:700, :900] = np.nan
    return values


def means(values):
    """Of what is known in squares of 2 x 2, all of them whole: (C, H, W) -> (C, H / 2, W / 2)."""
    count, height, width = values.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # squares of which nothing is known
        return np.nanmean(values.reshape(count, height // 2, 2, width // 2, 2), axis=(2, 4))


@pytest.mark.parametrize("rows, columns", [(64, 4736), (100, 2050), (1088, 808)])
def test_a_map_is_cloud_optimised_with_means_for_overviews_whatever_the_pieces(tmp_path, relief, rows, columns):
    path, (_, height, width) = tmp_path / "map.tif", relief.shape
    with MapTiff(path, grid_of(height, width), ["w0", "w1"], ATTRIBUTES) as tiff:
        for c in range(0, width, columns):
            for r in range(0, height, rows):
                tiff.put(r, c, relief[:, r : r + rows, c : c + columns])
    assert [p.name for p in tmp_path.iterdir()] == ["map.tif"]
    with rasterio.open(path) as file:
        assert file.overviews(1) == [2, 4, 8, 16, 32]
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.tags(ns="IMAGE_STRUCTURE")["COMPRESSION"] == "ZSTD"
        assert file.block_shapes == [(256, 256)] * 2 and file.tags()["model"] == "M2"
        assert file.descriptions == ("w0", "w1")
        assert file.transform == Affine(5, 0, 100, 0, -5, 200)
        np.testing.assert_array_equal(file.read(), relief)
    values = relief
    for level in range(5):
        values = means(values)
        with rasterio.open(path, overview_level=level) as file:
            np.testing.assert_allclose(file.read(), values, rtol=1e-4, atol=1e-6)


def test_what_is_never_written_is_unknown(tmp_path, relief):
    path, (_, height, width) = tmp_path / "map.tif", relief.shape
    with MapTiff(path, grid_of(height, width), ["w0", "w1"], ATTRIBUTES) as tiff:
        tiff.put(768, 1024, relief[:, 768:1024, 1024:1536])
    with rasterio.open(path) as file:
        found = file.read()
    np.testing.assert_array_equal(found[:, 768:1024, 1024:1536], relief[:, 768:1024, 1024:1536])
    assert np.isnan(found).sum() == found.size - 2 * 256 * 512


def test_an_error_leaves_no_level_behind(tmp_path, relief):
    with (
        pytest.raises(ValueError),
        MapTiff(tmp_path / "map.tif", grid_of(1088, 4736), ["w0", "w1"], ATTRIBUTES) as tiff,
    ):
        tiff.put(0, 0, relief[:, :256, :256])
        raise ValueError
    assert not list(tmp_path.iterdir())
