"""The measured laws that diagnose fits, against laws that were written elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hidden.laws import LAWS
from orbital_angles import orbital_cosines

from stages.diagnose.model.laws import lunar_laws
from stages.physics.formation.geometry import Angles

# percent of brightness, rms: what a law leaves passes for causes, since noise of so many pixels is averaged to 0.01 %
LEFT = {
    "hapke": 0.04, "hapke_rough": 0.08, "lunar_lambert": 0.02, "akimov": 0.03, "minnaert": 0.03, "lroc_2014": 0.1,
    "lroc_2019": 0.02,
}  # fmt: skip


@pytest.fixture(scope="module")
def angles():
    """Cosines (3, N) of rough ground in twelve orbital images."""
    return torch.from_numpy(orbital_cosines(np.random.default_rng(5), np.radians(np.linspace(10, 70, 12)), 0.15, 1500))


@pytest.fixture(scope="module")
def laws(angles):
    return lunar_laws(angles[:, ::2])


@pytest.mark.parametrize("name", LEFT)
def test_a_law_is_followed_with_coefficients_that_are_no_surprise(laws, angles, name):
    """Coefficients scatter as those of measured laws: the law is one of them, as far as brightness can tell."""
    apart = angles[:, 1::2]
    truth = LAWS[name](*apart.numpy(), 1.0)
    parts = laws.parts(Angles(*apart.unbind(0))).double().numpy()
    a, b = (parts / truth).T, np.ones(len(truth))
    scatter = laws.scatter.double().numpy()
    precision = np.diag(np.r_[0.0, (np.abs(parts[0] / truth).mean() * scatter[1:]) ** -2])
    found = np.linalg.solve(a.T @ a * 1e5 + precision, a.T @ b * 1e5)  # as of many pixels with a noise of 0.3 %
    left = 100 * np.sqrt(np.mean((a @ found - b) ** 2))
    assert left < LEFT[name]
    assert np.abs(found[1:] / found[0] / scatter[1:]).max() < 4
