"""The simulated ground against published lunar statistics and closed forms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stages.physics.relief import craters
from stages.physics.relief.noise import fractal
from stages.simulate import make_config
from stages.simulate.terrain import Terrain


def area_mean(z, n):
    return z.reshape(z.shape[0] // n, n, z.shape[1] // n, n).mean((1, 3))


def cumulative_slope(diameter, low, high):
    """Maximum-likelihood slope of a truncated power law (Clauset et al. 2009, with an upper end), by bisection."""
    d = diameter[(diameter >= low) & (diameter <= high)]
    mean, span = np.log(d / low).mean(), np.log(high / low)
    a, b = 0.1, 20.0
    for _ in range(80):
        k = 0.5 * (a + b)
        a, b = (k, b) if 1 / k - span / np.expm1(k * span) > mean else (a, k)
    return k, len(d)


@pytest.fixture(scope="module")
def population():
    edge = 15000.0
    c = craters.populate((-edge, -edge, edge, edge), 30.0, 2000.0, 1.0, 200.0, np.random.default_rng(3))
    inside = (abs(c.x) < edge) & (abs(c.y) < edge)
    return c.select(inside), (2 * edge / 1000) ** 2


def test_size_frequency_is_equilibrium_below_and_production_above(population):
    c, _ = population
    k, n = cumulative_slope(c.diameter, 30.0, 200.0)
    assert abs(k - 2.0) < 0.1 + 3 * k / np.sqrt(n)
    k, n = cumulative_slope(c.diameter, 200.0, 2000.0)
    assert abs(k - 3.0) < 0.1 + 3 * k / np.sqrt(n)


def test_density_is_near_the_lunar_equilibrium(population):
    """Trask (1966): 7.9 craters above 100 m per km2; younger craters have erased some of those drawn."""
    c, area = population
    density = (c.diameter > 100).sum() / area
    assert 0.7 * 7.94 < density < 1.05 * 7.94


def test_large_craters_are_younger_than_their_lifetime(population):
    c, _ = population
    assert c.age[c.diameter > 400].max() <= 0.5 + 1e-9
    assert c.age[c.diameter < 100].max() > 0.95


def one_crater(age, diameter=400.0, step=2.5, seed=5):
    c = craters.Craters(*(np.array([v]) for v in (0.0, 0.0, diameter, age, 1.0)), np.array([seed]))
    n = int(4 * diameter / step) | 1
    half = (n - 1) / 2 * step
    z, fresh, rays = craters.stamp(c, -half, half, step, (n, n))
    return z, fresh, rays


def test_fresh_crater_has_pike_dimensions_and_wall_at_repose():
    z, fresh, _ = one_crater(0.0)
    n = z.shape[0]
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    r = np.hypot(x, y) * 2.5 / 200.0
    rim = np.mean([z[(r > 0.8) & (r < 1.25) & (np.arctan2(y, x) // (np.pi / 8) == k)].max() for k in range(-8, 8)])
    floor = z[r < 0.08].mean()
    assert 0.18 < (rim - floor) / 400.0 < 0.205  # Pike (1977): 0.196
    assert 0.028 < rim / 400.0 < 0.045  # Pike (1977): 0.036
    gy, gx = np.gradient(z, 2.5)
    wall = np.degrees(np.arctan(np.hypot(gx, gy)))[(r > 0.75) & (r < 0.9)]
    assert 30 < np.median(wall) < 36
    assert fresh[r < 0.9].min() > 0.5 and fresh[r > 3.5].max() == 0


def test_age_makes_craters_shallower_and_dull():
    depths, brightness = [], []
    for age in (0.0, 0.05, 0.2, 0.5, 0.99):
        z, fresh, rays = one_crater(age)
        depths.append((z.max() - z.min()) / 400.0)
        brightness.append(fresh.max() + rays.max())
    assert all(np.diff(depths) < 0)
    assert depths[-1] < 0.05
    assert brightness[0] > brightness[1] > brightness[2] == 0


def test_decay_is_topographic_diffusion():
    """The table of worn profiles against a two-dimensional Gaussian blur of the fresh one (sigma^2 = 2 K R^2)."""
    table, spacing = craters.profile_table()
    n, step = 801, 0.02
    y, x = (np.mgrid[:n, :n] - n // 2) * step
    fresh = craters.fresh_profile(np.hypot(x, y))
    states = len(table)
    for state in (8, 20, states - 1):
        k = craters.WORN_OUT * (state / (states - 1)) ** 2 + 0.0012
        worn = gaussian_filter(fresh, np.sqrt(2 * k) / step, truncate=6)[n // 2, n // 2 :]
        r = np.arange(0, 3.0, 0.1)
        ours = np.interp(r, np.arange(table.shape[1]) * spacing, table[state])
        theirs = np.interp(r, np.arange(len(worn)) * step, worn)
        assert np.abs(ours - theirs).max() < 0.002


@pytest.mark.parametrize("hurst", [0.6, 0.92])
def test_fractal_relief_has_the_spectrum_of_its_hurst_exponent(hurst):
    """A self-affine surface has a radial power spectrum of slope -(2 H + 2)."""
    n = 1024
    slopes = []
    for seed in range(4):
        z = fractal((n, n), 0.0, 0.0, 1.0, longest=900.0, shortest=3.0, hurst=hurst, seed=seed).astype(float)
        window = np.hanning(n)[:, None] * np.hanning(n)
        power = np.abs(np.fft.fft2((z - z.mean()) * window)) ** 2
        f = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
        edges = np.geomspace(1 / 150, 1 / 12, 14)
        mean = [power[(f >= a) & (f < b)].mean() for a, b in itertools.pairwise(edges)]
        slopes.append(np.polyfit(np.log(np.sqrt(edges[:-1] * edges[1:])), np.log(mean), 1)[0])
    assert abs(np.mean(slopes) + 2 * hurst + 2) < 0.2


def test_slopes_are_lunar():
    """RMS slope at a baseline of 5 m within 5..10 deg, walls no steeper than fresh lunar ones."""
    rms, steep = [], []
    for seed in (1, 2):
        z = Terrain(make_config({"size_px": 800, "seed": seed})).block(0, 0, 1600, 1600).elevation
        gy, gx = np.gradient(area_mean(z, 2).astype(float), 5.0)
        rms.append(np.degrees(np.arctan(np.sqrt((gx**2 + gy**2).mean()))))
        steep.append(np.percentile(np.degrees(np.arctan(np.hypot(gx, gy))), 99.9))
    assert 5.0 < np.mean(rms) < 10.0
    assert max(steep) < 42.0


def test_a_block_is_the_same_however_the_scene_is_cut():
    terrain = Terrain(make_config({"size_px": 256, "seed": 4}))
    whole = terrain.block(0, 0, 512, 512)
    part = terrain.block(128, 77, 200, 300)
    cut = (slice(128, 328), slice(77, 377))
    assert np.abs(whole.elevation[cut] - part.elevation).max() < 2e-3
    assert np.abs(whole.freshness[cut] - part.freshness).max() < 1e-3
    assert np.abs(whole.rays[cut] - part.rays).max() < 5e-3


def test_seed_decides_everything():
    first, again, other = (Terrain(make_config({"size_px": 64, "seed": s})).block(0, 0, 128, 128) for s in (1, 1, 2))
    assert np.array_equal(first.elevation, again.elevation)
    assert np.abs(first.elevation - other.elevation).std() > 0.1
