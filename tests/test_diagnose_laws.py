"""The measured laws that diagnose fits, against laws that were written elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hidden.laws import LAWS

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
    rng = np.random.default_rng(5)
    sun = np.radians(np.linspace(10, 70, 12))
    parts = []
    for k in range(12):
        view, azimuth = np.radians(rng.uniform(0, 35)), rng.uniform(0, 2 * np.pi)
        s = np.array([np.cos(sun[k]), 0, np.sin(sun[k])])
        v = np.array([np.sin(view) * np.cos(azimuth), np.sin(view) * np.sin(azimuth), np.cos(view)])
        normal = np.concatenate([-rng.normal(0, 0.15, (1500, 2)), np.ones((1500, 1))], 1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        mu0, mu = normal @ s, normal @ v
        seen = (mu0 > np.cos(np.radians(76))) & (mu > 0.3)
        parts.append(np.stack([mu0[seen], mu[seen], np.full(seen.sum(), s @ v)]))
    return torch.from_numpy(np.concatenate(parts, 1))


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
