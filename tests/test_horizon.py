"""Horizon and cast shadow against closed forms: walls, domes, bowls, peaks beyond a curved horizon."""

from __future__ import annotations

import math

import numpy as np
import pytest

from schemas.errors import GeometryError
from stages.physics.horizon import cast_shadow, horizon, hulls

GSD = 5.0
AZIMUTHS_DEG = (0, 13, 45, 71, 90, 118, 135, 164, 180, 205, 225, 251, 270, 298, 315, 349)


@pytest.fixture(params=["one strip, serial", "many strips, parallel"])
def _strips(request, monkeypatch):
    """Both code paths on small grids: the parallel one with strips and blocks so small that many borders are crossed."""
    if request.param.startswith("many"):
        monkeypatch.setattr(hulls, "SMALL", 0)
        monkeypatch.setattr(hulls, "LINES", 38)


def _along(azimuth, shape):
    """Metres towards the azimuth of every pixel, from pixel (0, 0)."""
    row, col = np.mgrid[: shape[0], : shape[1]]
    return (col * math.sin(azimuth) - row * math.cos(azimuth)) * GSD


@pytest.mark.usefixtures("_strips")
@pytest.mark.parametrize("azimuth_deg", AZIMUTHS_DEG)
def test_wall(azimuth_deg):
    """Behind a thin straight wall of height h the horizon is atan(h / distance along the ray)."""
    azimuth = math.radians(azimuth_deg)
    n, wall, h = 121, 20, 30.0
    across = abs(math.sin(azimuth) / GSD) > abs(math.cos(azimuth) / GSD)  # wall along the columns or along the rows
    sign = math.sin(azimuth) if across else -math.cos(azimuth)
    at = n - 1 - wall if sign > 0 else wall
    z = np.zeros((n, n), np.float32)
    z[(slice(None), at) if across else at] = h
    row, col = np.mgrid[:n, :n]
    steps = np.abs((col if across else row) - at)
    lee = ((at - (col if across else row)) * sign > 0) & (steps > 0)
    major, minor = (math.sin(azimuth), -math.cos(azimuth)) if across else (-math.cos(azimuth), math.sin(azimuth))
    foot = (row if across else col) + steps * minor / abs(major)
    lee &= (foot >= 2) & (foot <= n - 3)  # nearer to the border, interpolation looks beyond it
    expected = np.arctan(h / (steps[lee] * GSD / abs(major)))
    angle = horizon(z, GSD, azimuth)
    np.testing.assert_allclose(angle[lee], expected, atol=2e-6)
    for sun_elevation in (0.1, 0.4):
        clear = np.abs(expected - sun_elevation) > 1e-5
        found = cast_shadow(z, GSD, azimuth, sun_elevation)[lee]
        np.testing.assert_array_equal(found[clear], (expected > sun_elevation)[clear])


