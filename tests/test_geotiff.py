"""Overviews of maps: means of what is known, down to one block, whatever the map's size."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import rasterio

from stages.physics import geotiff
from stages.physics.geotiff import _overviews, _write_levels, halve


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


@pytest.mark.parametrize("columns", [512, 8192])
def test_every_level_is_half_of_the_one_before(tmp_path, rng, monkeypatch, columns):
    monkeypatch.setattr(geotiff, "COLUMNS", columns)
    values = rng.normal(size=(2, 1100, 700)).astype(np.float32)
    levels = [tmp_path / f"{k}.tif" for k in range(_overviews(1100, 700) + 1)]
    _write_levels(levels, 1100, 700, 2, lambda piece: values[(slice(None), *piece.toslices())])
    shapes = []
    for level in levels:
        with rasterio.open(level) as file:
            found = file.read()
        shapes.append(found.shape[1:])
        np.testing.assert_allclose(found, values, rtol=1e-6)
        values = np.empty((2, -(-found.shape[1] // 2), -(-found.shape[2] // 2)), np.float32)
        halve(found, values)
    assert shapes == [(1100, 700), (550, 350), (275, 175), (138, 88)]
