"""Overviews of maps: means of what is known, down to one block, whatever the map's size."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
import rasterio
import small_scene
from rasterio.transform import Affine

from stages.physics.maps import cog
from stages.physics.maps.geotiff import MapTiff, halve, halved
from stages.physics.maps.grid import Grid

ATTRIBUTES = {"model": "M2", "quantity": "I/F", "gsd_m": 5.0, "body_radius_m": 1737400.0}


@pytest.mark.parametrize("shape", [(6, 8), (7, 5), (1, 3)])
def test_halving_is_the_mean_of_what_is_known(shape, rng):
    values = rng.normal(size=(2, *shape)).astype(np.float32)
    values[:, rng.random(shape) < 0.4] = np.nan
    out = np.empty((2, -(-shape[0] // 2), -(-shape[1] // 2)), np.float32)
    halve(values, out)
    even = np.pad(values, ((0, 0), (0, shape[0] % 2), (0, shape[1] % 2)), constant_values=np.nan)
    squares = even.reshape(2, out.shape[1], 2, out.shape[2], 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # squares of which nothing is known
        np.testing.assert_allclose(out, np.nanmean(squares, axis=(2, 4)), rtol=1e-5, atol=1e-6)


def grid_of(height, width):
    return Grid(small_scene.local_crs().to_wkt(), Affine(5, 0, 100, 0, -5, 200), height, width, 1737400.0)


@pytest.fixture
def relief(rng):
    values = rng.normal(size=(2, 1100, 4700)).astype(np.float32)
    values[:, 300:700, :900] = np.nan
    return values


@pytest.mark.parametrize("rows, columns", [(64, 4700), (256, 2048), (1100, 808)])
@pytest.mark.parametrize("big", [False, True])
def test_every_level_is_half_of_the_one_before_whatever_the_pieces(tmp_path, relief, monkeypatch, rows, columns, big):
    if big:
        monkeypatch.setattr(cog, "CLASSIC", 0)
    path, (_, height, width) = tmp_path / "map.tif", relief.shape
    with MapTiff(path, grid_of(height, width), ["w0", "w1"], ATTRIBUTES) as tiff:
        for c in range(0, width, columns):
            for r in range(0, height, rows):
                tiff.put(r, c, relief[:, r : r + rows, c : c + columns])
    assert [p.name for p in tmp_path.iterdir()] == ["map.tif"]
    assert struct.unpack("<2xH", path.read_bytes()[:4])[0] == (43 if big else 42)
    with rasterio.open(path) as file:
        assert file.overviews(1) == [2, 4, 8, 16, 32]
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.descriptions == ("w0", "w1")
        assert file.transform == Affine(5, 0, 100, 0, -5, 200)
        np.testing.assert_array_equal(file.read(), relief)
    values = relief
    for level in range(5):
        values = halved(values)
        with rasterio.open(path, overview_level=level) as file:
            np.testing.assert_array_equal(file.read(), values)


def test_tiles_stand_as_a_cloud_optimised_file_has_them(tmp_path, relief):
    """Directories, then the tiles of the smallest level first, each between its size and its last bytes."""
    path, (_, height, width) = tmp_path / "map.tif", relief.shape
    with MapTiff(path, grid_of(height, width), ["w0", "w1"], ATTRIBUTES) as tiff:
        tiff.put(768, 1024, relief[:, 768:1024, 1024:1536])  # and nothing else
    data, starts, place = path.read_bytes(), [], struct.unpack("<4xI", path.read_bytes()[:8])[0]
    while place:
        entries = struct.unpack_from("<H", data, place)[0]
        tags = {t[0]: t for t in struct.iter_unpack("<HHII", data[place + 2 : place + 2 + 12 * entries])}
        place = struct.unpack_from("<I", data, place + 2 + 12 * entries)[0]
        tiles = []
        for code in (cog.TILE_OFFSETS, cog.TILE_COUNTS):
            _, _, count, value = tags[code]
            tiles.append([value] if count == 1 else struct.unpack_from(f"<{count}I", data, value))
        for offset, count in zip(*tiles, strict=True):
            assert struct.unpack_from("<I", data, offset - 4)[0] == count
            assert data[offset + count - 4 : offset + count] == data[offset + count : offset + count + 4]
        assert list(tiles[0]) == sorted(tiles[0])
        starts.append(tiles[0][0])
    assert starts == sorted(starts, reverse=True)
    with rasterio.open(path) as file:
        found = file.read()
    np.testing.assert_array_equal(found[:, 768:1024, 1024:1536], relief[:, 768:1024, 1024:1536])
    assert np.isnan(found).sum() == found.size - 2 * 256 * 512


def test_an_error_leaves_no_level_behind(tmp_path, relief):
    with (
        pytest.raises(ValueError),
        MapTiff(tmp_path / "map.tif", grid_of(1100, 4700), ["w0", "w1"], ATTRIBUTES) as tiff,
    ):
        tiff.put(0, 0, relief[:, :256, :256])
        raise ValueError
    assert not list(tmp_path.iterdir())