@pytest.mark.usefixtures("_strips")
@pytest.mark.parametrize("azimuth_deg", AZIMUTHS_DEG)
def test_dome(azimuth_deg):
    """A spherical cap: in every vertical plane along the azimuth the sight line touches a circle."""
    azimuth = math.radians(azimuth_deg)
    n, radius, base = 201, 1500.0, 1450.0
    row, col = np.mgrid[:n, :n]
    x, y = (col - n // 2) * GSD, (n // 2 - row) * GSD
    z = np.maximum(np.sqrt(radius**2 - x**2 - y**2) - base, 0).astype(np.float32)
    distance = -(x * math.sin(azimuth) + y * math.cos(azimuth))  # of the circle's centre, from the plane before it
    aside = x * math.cos(azimuth) - y * math.sin(azimuth)
    foot = math.sqrt(radius**2 - base**2)
    in_front = (np.abs(aside) < 0.9 * foot) & (distance > 3 * GSD + np.sqrt(np.maximum(foot**2 - aside**2, 0)))
    distance, aside = distance[in_front], aside[in_front]
    circle = np.sqrt(radius**2 - aside**2)
    angle = np.arcsin(circle / np.hypot(distance, base)) - np.arctan2(base, distance)
    found = horizon(z, GSD, azimuth)[in_front]
    assert in_front.sum() > 3000
    error = found - angle
    # the grid cuts up to gsd^2 / 8 R = 2 mm off a dome that stands 50 m above the plane
    assert np.abs(error).max() < 8e-3  # near the foot, which the grid draws as a staircase
    assert np.abs(error).mean() < 2e-4


@pytest.mark.usefixtures("_strips")
@pytest.mark.parametrize("azimuth_deg", AZIMUTHS_DEG)
def test_bowl(azimuth_deg):
    """A spherical crater in a plain: from inside, the horizon is the rim of the circle cut by the vertical plane."""
    azimuth = math.radians(azimuth_deg)
    n, radius, rim = 161, 420.0, 300.0
    row, col = np.mgrid[:n, :n]
    x, y = (col - n // 2) * GSD, (n // 2 - row) * GSD
    depth = math.sqrt(radius**2 - rim**2)
    inside = np.hypot(x, y) < rim - 3 * GSD
    z = np.where(np.hypot(x, y) < rim, depth - np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)), 0).astype(np.float32)
    along = x * math.sin(azimuth) + y * math.cos(azimuth)
    aside = x * math.cos(azimuth) - y * math.sin(azimuth)
    along, aside = along[inside], aside[inside]
    expected = np.arctan(-z[inside] / (np.sqrt(rim**2 - aside**2) - along))
    found = horizon(z, GSD, azimuth)[inside]
    assert np.abs(found - expected).mean() < 4e-3  # the rim lies up to one pixel off its circle
    assert np.abs(found - expected).max() < 0.08
    area = cast_shadow(z, GSD, azimuth, math.radians(25))[inside].mean()
    assert area == pytest.approx((expected > math.radians(25)).mean(), abs=8e-3)


@pytest.mark.parametrize("azimuth_deg", AZIMUTHS_DEG)
def test_pixels_that_are_not_square(azimuth_deg):
    """An equirectangular map at 60 deg: columns are half as far apart as rows, azimuths and distances are true."""
    azimuth, gsd = math.radians(azimuth_deg), (5.0, 2.5)
    radius, base = 1500.0, 1450.0
    row, col = np.mgrid[:181, :361]
    x, y = (col - 180) * gsd[1], (90 - row) * gsd[0]
    z = np.maximum(np.sqrt(radius**2 - x**2 - y**2) - base, 0).astype(np.float32)
    distance = -(x * math.sin(azimuth) + y * math.cos(azimuth))
    aside = x * math.cos(azimuth) - y * math.sin(azimuth)
    foot = math.sqrt(radius**2 - base**2)
    in_front = (np.abs(aside) < 0.9 * foot) & (distance > 15 + np.sqrt(np.maximum(foot**2 - aside**2, 0)))
    distance, circle = distance[in_front], np.sqrt(radius**2 - aside[in_front] ** 2)
    expected = np.arcsin(circle / np.hypot(distance, base)) - np.arctan2(base, distance)
    error = horizon(z, gsd, azimuth)[in_front] - expected
    assert np.abs(error).max() < 1.2e-2
    assert np.abs(error).mean() < 3e-4
    dark = cast_shadow(z, gsd, azimuth, 0.1)[in_front]
    assert (dark != (expected > 0.1)).mean() < 0.01


@pytest.mark.usefixtures("_strips")
@pytest.mark.parametrize("quarter", range(4))
def test_turning_the_ground_turns_the_answer(rng, quarter):
    z = np.cumsum(np.cumsum(rng.normal(size=(150, 97)), 0), 1).astype(np.float32) * 0.05
    for azimuth in (0.3, 0.7, 1.2):
        turned = np.ascontiguousarray(np.rot90(z, -quarter))  # clockwise
        expected = np.rot90(horizon(z, GSD, azimuth), -quarter)
        difference = np.abs(horizon(turned, GSD, azimuth + quarter * math.pi / 2) - expected)
        assert difference.mean() < 1e-3  # not 0: mirrored, the lines pass elsewhere between the pixels
        assert (difference < 1e-5).mean() > 0.6
        dark = np.rot90(cast_shadow(z, GSD, azimuth, 0.2), -quarter)
        assert (cast_shadow(turned, GSD, azimuth + quarter * math.pi / 2, 0.2) != dark).mean() < 1e-3


