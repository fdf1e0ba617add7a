"""Clipping, read off the histogram of all pixels: where brightness piles up at one level."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest
import torch
from second_laboratory.cases import deal, make_case

from stages.diagnose.likelihood.intervals import gain_interval
from stages.diagnose.sources import clipping
from stages.effects import get_effect


def test_a_pile_of_a_tenth_of_all_pixels_is_clipping():
    """Of a narrow histogram a tenth lies within two per cent of brightness anyway; values that are all the same do not."""
    saturation = get_effect("saturation")
    values = torch.from_numpy(np.random.default_rng(2).normal(160.0, 25.0, 100_000)).float().clamp(min=1)
    assert saturation.read_off(values) is None
    assert saturation.read_off(values.round()) is None
    level = float(values.quantile(0.9))
    assert saturation.read_off(values.clamp(max=level))[0] == pytest.approx(level, rel=0.002)


def test_clipping_shows_where_the_histogram_falls_to_its_end():
    """A pile in one image of several is no higher than the histogram of all is a few per cent further down."""
    level = 0.07
    below = [torch.linspace(u, u + 0.002, round(200 + 1e4 * (1 - u))) for u in torch.arange(0.8, 0.999, 0.002).tolist()]
    falling = level * torch.cat(below)
    saturation = get_effect("saturation")
    assert saturation.read_off(falling) is None
    pile = level * (1 + 0.0002 * torch.linspace(-1, 1, 900))
    assert saturation.read_off(torch.cat([falling, pile]))[0] == pytest.approx(level, rel=0.001)


def test_clipping_shows_after_bicubic_resampling():
    """It rings by a per cent above the level, in single images that are clipped in a few places."""
    rng, level = np.random.default_rng(8), 0.06
    ground = cv2.GaussianBlur(rng.normal(size=(4, 160, 160, 1)).reshape(640, 160), (0, 0), 2.0).reshape(4, 160, 160)
    images = 0.045 + 0.007 * ground / ground.std()
    turned = cv2.getRotationMatrix2D((80, 80), 7.0, 0.93)

    def laid(images):
        every = [cv2.warpAffine(k.astype(np.float32), turned, (160, 160), flags=cv2.INTER_CUBIC) for k in images]
        return torch.from_numpy(np.stack(every)[:, 20:-20, 20:-20].copy()).flatten()

    saturation = get_effect("saturation")
    clipped = laid(images.clip(max=level))
    assert 0.01 < float((clipped > 0.998 * level).float().mean()) < 0.03
    assert float((clipped > 1.002 * level).float().mean()) > 0.0005  # it does ring
    assert saturation.read_off(clipped)[0] == pytest.approx(level, rel=0.003)
    assert saturation.read_off(laid(images)) is None


@pytest.mark.slow
def test_clipping_of_noisy_images_shows_after_resampling(tmp_path):
    """Another laboratory's images: noise that was cut off rings, and of the pile seven per cent lie more than a per cent above the level."""
    path, seed = tmp_path / "pairs.h5", 1752317183
    level = make_case(10, deal(seed, 44)[10], seed, path)["planted"]["saturation"]["iof"]
    with h5py.File(path) as file:
        bright = torch.from_numpy(file["image"][...][file["valid"][...] > 0])
    assert get_effect("saturation").read_off(bright)[0] == pytest.approx(level, rel=0.005)


def test_the_brightest_image_of_smooth_ground_is_no_pile():
    """It lies within two per cent, with nothing below it; a level that noise widens as much has ground below."""
    rng, saturation = np.random.default_rng(4), get_effect("saturation")
    images = [rng.normal(level, 0.018 * level, 20_000) for level in (0.03, 0.04, 0.09, 0.12, 0.155, 0.222)]
    assert saturation.read_off(torch.from_numpy(np.concatenate(images)).float()) is None
    wide = rng.normal(0.2, 0.04, 20_000).clip(max=0.222) + rng.normal(0, 0.0022, 20_000)
    found = saturation.read_off(torch.from_numpy(np.concatenate([*images[:-1], wide])).float())
    assert found[0] == pytest.approx(0.222, rel=0.02)


def test_images_that_are_cut_off_as_a_whole_are_clipping(monkeypatch):
    """Nothing of them is left to fit, and the law that is extrapolated to them may be too dark: their own brightness is not asked."""
    rng, level = np.random.default_rng(6), 0.085
    for bright, gains in ((0.12, True), (0.07, False)):
        shading = 1 + 0.05 * rng.normal(size=(4, 6, 64, 64))
        light = torch.from_numpy(shading * np.array([0.02, 0.03, 0.04, 0.05, bright, bright])[:, None, None]).float()
        predicted = light.clone()
        predicted[:, 4:] *= 0.5
        images = (light + 0.0005 * torch.randn(light.shape, generator=torch.manual_seed(1))).clamp(max=level)
        chains = [
            SimpleNamespace(predict=lambda p=p: p, site=SimpleNamespace(gain=torch.ones(6), offset=torch.zeros(6)))
            for p in predicted
        ]
        monkeypatch.setattr(clipping, "full_light", lambda chain: torch.ones(6, 64, 64, dtype=torch.bool))
        masks = [torch.ones(6, 64, 64, dtype=torch.bool)] * 4
        before, after, _ = clipping._clipped(
            SimpleNamespace(chains=lambda c=chains: c), list(images), masks, get_effect("saturation")
        )
        assert (gain_interval(before, after)[1] > 0) == gains
        assert (
            before.max() < 6 * 16 * 64
        )  # its brightness is off by less than all of it, or one such image would outweigh all others


@pytest.mark.parametrize("cut", [True, False])
def test_clipping_of_bright_ground_shows_beside_its_albedo(monkeypatch, cut):
    """Where a law of one albedo stays below the level, the other images of a place say which ground is bright."""
    rng, level = np.random.default_rng(3), 0.11
    albedo = [1 + 0.06 * cv2.GaussianBlur(rng.normal(size=(64, 64)), (0, 0), 4.0) * 14 for _ in range(5)]
    predicted = torch.tensor([0.05, 0.06, 0.07, 0.1])[:, None, None].expand(4, 64, 64).contiguous()
    images = []
    for ground in albedo:
        image = predicted * torch.from_numpy(ground).float()
        image = image * (1 + 0.01 * torch.from_numpy(rng.normal(size=(4, 64, 64))).float())
        images.append(image.clamp(max=level) if cut else image)
    chain = SimpleNamespace(predict=lambda: predicted, site=SimpleNamespace(gain=torch.ones(4), offset=torch.zeros(4)))
    lit = torch.ones(4, 64, 64, dtype=torch.bool)
    monkeypatch.setattr(clipping, "full_light", lambda chain: lit)
    monkeypatch.setattr(get_effect("saturation"), "read_off", classmethod(lambda cls, bright: (level, 0.0, 1.0)))
    before, after, _ = clipping._clipped(
        SimpleNamespace(chains=lambda: [chain] * 5), images, [lit] * 5, get_effect("saturation")
    )
    assert (gain_interval(before, after)[1] > 0) == cut
    assert float(predicted.max()) < level
