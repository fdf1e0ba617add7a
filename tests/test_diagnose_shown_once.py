"""Images that show one place each: where they lie, one part of the crop tells of the others."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from planted import semi_real
from scipy.ndimage import shift

from stages.diagnose.data.sites import load_site
from stages.diagnose.model.nominal import fit, load_nominal
from stages.diagnose.registration.explain import explain
from stages.diagnose.registration.squares import shown_once
from stages.effects.misregistration import ORDINARY
from stages.pairs.reader import PairReader

IMAGES = 4


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """Registration of six places, each shown by images of its own, which lie anywhere by so many px rms; and where they do."""

    pairs = semi_real(tmp_path_factory.mktemp("once") / "pairs.h5", 4714, 6, IMAGES)

    def register(rms, once=True):
        with PairReader(pairs) as reader:
            sites = [load_site(reader, np.flatnonzero(reader.site == k)) for k in np.unique(reader.site)[:6]]
        rng = np.random.default_rng(2)
        planted = rng.normal(0, rms / 2**0.5, (6 * IMAGES, 2))
        for k, site in enumerate(sites):
            frames = torch.arange(IMAGES) + (IMAGES * k if once else 0)
            site.observation = dataclasses.replace(site.observation, frame=frames)
            moved = [
                shift(one, -planted[f, ::-1], order=3, mode="nearest")
                for one, f in zip(site.read.numpy(), site.frames, strict=True)
            ]
            site.read = site.image = torch.from_numpy(np.stack(moved))
        assert shown_once(sites) == once
        nominal = load_nominal(None, "M2", "iof")
        with torch.no_grad():
            fit(nominal, sites, [], "iof", [s.read for s in sites], start=True)
            return explain(sites, nominal, [], 6 * IMAGES, 0.0), planted

    return register


def test_shifts_of_images_that_show_one_place_each_are_found(registered):
    """No other ground tells of them, and they were taken for nothing, and for a blur."""
    found, planted = registered(0.8)
    assert found.form.terms == 1 and found.gains[found.form.name].low > 0
    east_south = found.coefficients[:, :, 0].numpy()
    assert np.sqrt(((east_south - planted) ** 2).sum(1).mean()) < 0.3


def test_shifts_that_all_images_have_are_left_to_what_explains_them(registered):
    """A wrong Sun looks like a small shift of its own in every crop."""
    found, _ = registered(0.15)
    assert found.form.name == "none" and not found.displaced
    assert ORDINARY > 0.15


@pytest.mark.slow
def test_images_that_show_several_places_are_judged_on_other_places(registered):
    found, planted = registered(0.8, once=False)
    assert len(found.squares["none"]) == 6
    assert np.abs(found.coefficients[:IMAGES, :, 0].numpy() - planted[:IMAGES]).max() < 0.3
