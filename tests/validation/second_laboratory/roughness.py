"""Hapke's (1984) correction for slopes below the resolution."""

import numpy as np


def _tilt(cos_a: np.ndarray, sin_a: np.ndarray, tangent: float, chi: float, term: np.ndarray) -> np.ndarray:
    return chi * (cos_a + sin_a * tangent * term)


def roughness_factor(mu0: np.ndarray, mu: np.ndarray, phase: np.ndarray, theta_bar_deg: float) -> np.ndarray:
    """Reflectance of a rough Lommel-Seeliger surface over that of a smooth one; phase in radian."""
    if theta_bar_deg < 0.05:
        return np.ones_like(mu0)
    tangent = float(np.tan(np.radians(theta_bar_deg)))
    chi = 1 / np.sqrt(1 + np.pi * tangent**2)
    mu0, mu = np.clip(mu0, 0.01, 0.99999), np.clip(mu, 0.01, 0.99999)
    sin_i, sin_e = np.sqrt(1 - mu0**2), np.sqrt(1 - mu**2)
    psi = np.arccos(np.clip((np.cos(phase) - mu0 * mu) / (sin_i * sin_e), -1, 1))
    half = np.sin(psi / 2) ** 2

    def first(cos_a: np.ndarray, sin_a: np.ndarray) -> np.ndarray:
        return np.exp(-2 / np.pi / tangent * cos_a / sin_a)

    def second(cos_a: np.ndarray, sin_a: np.ndarray) -> np.ndarray:
        return np.exp(-1 / np.pi / tangent**2 * (cos_a / sin_a) ** 2)

    e1_i, e1_e, e2_i, e2_e = first(mu0, sin_i), first(mu, sin_e), second(mu0, sin_i), second(mu, sin_e)
    low_view = mu0 >= mu  # incidence is smaller than emission
    near1, far1 = np.where(low_view, e1_e, e1_i), np.where(low_view, e1_i, e1_e)
    near2, far2 = np.where(low_view, e2_e, e2_i), np.where(low_view, e2_i, e2_e)
    below = 2 - near1 - psi / np.pi * far1
    own, other = (near2 - half * far2) / below, (np.cos(psi) * near2 + half * far2) / below
    mu0_eff = _tilt(mu0, sin_i, tangent, chi, np.where(low_view, other, own))
    mu_eff = _tilt(mu, sin_e, tangent, chi, np.where(low_view, own, other))
    mu0_nadir = _tilt(mu0, sin_i, tangent, chi, e2_i / (2 - e1_i))
    mu_nadir = _tilt(mu, sin_e, tangent, chi, e2_e / (2 - e1_e))
    overlap = np.exp(-2 * np.tan(np.minimum(psi, 3.1) / 2))
    limit = np.where(low_view, mu0 / mu0_nadir, mu / mu_nadir)
    shadowing = mu_eff / mu_nadir * mu0 / mu0_nadir * chi / (1 - overlap + overlap * chi * limit)
    return shadowing * mu0_eff / (mu0_eff + mu_eff) * (mu0 + mu) / mu0
