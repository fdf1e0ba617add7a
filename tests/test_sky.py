"""Sky view, light from the terrain, penumbra and earthshine against closed forms, quadrature and a path tracer."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from schemas.errors import GeometryError
from stages.physics.formation.chain import Observation, form
from stages.physics.horizon import horizon
from stages.physics.light.earth import earth_irradiance
from stages.physics.light.sky import terrain_light
from stages.physics.light.sun_disc import SUN_RADIUS, sun_visibility
from stages.physics.photometry import get_model

GSD = 5.0


def _bowl(n=161, radius=420.0, rim=300.0):
    """A spherical crater in a plain; elevation, distance from its centre and its share of the sphere, h / 2 R."""
    row, col = np.mgrid[:n, :n]
    away = np.hypot((col - n // 2) * GSD, (row - n // 2) * GSD)
    level = math.sqrt(radius**2 - rim**2)
    z = np.where(away < rim, level - np.sqrt(np.maximum(radius**2 - away**2, 0)), 0).astype(np.float32)
    return z, away, (radius - level) / (2 * radius)


def sky_view(z, azimuths=32):
    return terrain_light(z, np.zeros_like(z), GSD, azimuths=azimuths)[1]


def test_sky_view_of_a_spherical_bowl_is_the_same_everywhere():
    """Any two patches of a sphere see each other alike, so the cap hides h / 2 R of the light from all its facets."""
    z, away, share = _bowl()
    view = sky_view(z)
    inside = away < 270
    assert np.abs(view[inside] - (1 - share)).max() < 0.02
    assert view[inside].mean() == pytest.approx(1 - share, abs=0.003)
    assert view[2, 2] == pytest.approx(1.0, abs=1e-4)


def test_sky_view_of_a_plane_is_whole():
    row, col = np.mgrid[:60, :70]
    z = ((0.3 * col - 0.2 * row) * GSD).astype(np.float32)
    np.testing.assert_allclose(sky_view(z)[3:-3, 3:-3], 1.0, atol=1e-4)


def test_sky_view_keeps_what_is_missing():
    z, _, _ = _bowl(81)
    z[10:20, 30:40] = np.nan
    view = sky_view(z, 8)
    assert np.isnan(view[11:19, 31:39]).all()
    assert np.isfinite(view[30:60, 30:60]).all()


def test_terrain_light_of_a_spherical_bowl(rng):
    """However unevenly the bowl shines, every facet of it receives the mean over the sphere."""
    z, away, share = _bowl()
    patches = gaussian_filter(rng.normal(size=z.shape), 12)
    bright = (0.3 + patches / np.abs(patches).max() * 0.25).astype(np.float32)
    east, north = np.gradient(z, GSD)
    area = np.sqrt(1 + east**2 + north**2)  # of a facet over its pixel
    area[away >= 300] = 0
    expected = share * (bright * area).sum() / area.sum()
    light = terrain_light(z, bright, GSD)[0][away < 250]
    assert light.mean() == pytest.approx(expected, rel=0.03)
    assert np.abs(light - expected).max() < 0.12 * expected


def _path_traced(mi, z, albedo, sun, path):
    """I/F from straight above: radiance under an irradiance of pi, up to eight bounces."""
    n = len(z)
    row, col = np.mgrid[:n, :n]
    a = (row * n + col)[:-1, :-1].ravel()
    faces = np.concatenate([np.stack(t, 1) for t in ((a, a + n, a + n + 1), (a, a + n + 1, a + 1))])
    mesh = mi.Mesh("crater", n * n, len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.stack([col * GSD, -row * GSD, z], -1).astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    mesh.write_ply(str(path))
    middle, half = (n - 1) / 2 * GSD, n / 2 * GSD
    above = mi.ScalarTransform4f().look_at(
        origin=[middle, -middle, 500.0], target=[middle, -middle, 0.0], up=[0.0, 1.0, 0.0]
    )
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 9, "rr_depth": 100, "hide_emitters": True},
            "crater": {
                "type": "ply",
                "filename": str(path),
                "face_normals": True,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
            },
            "sun": {
                "type": "directional",
                "direction": (-sun).tolist(),
                "irradiance": {"type": "rgb", "value": math.pi},
            },
            "sensor": {
                "type": "orthographic",
                "to_world": above @ mi.ScalarTransform4f().scale([half, half, 1.0]),
                "film": {
                    "type": "hdrfilm",
                    "width": n,
                    "height": n,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                },
                "sampler": {"type": "independent", "sample_count": 64},
            },
        }
    )
    return np.array(mi.render(scene, seed=1))[..., 0]


@pytest.mark.parametrize("albedo", [0.12, 0.3])
def test_shadowed_crater_agrees_with_a_path_tracer(albedo, tmp_path):
    """One bounce is within 10 % of eight in the shadowed part of a crater (Mitsuba, Lambert facets)."""
    mi = pytest.importorskip("mitsuba", reason="the test extra brings mitsuba")
    z, away, _ = _bowl(101, 300.0, 220.0)
    sun_elevation = math.radians(30)
    sun = np.array([0.0, math.cos(sun_elevation), math.sin(sun_elevation)])  # in the north
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    try:
        traced = _path_traced(mi, z, albedo, sun, tmp_path / "crater.ply")
    finally:
        mi.set_variant(before or "scalar_rgb")
    north, east = np.gradient(z, -GSD, GSD)
    cosine = (sun[2] - east * sun[0] - north * sun[1]) / np.sqrt(1 + east**2 + north**2)
    visible = horizon(z, GSD, 0.0) < sun_elevation
    lit = (albedo * np.maximum(cosine, 0) * visible).astype(np.float32)
    bright = visible & (away < 180)
    assert lit[bright].mean() == pytest.approx(traced[bright].mean(), rel=0.15)  # the same scene, the right way up
    added = albedo * terrain_light(z, lit, GSD)[0]
    dark = (away < 190) & (gaussian_filter(visible.astype(float), 2) < 1e-6)
    assert dark.sum() > 300
    assert added[dark].mean() == pytest.approx(traced[dark].mean(), rel=0.10)
    smooth = [gaussian_filter(np.where(dark, v, 0), 3)[dark] for v in (added, traced)]
    assert np.percentile(np.abs(smooth[0] / smooth[1] - 1), 95) < 0.15
    further = albedo * terrain_light(z, lit + added, GSD)[0]  # a second bounce comes closer
    assert further[dark].mean() == pytest.approx(traced[dark].mean(), rel=0.05)


def test_penumbra_is_the_limb_darkened_disc_above_the_horizon():
    """Quadrature over the disc with I = 1 - 0.6 (1 - mu)."""
    side = np.linspace(-1, 1, 2001)
    x, y = np.meshgrid(side, side)
    inside = x**2 + y**2 < 1
    bright = np.where(inside, 1 - 0.6 * (1 - np.sqrt(np.maximum(1 - x**2 - y**2, 0))), 0)
    for height in np.linspace(-1.2, 1.2, 25):  # of the horizon over the disc's centre, radii
        expected = bright[y > height].sum() / bright.sum()
        found = sun_visibility(torch.tensor(0.2), torch.tensor(0.2 + height * SUN_RADIUS, dtype=torch.float64))
        assert float(found) == pytest.approx(expected, abs=1.5e-3)


def test_earth_irradiance_is_that_of_a_diffuse_sphere():
    """Integrate a Lambert sphere (geometric albedo 2/3 of its reflectance) facet by facet."""
    latitude, longitude = np.meshgrid(
        (np.arange(400) + 0.5) / 400 * math.pi - math.pi / 2, (np.arange(800) + 0.5) / 800 * 2 * math.pi
    )
    normal = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1
    )
    area = np.cos(latitude) * (math.pi / 400) * (2 * math.pi / 800)
    for phase in (0.0, 0.4, 1.2, 2.5):
        sun, moon = np.array([1.0, 0, 0]), np.array([math.cos(phase), math.sin(phase), 0])
        received = np.maximum(normal @ sun, 0) * np.maximum(normal @ moon, 0) / math.pi
        ratio = (received * area).sum() * (6371008.4 / 384.4e6) ** 2
        assert float(earth_irradiance(phase, geometric_albedo=2 / 3)) == pytest.approx(ratio, rel=1e-4)
    # of the Sun's 1361 W/m2, a full Earth sends about 0.15 W/m2 (Glenar et al. 2019)
    assert 0.13 < 1361 * float(earth_irradiance(0.0)) < 0.17
    assert float(earth_irradiance(math.pi)) == pytest.approx(0, abs=1e-18)


def test_the_chain_is_differentiable_in_elevation_and_sun():
    """Central differences of the image, penumbra included, against autograd in double precision."""
    torch.manual_seed(7)
    row, col = torch.meshgrid(torch.arange(14.0), torch.arange(14.0), indexing="ij")
    z = (12 * torch.exp(-((row - 4) ** 2 + (col - 5) ** 2) / 6) + torch.randn(14, 14) * 0.3).double()[None]
    model = get_model("lunar_lambert")
    coefficients = torch.tensor([p.default for p in model.parameters], dtype=torch.float64)[None, :, None, None]
    horizons = 0.3 + 0.02 * torch.randn(z.shape, dtype=torch.float64)  # the disc rises over them

    def image(elevation, sun_angles):
        azimuth, height = sun_angles[:, 0], sun_angles[:, 1]
        sun = torch.stack([azimuth.sin() * height.cos(), azimuth.cos() * height.cos(), height.sin()], -1)
        observation = Observation(
            elevation,
            sun,
            torch.tensor([[0.0, 0.0, 1e5]], dtype=torch.float64),
            GSD,
            1737400.0,
            sun_horizon=horizons,
        )
        wide = _WideSun()
        return form(observation, model, coefficients, [wide])[:, 1:-1, 1:-1]

    z.requires_grad_()
    sun = torch.tensor([[0.35, 0.30]], dtype=torch.float64, requires_grad=True)
    partly = image(z, sun)
    assert (partly > 0).any()
    weight = torch.rand_like(partly)
    gradient_z, gradient_sun = torch.autograd.grad((partly * weight).sum(), (z, sun))
    for parameter, gradient, step in ((z, gradient_z, 1e-5), (sun, gradient_sun, 1e-7)):
        for index in torch.randperm(parameter.numel())[:25]:
            bump = torch.zeros(parameter.numel(), dtype=torch.float64)
            bump[index] = step
            bump = bump.view_as(parameter)
            values = [
                (image(*(v + s * bump if v is parameter else v for v in (z, sun))) * weight).sum().item()
                for s in (1, -1)
            ]
            slope = (values[0] - values[1]) / (2 * step)
            scale = gradient.abs().max().item()
            assert gradient.flatten()[index].item() == pytest.approx(slope, abs=2e-4 * scale)


class _WideSun:
    """A Sun of 2 deg, so that many pixels of a small crop lie in its penumbra."""

    slot = "illumination"

    def apply(self, state):
        state.sun_radius = math.radians(2)


@pytest.mark.parametrize("call", [lambda z: sky_view(z, 2), lambda z: terrain_light(z, z[1:], GSD)])
def test_bad_input_is_named(call):
    with pytest.raises(GeometryError, match="expected"):
        call(np.zeros((5, 5), np.float32))
