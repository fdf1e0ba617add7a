"""Where images lie, beside albedo that goes with relief."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from planted import semi_real
from scipy.ndimage import gaussian_laplace

from stages.diagnose.data.sites import load_site
from stages.diagnose.model.nominal import fit, load_nominal
from stages.diagnose.registration.explain import explain
from stages.diagnose.registration.forms import of_others
from stages.pairs.reader import PairReader

SIZE, SHIFT = 64, 0.4


def test_what_other_images_tell_of_an_image_is_its_albedo():
    """Of independent normal variables the best prediction is known: the others' mean, times the share of variance that is common."""
    rng = np.random.default_rng(3)
    albedo, noise = rng.normal(0, 0.05, (200, 200)), rng.normal(0, 0.02, (5, 200, 200))
    relative = torch.from_numpy(albedo + noise)
    left = relative - of_others(relative, torch.ones_like(relative))
    expected = 0.02**2 + 1 / (1 / 0.05**2 + 4 / 0.02**2)
    assert float(left.square().mean()) == pytest.approx(expected, rel=0.03)


def test_an_image_without_others_is_left_alone():
    relative = torch.randn(1, 30, 30, generator=torch.Generator().manual_seed(1))
    assert not of_others(relative, torch.ones_like(relative)).any()


@pytest.mark.parametrize("moved", [0.0, SHIFT])
def test_albedo_that_goes_with_relief_is_no_shift(tmp_path, moved):
    """Bright rims of craters lie towards every image's Sun: an albedo of twice the contrast of the shading looks like 1.5 px."""
    semi_real(tmp_path / "p.h5", 4713, images=4, size=SIZE)
    with PairReader(tmp_path / "p.h5") as reader:
        sites = [load_site(reader, np.flatnonzero(reader.site == k)) for k in np.unique(reader.site)[:4]]
        frames = len(reader.image_ids)
    for k, site in enumerate(sites):
        site.place = (100.0 * k, 80.0 * (3 * k % 4))
        curvature = gaussian_laplace(site.observation.elevation[0].numpy(), 1.5)
        read = site.read * torch.from_numpy(1 + 0.1 * curvature / curvature.std()).float()
        read[0] += moved * torch.gradient(read[0], dim=1)[0]
        site.read = site.image = read
    nominal = load_nominal(None, "M2", "iof")
    with torch.no_grad():
        fit(nominal, sites, [], "iof", [s.read for s in sites], start=True)
        found = explain(sites, nominal, [], frames, 0.0)
    shifts = found.fitted["constant"][0][:, :, 0].numpy()
    of_first = sites[0].frames[0]
    expected = np.zeros_like(shifts)
    expected[of_first, 0] = moved
    assert np.abs(shifts - expected).max() < 0.3
