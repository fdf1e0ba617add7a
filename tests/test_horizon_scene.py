"""The horizon of a crop from the whole scene: as from one sweep over everything, without ever reading everything."""

from __future__ import annotations

import math

import numpy as np
import pytest

from schemas.errors import GeometryError
from stages.physics.horizon import horizon, horizon_in_scene, make_overview
from stages.physics.maps.window import Window

GSD = 5.0


class Counting:
    """A scene that remembers the largest window that was read from it."""

    def __init__(self, z):
        self.z, self.shape, self.largest = z, z.shape, 0

    def __getitem__(self, key):
        window = self.z[key]
        self.largest = max(self.largest, window.size)
        return window


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(5)
    n = 1800
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None])
    frequency[0, 0] = np.inf
    z = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(n, n))) * frequency**-1.9, s=(n, n))
    return (z * 0.15 * GSD / np.gradient(z, axis=0).std()).astype(np.float32)


@pytest.mark.parametrize("body_radius", [None, 1737400.0])
@pytest.mark.parametrize("azimuth_deg", [0, 30, 90, 160, 225, 300])
def test_crops_see_the_whole_scene(scene, azimuth_deg, body_radius):
    azimuth = math.radians(azimuth_deg)
    whole = horizon(scene, GSD, azimuth, body_radius)
    counting = Counting(scene)
    overview = make_overview(counting, 4, rows_at_once=64)
    counting.largest = 0
    rng = np.random.default_rng(azimuth_deg)
    error, alone = [], []
    for row, col in rng.integers(0, 1800 - 96, (6, 2)):
        found = horizon_in_scene(counting, overview, Window(row, col, 96, 96), GSD, azimuth, body_radius=body_radius)
        expected = whole[row : row + 96, col : col + 96]
        assert found.shape == (96, 96)
        assert found.dtype == np.float32
        crop = horizon(scene[row : row + 96, col : col + 96], GSD, azimuth, body_radius)
        here = (expected > -1.5) & (found > -1.5)
        assert ((expected > -1.5) == (found > -1.5)).mean() > 0.99
        error.append((found - expected)[here])
        alone.append((crop - expected)[here])
    error = np.degrees(np.concatenate(error))
    assert np.abs(error).mean() < 0.04
    assert np.sqrt((error**2).mean()) < 0.12
    assert np.abs(np.concatenate(alone)).mean() > math.radians(1)  # what a crop alone would miss
    assert counting.largest <= (96 + overview.near_px) ** 2


def test_a_distant_wall_is_found_through_the_overview():
    z = np.zeros((2000, 300), np.float32)
    z[100:140] = 200.0
    overview = make_overview(z, 4)
    row = 1500
    found = horizon_in_scene(z, overview, Window(row, 100, 64, 64), GSD, 0.0)
    distance = (row + np.arange(64) - 139)[:, None] * GSD
    np.testing.assert_allclose(found, np.broadcast_to(np.arctan(200.0 / distance), (64, 64)), rtol=0.012)
    curved = horizon_in_scene(z, overview, Window(row, 100, 64, 64), GSD, 0.0, body_radius=400_000.0)
    expected = np.arctan(200.0 / distance - distance / 8e5)
    np.testing.assert_allclose(curved, np.broadcast_to(expected, (64, 64)), rtol=0.015)


def test_a_high_sun_spares_the_search_and_keeps_the_shadow(scene):
    overview = make_overview(scene, 4)
    azimuth, sun = math.radians(70), math.radians(12)
    full = horizon_in_scene(scene, overview, Window(800, 700, 64, 64), GSD, azimuth)
    quick = horizon_in_scene(scene, overview, Window(800, 700, 64, 64), GSD, azimuth, sun_elevation=sun)
    near_sun = full > sun - math.radians(0.9)
    np.testing.assert_allclose(quick[near_sun], full[near_sun], atol=math.radians(0.2))
    assert ((quick > sun) == (full > sun)).mean() > 0.999


def test_missing_ground(scene):
    z = scene.copy()
    z[300:340, 500:620] = np.nan
    z[900:1000] = np.nan
    overview = make_overview(z, 4)
    found = horizon_in_scene(z, overview, Window(310, 480, 64, 64), GSD, 2.0)
    assert np.array_equal(np.isnan(found), np.isnan(z[310:374, 480:544]))


@pytest.mark.parametrize(
    ("row", "shape", "message"), [(-1, (200, 200), "crop"), (190, (200, 200), "crop"), (0, (100, 200), "overview")]
)
def test_bad_input_is_named(row, shape, message):
    overview = make_overview(np.zeros((200, 200), np.float32), 4)
    with pytest.raises(GeometryError, match=message):
        horizon_in_scene(np.zeros(shape, np.float32), overview, Window(row, 0, 64, 64), GSD, 0.0)
