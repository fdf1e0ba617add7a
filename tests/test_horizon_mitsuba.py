"""Cast shadow and horizon against Embree (through Mitsuba) on the same elevations, split into triangles both ways."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stages.physics.horizon import cast_shadow, horizon

mi = pytest.importorskip("mitsuba", reason="the test extra brings mitsuba")
GSD = 5.0


@pytest.fixture(scope="module", autouse=True)
def _variant():
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    yield
    if before:
        mi.set_variant(before)


def _mesh(z, diagonal):
    """Triangles over the pixel centres; every cell is split along one diagonal or the other."""
    height, width = z.shape
    row, col = np.mgrid[:height, :width]
    a = (row * width + col)[:-1, :-1].ravel()
    b, c, d = a + 1, a + width, a + width + 1
    split = ((a, c, d), (a, d, b)) if diagonal else ((a, c, b), (b, c, d))
    faces = np.concatenate([np.stack(t, 1) for t in split])
    mesh = mi.Mesh("terrain", vertex_count=z.size, face_count=len(faces))
    parameters = mi.traverse(mesh)
    vertices = np.stack([col * GSD, -row * GSD, z], -1).reshape(-1)
    parameters["vertex_positions"] = mi.Float(vertices.astype(np.float32))
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters.update()
    return mi.load_dict({"type": "scene", "terrain": mesh})


def _ray_traced(scene, z, azimuth, elevation):
    row, col = np.mgrid[: z.shape[0], : z.shape[1]]
    origin = mi.Point3f(*(np.ravel(v).astype(np.float32) for v in (col * GSD, -row * GSD, z + 1e-3)))
    sun = (math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation))
    return np.array(scene.ray_test(mi.Ray3f(origin, mi.Vector3f(*sun)))).reshape(z.shape)


@pytest.mark.parametrize("blur_px", [0.0, 1.5, 3.0])
@pytest.mark.parametrize("azimuth_deg", [20, 55, 125, 160, 215, 245, 290, 330])
def test_closer_to_a_ray_tracer_than_its_own_choice_of_diagonals(rng, blur_px, azimuth_deg):
    n = 256
    spectrum = np.fft.rfft2(rng.normal(size=(n, n)))
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None])
    frequency[0, 0] = np.inf
    z = np.fft.irfft2(spectrum * frequency**-1.8, s=(n, n))
    z *= 0.3 * GSD / np.hypot(*np.gradient(z)).std()
    if blur_px:
        z = gaussian_filter(z, blur_px)
    z = z.astype(np.float32)
    azimuth = math.radians(azimuth_deg)
    scenes = [_mesh(z, diagonal) for diagonal in (False, True)]
    angle = horizon(z, GSD, azimuth)
    floor, shadow_differs, horizon_differs = 0.0, np.zeros(2), np.zeros(2)
    for elevation_deg in (4, 9, 16):
        elevation = math.radians(elevation_deg)
        traced = [_ray_traced(scene, z, azimuth, elevation) for scene in scenes]
        floor += (traced[0] != traced[1]).mean() / 3
        dark = cast_shadow(z, GSD, azimuth, elevation)
        shadow_differs += [(dark != t).mean() / 3 for t in traced]
        horizon_differs += [((angle > elevation) != t).mean() / 3 for t in traced]
    assert 1e-4 < floor < 0.06
    assert shadow_differs.max() < floor
    assert horizon_differs.max() < floor


def test_a_sun_along_the_grid_agrees(rng):
    """Along rows and columns both splits and the sweep see the same crossings.

    The Sun stands 1e-4 rad beside the axis: exactly along it, Embree's rays slip between triangles (up to 12 %).
    """
    z = gaussian_filter(rng.normal(size=(120, 130)) * 30, 2).astype(np.float32)
    scene = _mesh(z, True)
    for azimuth_deg in (0, 90, 180, 270):
        azimuth = math.radians(azimuth_deg) + 1e-4
        differs = cast_shadow(z, GSD, azimuth, 0.2) != _ray_traced(scene, z, azimuth, 0.2)
        assert differs[1:-1, 1:-1].mean() < 3e-3
