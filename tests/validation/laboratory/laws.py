"""Reflectance laws: I/F of a facet that the Sun lights, from the cosines of incidence and emission and the phase angle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from .layout import Needs

HAPKE, LUNAR_LAMBERT, AKIMOV, MINNAERT, POLYNOMIAL = 0, 1, 2, 3, 4
PI = math.pi


@njit(cache=True, fastmath=True)
def hapke_rough(mu0: float, mu: float, g: float, theta: float) -> tuple[float, float, float]:
    """Effective cosines and shadowing function of macroscopic roughness theta (rad): Hapke 1984, Icarus 59, 41."""
    if theta < 1e-4:
        return mu0, mu, 1.0
    i = math.acos(min(max(mu0, 1e-4), 0.999999))
    e = math.acos(min(max(mu, 1e-4), 0.999999))
    si = math.sin(i)
    se = math.sin(e)
    ci = math.cos(i)
    ce = math.cos(e)
    cos_psi = (math.cos(g) - ci * ce) / max(si * se, 1e-6)
    cos_psi = min(max(cos_psi, -1.0), 1.0)
    psi = math.acos(cos_psi)
    tan_t = math.tan(theta)
    cot_t = 1.0 / tan_t
    chi = 1.0 / math.sqrt(1.0 + PI * tan_t * tan_t)
    cot_i = ci / max(si, 1e-6)
    cot_e = ce / max(se, 1e-6)
    e1_i = math.exp(-2.0 / PI * cot_t * cot_i)
    e1_e = math.exp(-2.0 / PI * cot_t * cot_e)
    e2_i = math.exp(-cot_t * cot_t * cot_i * cot_i / PI)
    e2_e = math.exp(-cot_t * cot_t * cot_e * cot_e / PI)
    f = math.exp(-2.0 * math.tan(min(psi, PI - 1e-4) * 0.5))
    s2 = math.sin(0.5 * psi) ** 2
    eta_i = chi * (ci + si * tan_t * e2_i / (2.0 - e1_i))
    eta_e = chi * (ce + se * tan_t * e2_e / (2.0 - e1_e))
    if i <= e:
        den = 2.0 - e1_e - psi / PI * e1_i
        m0 = chi * (ci + si * tan_t * (cos_psi * e2_e + s2 * e2_i) / den)
        m = chi * (ce + se * tan_t * (e2_e - s2 * e2_i) / den)
        shadowing = m / eta_e * ci / eta_i * chi / (1.0 - f + f * chi * ci / eta_i)
    else:
        den = 2.0 - e1_i - psi / PI * e1_e
        m0 = chi * (ci + si * tan_t * (e2_i - s2 * e2_e) / den)
        m = chi * (ce + se * tan_t * (cos_psi * e2_i + s2 * e2_e) / den)
        shadowing = m / eta_e * ci / eta_i * chi / (1.0 - f + f * chi * ce / eta_e)
    return max(m0, 1e-5), max(m, 1e-5), shadowing


@njit(cache=True, fastmath=True)
def reflectance(mu0: float, mu: float, g: float, code: int, p: np.ndarray) -> float:
    """I/F of a facet. p (8,): a scale, then by law

    Hapke           w, b, c, B0, h, theta (rad), 0 for the double Henyey-Greenstein phase function or 1 for Legendre's
    lunar-Lambert   phase function (3 numbers), factor on McEwen's L(g) (1996, LPSC 27, 841)
    Akimov          phase function (3)
    Minnaert        phase function (3), k at g = 0, its slope per rad
    polynomial      3 numbers not used, factors of cos(incidence) and cos(g), a constant

    where the phase function is exp(-p1 g) + p2 exp(-p3 g).
    """
    if mu0 <= 0.0 or mu <= 0.0:
        return 0.0
    if code == HAPKE:
        w = p[1]
        b = p[2]
        c = p[3]
        m0, m, shadowing = hapke_rough(mu0, mu, g, p[6])
        cg = math.cos(g)
        if p[7] < 0.5:
            back = 0.5 * (1 + c) * (1 - b * b) / (1 - 2 * b * cg + b * b) ** 1.5
            phase = back + 0.5 * (1 - c) * (1 - b * b) / (1 + 2 * b * cg + b * b) ** 1.5
        else:
            phase = 1.0 + b * cg + c * (1.5 * cg * cg - 0.5)
        surge = p[4] / (1.0 + math.tan(0.5 * g) / p[5])
        ga = math.sqrt(1.0 - w)
        h0 = (1 + 2 * m0) / (1 + 2 * m0 * ga)
        h1 = (1 + 2 * m) / (1 + 2 * m * ga)
        return p[0] * w * 0.25 * m0 / (m0 + m) * ((1 + surge) * phase + h0 * h1 - 1.0) * shadowing
    f = math.exp(-p[1] * g) + p[2] * math.exp(-p[3] * g)
    if code == LUNAR_LAMBERT:
        d = min(g * 180.0 / PI, 120.0)
        share = 1.0 - 0.019 * d + 2.42e-4 * d * d - 1.46e-6 * d**3
        share = p[4] * share
        return p[0] * f * (2.0 * share * mu0 / (mu0 + mu) + (1.0 - share) * mu0)
    if code == AKIMOV:  # Shkuratov et al. 2011, PSS 59, 1326
        sg = math.sin(g)
        if sg < 1e-4:
            return p[0] * f
        # photometric longitude from the sub-observer point: mu = cos(lat) cos(lon), mu0 = cos(lat) cos(g - lon)
        lon = math.atan((mu0 / mu - math.cos(g)) / sg)
        cos_lat = min(mu / max(math.cos(lon), 1e-6), 1.0)
        x = PI / (PI - g) * (lon - 0.5 * g)
        if x >= 0.5 * PI or x <= -0.5 * PI:
            return 0.0
        disc = math.cos(0.5 * g) * math.cos(x) * cos_lat ** (g / (PI - g)) / max(math.cos(lon), 1e-3)
        return p[0] * f * disc
    if code == POLYNOMIAL:
        return p[0] * max(p[4] * mu0 + p[5] * math.cos(g) + p[6], 0.0)
    k = p[4] + p[5] * g
    return p[0] * f * mu0**k * max(mu, 0.05) ** (k - 1.0)


@njit(cache=True, fastmath=True)
def departed(mu0: float, mu: float, g: float, code: int, p: np.ndarray, q: np.ndarray) -> float:
    """`reflectance` times a planted departure, q (6,): limb share, roughness (rad), B0, h, slope per rad, its phase angle (rad)."""
    r = reflectance(mu0, mu, g, code, p)
    if r <= 0.0:
        return r
    if q[0] != 0.0:
        r *= max((1.0 - q[0]) + q[0] * 2.0 / (mu0 + mu), 0.02)
    if q[1] > 0.0:
        m0, m, shadowing = hapke_rough(mu0, mu, g, q[1])
        r *= (m0 / (m0 + m)) * shadowing / (mu0 / (mu0 + mu))
    if q[2] != 0.0:
        r *= 1.0 + q[2] / (1.0 + math.tan(0.5 * g) / q[3])
    if q[4] != 0.0:
        r *= math.exp(-q[4] * (g - q[5]))
    return r


@dataclass
class Law:
    code: int
    parameters: np.ndarray  # (8,), see `reflectance`
    name: str

    def at_30_degrees(self) -> float:
        """I/F at incidence 30, emission 0, phase 30 degrees, where laboratories compare albedos."""
        return reflectance(math.cos(PI / 6), 1.0, PI / 6, self.code, self.parameters)


def draw_law(rng: np.random.Generator, needs: Needs, given: bool) -> Law:
    """Dark mare or bright highland under one of four laws, or the polynomial that `diagnose` is given as the law."""
    code = int(rng.choice([0, 1, 2, 3], p=[0.36, 0.24, 0.24, 0.16]))
    if needs.no_hapke and code == HAPKE:
        code = int(rng.integers(1, 3))
    p = np.zeros(8)
    p[0] = 1.0
    bright = rng.random() < 0.5 or needs.bright_law
    if given:
        p[4:7] = 1.0, rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.25)
        return _at_a_level(rng, bright, POLYNOMIAL, p, f"cos(i) + {p[5]:.2f} cos(g) + {p[6]:.2f}")
    if code == HAPKE:
        name = _draw_hapke(rng, p, bright)
        values = f"w={p[1]:.2f} b={p[2]:.2f} c={p[3]:.2f} B0={p[4]:.2f} h={p[5]:.3f} theta={math.degrees(p[6]):.1f}"
        return Law(code, p, f"{name} {values}")
    p[1] = rng.uniform(0.6, 1.0)
    p[2] = rng.uniform(0.15, 0.45)
    p[3] = rng.uniform(4, 9)
    if code == LUNAR_LAMBERT:
        p[4] = rng.uniform(0.9, 1.05)
        name = "lunar-Lambert (McEwen 1996 L(g))"
    elif code == AKIMOV:
        name = "Akimov"
    else:
        p[4] = rng.uniform(0.50, 0.58)
        p[5] = rng.uniform(0.05, 0.2)
        name = f"Minnaert k={p[4]:.2f}+{p[5]:.2f}g"
    return _at_a_level(rng, bright, code, p, f"{name}, f = exp(-{p[1]:.2f} g) + {p[2]:.2f} exp(-{p[3]:.1f} g)")


def _at_a_level(rng: np.random.Generator, bright: bool, code: int, p: np.ndarray, name: str) -> Law:
    """With the scale, p[0], of dark mare or of bright highland."""
    level = rng.uniform(0.08, 0.13) if bright else rng.uniform(0.04, 0.065)
    law = Law(code, p, f"{name}, I/F(30,0,30) = {level:.3f}")
    p[0] = level / law.at_30_degrees()
    return law


def _draw_hapke(rng: np.random.Generator, p: np.ndarray, bright: bool) -> str:
    """The absolute level comes from w; the scale stays 1."""
    if rng.random() < 0.65:
        w = rng.uniform(0.38, 0.48) if bright else rng.uniform(0.2, 0.28)
        b, c = rng.uniform(0.22, 0.28), rng.uniform(0.15, 0.45)
        surge, width = rng.uniform(1.5, 2.1), rng.uniform(0.05, 0.08)
        theta = 23.4 if rng.random() < 0.6 else rng.uniform(10, 23)
        p[1:8] = [w, b, c, surge, width, math.radians(theta), 0]
        return "Hapke 2HG (Sato 2014 like)"  # Sato et al. 2014, JGR Planets 119, 1775, at 643 nm
    w = rng.uniform(0.30, 0.36) if bright else rng.uniform(0.18, 0.22)
    p[1:8] = [w, 0.29, 0.39, 2.01, 0.07, math.radians(20.0), 1]
    return "Hapke Legendre (Helfenstein & Veverka 1987)"  # Icarus 72, 342
