"""Rays against closed forms and against Mitsuba (Embree's peer) on the same height field."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rasterio.transform import Affine
from relief import RADIUS, body_point, hills, metric_grid

from schemas.errors import GeometryError
from stages.physics.maps.grid import Grid, sphere_crs, unit_vectors
from stages.render.chart import TOLERANCE, chart_position, fit_chart
from stages.render.ray_points import hit_angles, hit_points, sample_maps
from stages.render.raycast import BELOW, HIT, MISS, build_height_field, cast


def square_grid(size: int, gsd: float, lon: float = 12.0, lat: float = -34.0) -> Grid:
    return metric_grid(size, size, gsd, lon, lat)


def fan(grid: Grid, row: float, col: float, altitude: float, towards: tuple[float, float], fov: float, n: int):
    """Origin and n x n directions of a camera over (row, col) that looks at another (row, col)."""
    origin = body_point(grid, row, col, altitude)
    forward = body_point(grid, *towards, 0.0) - origin
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, grid.local_frames(row, col).axes[0][1] + 1e-3 * grid.local_frames(row, col).axes[0][0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    a = np.linspace(-1, 1, n) * math.tan(fov / 2)
    u, v = (w.ravel()[:, None] for w in np.meshgrid(a, a))
    directions = forward + u * right + v * down
    return origin[None], directions / np.linalg.norm(directions, axis=1, keepdims=True)


def bilinear(z: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    i, j = np.clip(np.floor(col).astype(int), 0, z.shape[1] - 2), np.clip(np.floor(row).astype(int), 0, z.shape[0] - 2)
    u, v = col - i, row - j
    return (z[j, i] * (1 - u) + z[j, i + 1] * u) * (1 - v) + (z[j + 1, i] * (1 - u) + z[j + 1, i + 1] * u) * v


def test_a_bare_sphere_is_hit_where_the_quadratic_formula_says():
    grid = square_grid(400, 50.0)
    field = build_height_field(np.full((400, 400), 120.0, np.float32), grid)
    for towards in ((200, 200), (120, 260), (20, 200)):
        origin, directions = fan(grid, 200, 200, 9000.0, towards, 0.5, 41)
        hits = cast(field, origin, directions)
        b = (origin * directions).sum(1)
        expected = -b - np.sqrt(b * b - (origin**2).sum() + (RADIUS + 120.0) ** 2)
        met = hits.status == HIT
        assert met.mean() > 0.5
        np.testing.assert_allclose(hits.depth[met], expected[met], atol=5e-3)
        points = hit_points(hits, origin, directions)[met]
        up = points / np.linalg.norm(points, axis=1, keepdims=True)
        # the normal is the sphere's: a Sun 45 deg high in the east, then in the north, would show a tilt of 1e-3 deg
        for axis in grid.local_frames(200, 200).axes[0][:2]:
            sun = up[len(up) // 2] + axis
            sun /= np.linalg.norm(sun)
            cosine = hit_angles(field, origin, directions, hits, sun * 1e15).cos_incidence[met]
            np.testing.assert_allclose(cosine, up @ sun, atol=1.5e-5)


@pytest.mark.parametrize(
    ("altitude", "towards", "fov"), [(20e3, (256, 256), 0.06), (3e3, (100, 256), 0.5), (900.0, (30, 400), 0.7)]
)
def test_hits_lie_on_the_bilinear_surface_of_the_projected_grid(rng, altitude, towards, fov):
    grid = square_grid(512, 5.0)
    z = hills(rng, 512, 5.0)
    field = build_height_field(z, grid)
    origin, directions = fan(grid, 256, 256, altitude + float(z.max()), towards, fov, 101)
    hits = cast(field, origin, directions)
    met = hits.status == HIT
    assert met.mean() > 0.3
    points = hit_points(hits, origin, directions)[met]
    r = np.linalg.norm(points, axis=1)
    # the projection library, not the chart, says where these points are
    row, col = grid.rowcol_of_lonlat(
        np.degrees(np.arctan2(points[:, 1], points[:, 0])), np.degrees(np.arcsin(points[:, 2] / r))
    )
    np.testing.assert_allclose(row, hits.row[met], atol=0.01)
    np.testing.assert_allclose(col, hits.col[met], atol=0.01)
    np.testing.assert_allclose(r - RADIUS, bilinear(z, row, col), atol=0.02)


def test_no_ray_skips_a_surface_that_a_dense_march_finds(rng):
    """The pyramid must never hide a ridge: march along grazing rays in quarter-pixel steps instead."""
    grid = square_grid(128, 10.0)
    z = hills(rng, 128, 10.0, steepness=0.6)
    field = build_height_field(z, grid)
    start = float(bilinear(z, np.array([120.0]), np.array([64.0]))[0]) + 3.0
    origin, directions = fan(grid, 120, 64, start, (60, 64), 1.2, 25)
    hits = cast(field, origin, directions)
    for n in range(len(directions)):
        t = np.arange(0.0, 1600.0, 2.5)
        points = origin + t[:, None] * directions[n]
        r = np.linalg.norm(points, axis=1)
        row, col = grid.rowcol_of_lonlat(
            np.degrees(np.arctan2(points[:, 1], points[:, 0])), np.degrees(np.arcsin(points[:, 2] / r))
        )
        inside = (row >= 0) & (col >= 0) & (row <= 127) & (col <= 127)
        under = inside & (r - RADIUS < bilinear(z, np.clip(row, 0, 127), np.clip(col, 0, 127)))
        if under.any():
            first = t[np.argmax(under)]
            assert hits.status[n] == HIT
            assert first - 2.6 <= hits.depth[n] + 0.1 and hits.depth[n] <= first + 0.1
        elif hits.status[n] == HIT:  # a graze between two steps of the march
            assert hits.depth[n] < 1600.0


def test_holes_and_edges_are_unknown_not_seen_through(rng):
    grid = square_grid(128, 10.0)
    z = hills(rng, 128, 10.0)
    z[40:60, 40:60] = np.nan
    field = build_height_field(z, grid)
    origin, directions = fan(grid, 64, 64, 6000.0, (50, 50), 0.01, 21)
    assert (cast(field, origin, directions).status != HIT).all()
    # from the side and below the rim of the scene: comes in under the surface
    z[:] = 500.0
    field = build_height_field(z, grid)
    outside = body_point(grid, 64, -60, 300.0)
    towards = body_point(grid, 64, 64, 300.0) - outside
    hits = cast(field, outside[None], (towards / np.linalg.norm(towards))[None])
    assert hits.status[0] in (BELOW, MISS)
    assert np.isnan(hits.depth[0])


@pytest.mark.parametrize("place", [(0.0, 0.0), (150.0, 60.0), (10.0, 89.9), (-70.0, -90.0)])
def test_the_chart_agrees_with_the_projection(rng, place):
    grid = square_grid(2000, 100.0, *place)
    chart = fit_chart(grid)
    row, col = rng.uniform(-0.5, 1999.5, (2, 400))
    local = chart.to_local(unit_vectors(*grid.lonlat(row, col)))
    found = np.array([chart_position(chart.forward, x / w / chart.scale, y / w / chart.scale) for x, y, w in local])
    np.testing.assert_allclose(found, np.stack([col, row], 1), atol=TOLERANCE)


def test_half_the_body_is_too_much_for_one_chart():
    wkt = sphere_crs(RADIUS).to_wkt()
    whole = Grid(wkt, Affine(1.0, 0, -180.0, 0, -1.0, 90.0), 180, 360, RADIUS)
    with pytest.raises(GeometryError, match="crop it"):
        fit_chart(whole)


def test_angles_of_a_plane_are_those_of_its_normal(rng):
    """On a tilted plane small enough to be flat, incidence follows from slope and Sun alone."""
    grid = square_grid(64, 1.0)
    east, north = 0.3, -0.2
    c = np.arange(64.0) - 31.5
    z = (c[None, :] * east - c[:, None] * north).astype(np.float32)
    field = build_height_field(z, grid)
    origin, directions = fan(grid, 31.5, 31.5, 3000.0, (31.5, 31.5), 0.005, 9)
    hits = cast(field, origin, directions)
    assert (hits.status == HIT).all()
    axes = grid.local_frames(31.5, 31.5).axes[0]
    sun_local = np.array([0.5, 0.4, 0.7]) / np.linalg.norm([0.5, 0.4, 0.7])
    sun = axes[2] * RADIUS + sun_local @ axes * 1.5e11
    found = hit_angles(field, origin, directions, hits, sun)
    normal = np.array([-east, -north, 1.0]) / math.sqrt(1 + east**2 + north**2)
    np.testing.assert_allclose(found.cos_incidence, normal @ sun_local, atol=1e-4)
    np.testing.assert_allclose(found.cos_emission, -(directions @ axes.T) @ normal, atol=1e-4)
    np.testing.assert_allclose(np.cos(found.phase), -(directions @ axes.T) @ sun_local, atol=1e-6)
    np.testing.assert_allclose(found.sun_elevation, math.asin(sun_local[2]), atol=1e-4)


def test_samples_ignore_unknown_pixels():
    grid = square_grid(16, 1.0)
    field = build_height_field(np.zeros((16, 16), np.float32), grid)
    origin, directions = fan(grid, 7.25, 7.5, 500.0, (7.25, 7.5), 1e-6, 1)
    hits = cast(field, origin, directions)
    ramp = np.tile(np.arange(16, dtype=np.float32), (16, 1))
    holed = ramp.copy()
    holed[:, 8] = np.nan
    values = sample_maps(np.stack([ramp, ramp.T, holed, np.full_like(ramp, np.nan)]), hits.row, hits.col)[:, 0]
    np.testing.assert_allclose(values[:3], [7.5, 7.25, 7.0], atol=2e-3)
    assert np.isnan(values[3])
