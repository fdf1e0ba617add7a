"""Errors and scatter that `diagnose` reckons with: of the DEM, of shadows, of pieces of ground and of values per image."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hidden.terrain import make_terrain
from scipy.ndimage import gaussian_filter

from stages.diagnose.data.aligned import aligned
from stages.diagnose.judge import refine
from stages.diagnose.likelihood import covariance
from stages.diagnose.likelihood.covariance import Covariance, kept_share, shadow_variance
from stages.diagnose.likelihood.intervals import folds, interval, jackknife_error
from stages.diagnose.likelihood.patches import make_grid
from stages.diagnose.settings import FOLDS
from stages.effects import get_effect
from stages.effects.filters import gaussian, seams
from stages.physics.formation.resampling import displace


@pytest.mark.parametrize("size", [0.02, 0.2])
def test_the_error_of_an_rms_is_its_scatter_where_values_are_drawn_as_they_are_open(size):
    rng = np.random.default_rng(8)
    mean, mixed = size * rng.normal(size=6), 0.01 * rng.normal(size=(6, 6))
    drawn = rng.multivariate_normal(mean, mixed @ mixed.T, 20_000)
    squares = np.square(drawn).mean(1)
    rms = math.sqrt(squares.mean())
    scatter = float(squares.std()) / (2 * rms)
    assert refine.error_of_rms(mean, mixed @ mixed.T, rms, 6) == pytest.approx(scatter, rel=0.05)


def test_a_seam_of_a_dem_is_not_sharpened():
    """Pieces are put together after they were smoothed: sharpened, a step would be a ridge that no image shows."""
    for seed in range(5):
        fine = make_terrain(np.random.default_rng(seed), 97, 2.0, 8.0)[:96, :96]
        smooth = gaussian_filter(fine, 1.2, mode="nearest")
        plain = torch.from_numpy(smooth).float()[None]
        assert float(seams(plain).abs().max()) == 0  # craters and their rims are none
        step = torch.zeros(1, 96, 96)
        step[:, 50:] += 0.4
        step[:, :, 30:] -= 0.3
        assert torch.allclose(seams(plain + step), step, atol=0.05)
        sharp = {}
        for name, z in (("plain", plain), ("seamed", plain + step)):
            state = SimpleNamespace(elevation=z.clone())
            get_effect("dem_smoothing")({"sigma2_px2": 1.44}).apply(state)
            sharp[name] = state.elevation
        assert torch.allclose(sharp["seamed"] - step, sharp["plain"], atol=0.06)


def test_what_of_a_dem_may_be_errors_is_what_images_show_beside_it(monkeypatch):
    """Slopes that are white noise of a known variance: the share that is relief is one less the ratio of variances, wave by wave."""
    grid = make_grid(48, 48)
    rng = np.random.default_rng(3)
    waves = torch.zeros(grid.annuli, dtype=torch.float64)
    model = Covariance(waves, waves.clone(), torch.ones(grid.annuli, 1), 0.0, 0.0, 1.0, radius=grid.radius.tolist())
    model.relief[2:] = 0.01**2 / 4
    model.relief[-1] = 1.0
    chains, patches = [], []
    for k in range(40):
        slopes = [torch.from_numpy(rng.normal(0, 0.01, (1, 48, 48))).float() for _ in range(2)]
        site = SimpleNamespace(image=torch.zeros(1, 48, 48))
        chains.append(SimpleNamespace(state=SimpleNamespace(slopes=slopes), site=site, rendered=site.image))
        transform = lambda fields, grid: (fields, fields)  # noqa: E731 - the residual is not looked at
        patches.append([SimpleNamespace(site=k, rows=slice(0, 48), columns=slice(0, 48), transform=transform)])
    monkeypatch.setattr(covariance, "estimate", lambda *_: model)
    kept = kept_share(chains, patches, grid, 1)(2 * torch.pi * grid.radius)
    assert kept[:2].tolist() == [1.0, 1.0]
    assert kept[2:-1].numpy() == pytest.approx(np.full(grid.annuli - 3, 0.75), abs=0.04)
    assert kept[-1] < 1e-6  # all of it


def _shadows(values, light=None, cells=1):
    """The model of means in the deep shadow of one image, so many cells on each piece of ground."""
    model = Covariance.white(1, 1)
    pieces = torch.tensor(values, dtype=torch.float64).split(cells)
    kinds = torch.ones(1, len(values)) if light is None else torch.tensor(light)[None]
    patches = [
        SimpleNamespace(number=k, dark_frames=torch.zeros(len(v), dtype=torch.long)) for k, v in enumerate(pieces)
    ]
    shadow_variance(model, patches, pieces, kinds.split(cells, 1))
    return model


def test_scatter_of_shadows_is_what_no_light_explains():
    """As far as they lie from nothing where there are too few to scatter, as they scatter where there are many."""
    assert _shadows([]).dark == 1.0
    assert _shadows([-0.0054]).dark_piece ** 0.5 > 0.005
    many = np.random.default_rng(1).normal(0.05, 0.01, 400)
    assert _shadows(many.tolist()).dark_piece ** 0.5 == pytest.approx(0.01, rel=0.15)
    # light that falls on one shadow more than on another is no scatter
    walls = np.random.default_rng(2).uniform(0, 0.1, 400)
    assert _shadows((many + walls - 0.05).tolist(), walls.tolist()).dark_piece ** 0.5 == pytest.approx(0.01, rel=0.15)


def test_pieces_of_ground_differ_as_their_cells_do_at_least():
    """Relief that the DEM has not lights a piece's cells together; pieces that agree by chance are not exact."""
    rng = np.random.default_rng(3)
    alone, piece = rng.normal(0, 0.01, (100, 9)), rng.normal(0, 0.03, (100, 1))
    together = _shadows((alone + piece).flatten().tolist(), cells=9)
    assert together.dark**0.5 == pytest.approx(0.01, rel=0.15) and together.dark_piece**0.5 == pytest.approx(
        0.03, rel=0.2
    )
    same = _shadows((alone[:2] - alone[:2].mean(1, keepdims=True)).flatten().tolist(), cells=9)
    assert same.dark_piece >= same.dark > 1e-5
    # the nine cells of a piece say little more than one does
    root = together.dark_root(SimpleNamespace(dark_frames=torch.zeros(9, dtype=torch.long)))
    level = torch.linalg.solve_triangular(root, torch.ones(9, 1, dtype=torch.float64), upper=False)
    assert float(level.square().sum()) == pytest.approx(1 / (together.dark_piece + together.dark / 9), rel=1e-6)