@pytest.mark.parametrize("azimuth_deg", (0, 30, 90, 200, 285))
def test_curvature_hides_a_distant_peak(azimuth_deg):
    """A peak of height h at distance d stands at h / d - d / 2R; the plain before it sinks."""
    azimuth, radius, h = math.radians(azimuth_deg), 20_000.0, 60.0
    n = 301
    z = np.zeros((n, n), np.float32)
    peak = (round(150 - 140 * math.cos(azimuth)), round(150 + 140 * math.sin(azimuth)))
    z[peak[0] - 6 : peak[0] + 7, peak[1] - 6 : peak[1] + 7] = h  # broad enough for every ray
    exact = math.atan2(peak[1] - 150, 150 - peak[0])
    for steps in (0, 40, 90):  # observers between the centre and the peak
        share = steps / 140
        row, col = round(150 + share * (peak[0] - 150)), round(150 + share * (peak[1] - 150))
        angle = horizon(z, GSD, exact, radius)[row, col]
        d = math.hypot(peak[0] - row, peak[1] - col) * GSD
        nearest, farthest = h / (d - 9 * GSD) - (d - 9 * GSD) / 2 / radius, h / d - d / 2 / radius
        assert farthest - 1e-4 <= math.tan(angle) <= nearest + 1e-4
        # the Sun's rays are parallel in space: it stands higher towards the Sun by the arc
        towards = _along(exact, z.shape)
        local = towards[row, col] - towards[150, 150]
        for offset in (-0.01, 0.01):
            sun = math.atan(math.tan(angle) - local / radius + offset)
            assert cast_shadow(z, GSD, exact, sun, radius)[row, col] == (offset < 0)


def test_a_plain_on_a_sphere_falls_away(rng):
    angle = horizon(np.zeros((64, 64), np.float32), 100.0, 0.4, 1.0e6)
    inner = angle[8:, :-8]
    assert np.all(inner < 0)
    np.testing.assert_allclose(inner, -100.0 / math.cos(0.4) / 2e6, atol=1e-6)  # the nearest terrain is the highest


@pytest.mark.usefixtures("_strips")
@pytest.mark.parametrize("azimuth", (0.0, 0.6, 2.0, 4.4))
def test_where_there_is_no_terrain(azimuth):
    z = np.zeros((90, 80), np.float32)
    z[40:50, 30:45] = np.nan
    angle, dark = horizon(z, GSD, azimuth), cast_shadow(z, GSD, azimuth, 0.1)
    assert np.array_equal(np.isnan(angle), np.isnan(z))
    assert not dark.any()
    known = angle[~np.isnan(z)]
    edge = known < -1.5
    np.testing.assert_allclose(known[edge], -math.pi / 2, atol=1e-6)
    np.testing.assert_allclose(known[~edge], 0.0, atol=1e-6)
    assert 80 <= edge.sum() <= 80 + 90 + 30  # the Sun-side border of the grid, and of the hole at some corners
    z[:, :] = np.nan
    assert np.isnan(horizon(z, GSD, azimuth)).all()
    assert not cast_shadow(z, GSD, azimuth, 0.1).any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 3), (7, 300), (300, 7)])
def test_any_shape(rng, shape):
    z = rng.normal(size=shape).astype(np.float32)
    for azimuth in np.radians(AZIMUTHS_DEG):
        angle = horizon(z, GSD, azimuth)
        assert angle.shape == shape
        assert np.isfinite(angle).all()
        assert cast_shadow(z, GSD, azimuth, 0.1).shape == shape


@pytest.mark.parametrize(
    "change",
    [
        {"elevation": np.zeros(5)},
        {"gsd": 0.0},
        {"gsd": math.nan},
        {"azimuth": math.inf},
        {"body_radius": -1.0},
        {"sun_elevation": 45.0},
    ],
)
def test_bad_input_is_named(change):
    arguments = {"elevation": np.zeros((4, 4)), "gsd": 1.0, "azimuth": 0.0, "sun_elevation": 0.1} | change
    with pytest.raises(GeometryError, match=next(iter(change))):
        cast_shadow(**arguments)
