"""What shadows tell by themselves: where they end, how wide their edges are, and how far away what casts them stands."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from laboratory.cases import Deal, make_case

from stages import diagnose
from stages.diagnose.likelihood.patches import _without_lit
from stages.diagnose.model.chain import Chain
from stages.diagnose.sources.shadows import by_shadows
from stages.diagnose.sources.walls import hide_dark
from stages.effects import Survey
from stages.physics.horizon import horizon, occluder_distance
from stages.physics.light.sun_disc import sun_visibility, visibility_slope


class ShadowedGround:
    """A site that a Sun in the west shines on, whose horizon stands at the border of its DEM and is rough.

    wall : (height, distance from the crop), m; sun_deg : too high by so much; radius_deg : of the disc
    dem_px : errors of the DEM's horizons as they are seen from a pixel away, rad; fall : power of the distance with which they fall
    """

    def __init__(self, rng, number, wall=None, sun_deg=0.0, radius_deg=0.2666, dem_px=0.0, fall=1.0):
        suns = [[-np.cos(a), 0.0, np.sin(a)] for a in np.radians([8.0, 14.0, 30.0])]
        self.suns = torch.tensor(suns, dtype=torch.float32)
        known = torch.from_numpy(np.radians(rng.normal(2.0, 6.0, (1, 64, 64)))).float().expand(3, 64, 64)
        wrong = dem_px * torch.from_numpy(rng.normal(size=(1, 64, 64))).float()
        true = known + wrong / torch.arange(1.0, 65.0) ** fall
        if wall:
            east = torch.linspace(-315.0, 315.0, 64).expand(3, 64, 64)
            true = torch.maximum(true, torch.atan2(torch.tensor(wall[0]), wall[1] + 320.0 + east))
        self.state = SimpleNamespace(
            sun_horizon=known, reflectance=torch.full((3, 64, 64), 0.05), sun_direction=self.suns,
            elevation=torch.zeros(3, 64, 64), sun_radius=np.radians(0.2666),
        )  # fmt: skip
        up = torch.asin(self.suns[:, 2])[:, None, None]
        self.state.sun_visibility = sun_visibility(up, known, np.radians(0.2666))
        light = sun_visibility(up + np.radians(sun_deg), true, np.radians(radius_deg))
        image = 0.05 * light * torch.from_numpy(rng.normal(1, 0.1, (1, 64, 64))).float()
        every = torch.ones(3, 64, 64, dtype=torch.bool)
        observation = SimpleNamespace(gsd=10.0, sun_direction=self.suns)
        self.state.observation = observation
        self.site = SimpleNamespace(number=number, valid=every, image=image, observation=observation)

    def predict(self):
        return self.state.reflectance * self.state.sun_visibility

    def height_above_horizon(self):
        return torch.asin(self.suns[:, 2])[:, None, None] - self.state.sun_horizon

    def lit(self):
        return self.state.sun_horizon < torch.asin(self.suns[:, 2])[:, None, None]

    def sunlight(self, effects):
        return Chain.sunlight(SimpleNamespace(_state=self.state), effects)


@pytest.mark.parametrize(
    ("planted", "name", "parameter", "truth"),
    [
        ({"dem_px": 0.2}, None, "", 0.0),
        pytest.param({}, None, "", 0.0, marks=pytest.mark.slow),
        pytest.param({"dem_px": 0.2, "fall": 0.5}, None, "", 0.0, marks=pytest.mark.slow),
        pytest.param({"wall": (110.0, 320.0)}, "distant_shadow", "height_m", 110.0, marks=pytest.mark.slow),
        pytest.param({"wall": (200.0, 768.0)}, "distant_shadow", "height_m", 200.0, marks=pytest.mark.slow),
        pytest.param({"wall": (40.0, 110.0)}, "distant_shadow", "height_m", 40.0, marks=pytest.mark.slow),
        pytest.param({"wall": (400.0, 200.0)}, "distant_shadow", "height_m", 400.0, marks=pytest.mark.slow),
        ({"sun_deg": -1.5, "dem_px": 0.2}, "sun_elevation", "error_deg", -1.5),
        pytest.param({"sun_deg": 1.5}, "sun_elevation", "error_deg", 1.5, marks=pytest.mark.slow),
        pytest.param({"sun_deg": 7.0, "dem_px": 0.2}, "sun_elevation", "error_deg", 7.0, marks=pytest.mark.slow),
        ({"radius_deg": 2.0, "dem_px": 0.2}, "penumbra", "radius_deg", 2.0),
        pytest.param({"radius_deg": 2.0}, "penumbra", "radius_deg", 2.0, marks=pytest.mark.slow),
        pytest.param(
            {"radius_deg": 3.0, "dem_px": 0.05, "fall": 0.5}, "penumbra", "radius_deg", 3.0, marks=pytest.mark.slow
        ),
    ],
)
def test_shadows_tell_a_wall_the_sun_and_its_disc_whatever_the_law(planted, name, parameter, truth):
    """Errors of the DEM, which widen edges by an angle that falls with distance, are neither."""
    rng = np.random.default_rng(5)
    chains = [ShadowedGround(rng, k, **planted) for k in range(4)]
    survey = Survey(crop_px=64, gsd=10.0)
    claims = by_shadows(SimpleNamespace(chains=lambda: chains, causes=[], data=survey, free_gains=False))
    found = [claim.named for claim in claims if claim.decide() is None]
    assert [c.effect.name for c in found] == ([name] if name else [])
    if name:
        value, error, _ = found[0].parameters[parameter]
        assert abs(value - truth) < 3 * error < 2 * abs(truth)
        assert found[0].percent[1] > 0
        assert name != "distant_shadow" or found[0].effect.values["side"] in (0.0, 4.0)


def test_a_horizon_is_known_where_the_sun_was_said_to_be():
    """Beside a Sun that was turned by three degrees, edges that are off by a degree are no wide disc."""
    rng = np.random.default_rng(5)
    chains = [ShadowedGround(rng, k, radius_deg=2.0) for k in range(4)]
    turn = math.radians(3.0)
    for chain in chains:
        chain.site.observation.sun_direction = chain.suns @ torch.tensor(
            [[math.cos(turn), math.sin(turn), 0.0], [-math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
        )
    state = SimpleNamespace(chains=lambda: chains, causes=[], data=Survey(crop_px=64, gsd=10.0), free_gains=False)
    assert not [claim for claim in by_shadows(state) if claim.decide() is None]


@pytest.mark.parametrize("wall", [None, (150.0, 200.0)])
def test_images_that_a_wall_leaves_in_the_dark_are_no_part_of_what_the_law_is_fitted_to(monkeypatch, wall):
    rng = np.random.default_rng(5)
    chains = [ShadowedGround(rng, k, wall=wall, dem_px=0.2) for k in range(4)]
    for chain in chains:
        chain.site.read, chain.site.hidden = chain.site.image, torch.zeros_like(chain.site.valid)
        chain.site.hide = lambda dark, site=chain.site: setattr(site, "hidden", dark)
    fitted = []
    monkeypatch.setattr("stages.diagnose.sources.walls.fit", lambda *args, **options: fitted.append(args))
    state = SimpleNamespace(
        chains=lambda: chains, data=Survey(crop_px=64, gsd=10.0), free_gains=False, sites=[c.site for c in chains],
        nominal=None, units="iof", leave_out_rare_images=lambda: None,
    )  # fmt: skip
    assert hide_dark(state) == bool(wall) == bool(fitted)
    if wall:
        kept = ~torch.stack([c.site.hidden for c in chains])
        dark = torch.stack([c.site.image < 0.2 * c.predict() for c in chains]) & torch.stack([c.lit() for c in chains])
        assert dark[:, 0].float().mean() > 0.5  # a Sun of 8 deg behind a wall of 10 to 37 deg
        assert (kept & dark).float().mean() < 0.01 < 0.2 < kept[:, 2].float().mean()
    else:
        assert not any(c.site.hidden.any() for c in chains)


def test_sunlit_specks_in_deep_shadow_are_no_light_that_falls_into_it():
    """The DEM has not all facets: some stand up into sunlight. The mean of what is left is that of the shadow, whose noise goes both ways."""
    rng = np.random.default_rng(6)
    deep = torch.from_numpy(rng.random((3, 50, 61)) < 0.7)
    shadow = rng.normal(0.004, 0.003, deep.shape)
    specks = rng.random(deep.shape) < 0.1
    image = torch.from_numpy(np.where(specks, shadow + rng.uniform(0.01, 0.3, deep.shape), shadow))
    kept = _without_lit(deep, image)
    assert not (kept & ~deep).any() and kept.sum() > 0.8 * deep.sum()
    assert float(image[deep].mean()) > 0.01
    assert abs(float(image[kept].mean()) - 0.004) < 0.0006
    assert (_without_lit(deep, torch.full_like(image, 0.5)) == deep).all()


@pytest.mark.parametrize("azimuth_deg", [0, 37, 90, 135, 200, 270, 333])
def test_a_ridge_that_makes_the_horizon_is_as_far_away_as_it_stands(azimuth_deg):
    """A straight ridge, and beyond the border what the grid does not hold."""
    azimuth, n, gsd = math.radians(azimuth_deg), 81, 5.0
    row, col = np.mgrid[:n, :n]
    towards = (col - 40) * math.sin(azimuth) - (row - 40) * math.cos(azimuth)  # px from the middle
    z = (8 * np.exp(-((towards - 10) ** 2) / 2)).astype(np.float32)
    wanted = (np.hypot(row - 40, col - 40) < 8) & (towards < 4)
    found = occluder_distance(z, gsd, azimuth, horizon(z, gsd, azimuth), wanted)
    assert np.abs(found - (10 - towards))[wanted].max() < 1.0
    assert not found[~wanted].any()
    flat = np.zeros((n, n), np.float32)
    beyond = occluder_distance(flat, gsd, 0.0, np.full((n, n), 0.1, np.float32), np.ones((n, n), bool))
    np.testing.assert_allclose(beyond, np.maximum(row + 0.5, 1.0), atol=0.51)


def test_the_flux_along_the_horizon_is_that_of_a_limb_darkened_disc():
    """Against the integral of 1 - u (1 - mu) along the chord over that over the disc, in closed form pi (1 - u / 3)."""
    for t in (-0.9, -0.3, 0.0, 0.5, 0.99):
        half = math.sqrt(1 - t * t)
        x = np.linspace(-half, half, 200_001)
        chord = np.trapezoid(1 - 0.6 * (1 - np.sqrt(np.maximum(1 - t * t - x * x, 0))), x)
        expected = -chord / (math.pi * (1 - 0.6 / 3))
        assert float(visibility_slope(torch.tensor(t, dtype=torch.float64))) == pytest.approx(expected, abs=1e-6)
    assert not visibility_slope(torch.tensor([-1.5, 1.0, 3.0])).any()


@pytest.mark.slow
def test_a_wall_that_leaves_whole_images_dark_is_named_and_not_their_gains(tmp_path):
    """Another laboratory's ridge of 438 m beyond the DEM: under a third of its Suns nothing is lit."""
    path = tmp_path / "pairs.h5"
    truth = make_case(53, Deal("a", effect="distant_shadow"), 20261126, path)
    (found,) = diagnose.run(path).answer.causes
    assert found.effect.name == "distant_shadow"
    value, error, _ = found.parameters["height_m"]
    assert abs(value - truth["planted"]["distant_shadow"]["height_m"]) < 2 * error
