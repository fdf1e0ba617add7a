"""What `diagnose` reads off the ground itself: deep shadow, whoever else is lit beside it, and broad patterns of albedo."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hidden.terrain import red_noise, units

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.patches import make_grid, make_patches
from stages.diagnose.likelihood.products import Rows, Shams, products
from stages.diagnose.sources import ground
from stages.effects import get_effect

LOW, HIGH = math.radians(9.0), math.radians(50.0)


def _chain(size: int = 64):
    """Level ground under a high Sun, and under a low one that a wall hides from its western half; the camera is overhead."""
    sun = torch.tensor([HIGH, LOW])[:, None, None].expand(2, size, size)
    horizon = torch.where(torch.arange(size) < size // 2, math.radians(20.0), -1.0).expand(2, size, size)
    lit = (sun > horizon).float()
    predicted = 0.05 * torch.sin(sun) * lit
    state = SimpleNamespace(
        angles=SimpleNamespace(cos_incidence=torch.sin(sun), cos_emission=torch.ones_like(sun)),
        slopes=(torch.zeros(2, size, size),) * 2,
    )
    site = SimpleNamespace(
        valid=torch.ones(2, size, size, dtype=torch.bool), image=predicted + 0.0004, left_out=frozenset({1}),
        frames=np.array([3, 5]), on_detector=lambda: torch.zeros(2, 2, size, size),
    )  # fmt: skip
    return SimpleNamespace(
        state=state, site=site, predict=lambda: predicted, height_above_horizon=lambda: sun - horizon,
        slope_tangents=(torch.zeros(2, size, size),) * 2,
    )  # fmt: skip


def test_shadow_counts_where_the_sun_is_too_low_to_judge_lit_ground():
    """Most deep shadow is in images that show nothing else that is judged: a pedestal is seen there, at once and exactly."""
    chain = _chain()
    (patch,) = make_patches(0, chain, 1, free=False)
    assert patch.frames.tolist() == [3] and set(patch.dark_frames.tolist()) == {5}
    brightness = 0.3 * 0.05 * math.sin(LOW)  # what residuals of darker pixels are relative to
    fields = (chain.site.image - chain.predict())[None]
    shadow = patch.shadow(fields)[0]
    assert len(shadow) == 32 and shadow.numpy() == pytest.approx(
        0.0004 / brightness, rel=1e-4
    )  # cells of 8 px of one half
    assert not len(make_patches(0, chain, 1, free=True)[0].shaded)  # beside a free offset it says nothing


def test_shadow_of_an_image_left_out_is_left_out():
    """... and shams have as much of it as the data."""
    chain = _chain()
    (patch,) = make_patches(0, chain, 1, free=False)
    grid = make_grid(64, 64)
    fields = torch.stack([chain.site.image - chain.predict(), torch.full((2, 64, 64), 0.001)])
    z, mean = patch.transform(fields, grid)
    z_own, mean_own = patch.transform(fields[:0], grid)
    rows = Rows(patch, z, mean, z_own, mean_own, patch.shadow(fields))
    made = products(rows, Covariance.white(grid.annuli, 6), grid, 6, None, [[5], [3]])
    dark = patch.shadow(fields).double()
    assert np.allclose(made.images[0], (dark @ dark.T).numpy())
    assert np.allclose(made.gram, made.images[0] + made.images[1])
    own = Covariance.white(grid.annuli, 6)
    own.dark_own = 0.04
    light = products(rows, own, grid, 6, None, [[5], [3]])
    assert light.place[-1] == 2 + 5  # light of its own of the sixth image, after the residual and one column
    assert light.gram[-1, -1] == pytest.approx(0.04 * 32) and np.allclose(light.gram[-1, :2], 0.2 * dark.sum(1))
    assert np.allclose(light.without(0).gram[-1], 0) and np.allclose(light.without(1).gram[-1], light.gram[-1])
    white = [(z[0], mean[0], torch.tensor([2.0])), (z[0], mean[0], torch.zeros(0))]
    assert Shams(white, grid, 3, 0).of(0)[2].abs().tolist() == [[2.0]] * 3


@pytest.mark.parametrize("kind", ["fractal", "borders", "rays"])
def test_broad_albedo_stands_out_of_the_spectrum_of_ground(kind):
    """Fractal ground and ground of units with sharp borders have as much that is fine as goes with what is broad; rays have not."""
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:96, :96] / 96
    maps = []
    for _ in range(6):
        field = 0.04 * units(rng, 336) if kind == "borders" else 0.03 * red_noise(rng, 336, 2.6)
        field = field.reshape(112, 3, 112, 3).mean((1, 3))[8:104, 8:104]
        if kind == "rays":
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            field = field + 0.1 * math.sqrt(2) * np.cos(9 * (x * np.cos(angle) + y * np.sin(angle)) + phase)
        maps.append(field)
    albedo = torch.from_numpy(np.array(maps)).float()
    _, size, usual = get_effect("albedo_map").read_off_ground(albedo, torch.ones_like(albedo))
    assert bool((size > usual).all()) if kind == "rays" else float(size.mean()) < float(usual.mean())
    if kind == "rays":
        assert float(size.mean()) ** 0.5 == pytest.approx(0.1, rel=0.2)


@pytest.mark.parametrize("rays", [True, False])
def test_a_pattern_of_the_ground_is_named_where_other_images_show_it(monkeypatch, rays):
    """What one image has of its own is no pattern of the ground, however broad."""
    rng = np.random.default_rng(2)
    lit = torch.ones(6, 96, 96, dtype=torch.bool)
    monkeypatch.setattr(ground, "judged", lambda chain: (lit, ~lit))
    row = torch.arange(96.0)[:, None].expand(96, 96) / 96

    def chain(number):
        waves = 0.1 * math.sqrt(2) * torch.cos(math.pi * 2 * row)
        noise = torch.from_numpy(rng.normal(0, 0.01, (6, 96, 96))).float()
        amount = torch.ones(6) if rays else torch.tensor([3.0, -3.0, 3.0, -3.0, 3.0, -3.0]) * rng.choice([-1, 1])
        image = 0.05 * (1 + waves * amount[:, None, None] + noise)
        site = SimpleNamespace(count=6, number=number, image=image)
        plain = torch.full((6, 96, 96), 0.05)

        def render(effect=None):
            if effect is None:
                return plain
            state = SimpleNamespace(
                elevation=plain, reflectance=plain, observation=SimpleNamespace(site=torch.full((6,), number))
            )
            effect.apply(state)
            return state.reflectance

        return SimpleNamespace(site=site, predict=lambda: plain, render=render)

    chains = [chain(k) for k in (0, 2, 3, 7)]
    (claim,) = ground.by_ground(SimpleNamespace(chains=lambda: chains, data=None))
    assert claim.name == "albedo_map" and (claim.decide() is None) == rays
    if rays:
        value, error, _ = claim.named.parameters["per_std"]
        assert value == pytest.approx(0.1, abs=0.003) and error < 0.05 and claim.named.percent[1] > 90