def test_gains_in_few_shadows_are_judged_by_the_ground_that_shows_them():
    """Where most ground has nothing to gain, the rest is compared with itself; one piece of ground says nothing of others."""
    gains, shown = np.array([20.0, 22, 18, 21, *np.zeros(12)]), np.array([1.0, 1, 1, 1, *np.zeros(12)])
    assert interval(gains, shown)[0] > 70 > interval(gains)[0]
    assert interval(gains[:3], np.array([1.0, 0.01, 0.01]))[0] == -math.inf


def test_sharpening_goes_on_smoothly():
    """Waves that stop growing one after the other would make a fit stop at the first of them."""
    relief = torch.from_numpy(np.random.default_rng(4).normal(0, 1, (1, 64, 64)).cumsum(1).cumsum(2))
    sizes = np.linspace(0.5, 1.0, 26)
    heights = torch.stack([gaussian(relief, -float(s), slopes=True)[0] for s in sizes])
    first, second = heights.diff(dim=0), heights.diff(n=2, dim=0)
    assert float(second.square().mean().sqrt() / first.square().mean().sqrt()) < 0.15  # 0.33 with a sudden end
    assert torch.equal(gaussian(relief, 0.0, slopes=True).round(decimals=6), relief.round(decimals=6))


def test_jackknife_of_units_that_tell_unequally_much() -> None:
    """Means of values of known, unequal precision scatter by as much as it says; where one alone knows a value, leaving it out shows nothing."""
    rng = np.random.default_rng(0)
    precision = np.array([5, 1, 1, 1, 0.5, 0.5, 0.5, 0.5])
    values = rng.normal(0, precision**-0.5, (4000, 8))
    means = (values * precision).sum(1) / precision.sum()
    rest = precision.sum() - precision
    without = ((values * precision).sum(1, keepdims=True) - values * precision) / rest
    variance = np.mean([jackknife_error(w, rest) ** 2 for w in without])
    assert 0.75 < variance / means.var() < 1.15
    assert jackknife_error(np.array([900.0, 0.0, 0.0]), np.array([1e-6, 2.0, 2.0])) < 0.01


def test_images_that_are_laid_elsewhere_keep_their_noise() -> None:
    """Or those that moved by half a pixel would seem better than others; and what is not known does not ring into its neighbours."""
    noise = torch.randn(2, 96, 96, generator=torch.manual_seed(3))
    everywhere = torch.ones(2, 96, 96, dtype=torch.bool)
    half = torch.full((2, 96, 96), 0.5)
    moved, valid = aligned(noise, everywhere, half, half)
    quick, _ = aligned(noise, everywhere, half, half, displace)
    power = [float(z[valid].square().mean()) for z in (noise, moved, quick)]
    assert power[1] > 0.65 * power[0] and power[2] < 0.5 * power[0]
    wave = torch.cos(2 * math.pi * 0.3 * (torch.arange(96.0) + 0.2)).expand(2, 96, 96)
    moved, _ = aligned(wave, everywhere, torch.full((2, 96, 96), 0.3), 0 * half)
    expected = torch.cos(2 * math.pi * 0.3 * (torch.arange(96.0) - 0.1))
    assert (moved - expected)[:, 8:-8, 8:-8].abs().max() < 0.03
    flat, hole = torch.full((2, 96, 96), 5.0), everywhere.clone()
    hole[:, 40:50, 30:60] = False
    moved, valid = aligned(flat * hole, hole, half, half)
    assert not valid[:, 40:50, 31:60].any() and (moved[valid] - 5.0).abs().max() < 1e-4


@pytest.mark.parametrize("period", [2, 3, 4, 6, 8, 12])
def test_images_that_come_back_every_so_many_grounds_are_known_from_other_parts(period):
    """Else their own gains and shifts would be known from no ground but that which they are judged on."""
    alone = []
    for count in range(2 * period, 6 * period):
        part = folds(count)
        assert sorted(np.bincount(part))[0] >= count // FOLDS
        alone += [len(set(part[k::period])) == 1 for k in range(period)]
    assert np.mean(alone) < 0.15
