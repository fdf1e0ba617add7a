"""Reflectance laws that hidden ground may follow, written here from their papers: I/F of a facet in full light.

Each takes cosines of incidence, emission and phase, and the relative albedo, all of which broadcast.
"""

from __future__ import annotations

import numpy as np


def linear(mu0, mu, cosg, albedo, a=0.08, b=0.02, c=0.01):
    """The nominal model's own form."""
    return albedo * (a * mu0 + b * cosg + c)


def hapke(mu0, mu, cosg, albedo, w=0.36, lobe=0.24, backward=0.3, surge=1.7, width=0.054, theta_deg=23.4):
    """Hapke (1981, 1984, 1986) with parameters of lunar size (Sato et al. 2014); albedo is that of single scattering."""
    phase = np.arccos(cosg)
    w = np.clip(w * albedo, 0, 0.99)
    front, back = (1 + 2 * s * lobe * cosg + lobe**2 for s in (1, -1))
    single = (1 - lobe**2) * ((1 + backward) / 2 * back**-1.5 + (1 - backward) / 2 * front**-1.5)
    hiding = surge / (1 + np.tan(phase / 2) / width)
    root = np.sqrt(1 - w)
    h0, h = ((1 + 2 * x) / (1 + 2 * x * root) for x in (mu0, mu))
    smooth = w / 4 * mu0 / (mu0 + mu) * (single * (1 + hiding) + h0 * h - 1)
    return smooth * roughness(mu0, mu, cosg, theta_deg)


def lunar_lambert(mu0, mu, cosg, albedo, level=0.11):
    """McEwen (1991) with the mean of McEwen (1996) for the Moon, and a phase function of lunar steepness."""
    g = np.degrees(np.arccos(cosg))
    share = 1 - 0.019 * g + 2.42e-4 * g**2 - 1.46e-6 * g**3
    return albedo * level * _phase(cosg) * (share * 2 * mu0 / (mu0 + mu) + (1 - share) * mu0)


def akimov(mu0, mu, cosg, albedo, level=0.11):
    """The parameterless function of Akimov (Shkuratov et al. 2011, eq. 19), with the same phase function."""
    g = np.arccos(cosg)
    sine = np.sin(g)
    longitude = np.arctan2(mu0 / np.maximum(mu, 1e-6) - cosg, sine)  # photometric, from the direction of the camera
    latitude_cosine = np.clip(mu / np.maximum(np.cos(longitude), 1e-6), 0, 1)
    shape = np.cos(g / 2) * np.cos(np.pi / (np.pi - g) * (longitude - g / 2)) / np.maximum(np.cos(longitude), 1e-6)
    return albedo * level * _phase(cosg) * np.clip(shape, 0, None) * latitude_cosine ** (g / (np.pi - g))


def hapke_rough(mu0, mu, cosg, albedo):
    """Ground as rough as 35 deg and brighter than the mean Moon, as of highlands."""
    return hapke(mu0, mu, cosg, albedo, w=0.45, theta_deg=35.0)


def minnaert(mu0, mu, cosg, albedo, level=0.11):
    """Minnaert (1941), with an exponent that grows with phase as of the Moon (0.5 + 0.004 per degree)."""
    exponent = 0.5 + 0.004 * np.degrees(np.arccos(cosg))
    return albedo * level * _phase(cosg) * np.maximum(mu0, 1e-6) ** exponent * np.maximum(mu, 1e-6) ** (exponent - 1)


def lroc_2014(mu0, mu, cosg, albedo):
    """What the LROC team fitted to NAC images (ISIS lronacpho, LROC_Empirical of 2014)."""
    g = np.degrees(np.arccos(cosg))
    return albedo * np.exp(-2.9811422 - 0.0112862 * g - 0.8084603 * mu + 1.3248888 * mu0) * (mu0 > 0)


def lroc_2019(mu0, mu, cosg, albedo):
    """The LROC team's fit of 2019, on a Lommel-Seeliger base."""
    g = np.degrees(np.arccos(cosg))
    phase = -1.479654495 - 0.000083528 * g**2 + 0.012964707 * g - 0.237774774 * np.sqrt(g)
    tilt = 0.556075496 * mu + 0.663671460 * mu0 - 0.439918609 * mu0**2
    return albedo * mu0 / (mu0 + mu) * np.exp(phase + tilt)


def _phase(cosg):
    g = np.arccos(cosg)
    return np.exp(-0.6 * g) * (1 + 0.35 / (1 + np.tan(g / 2) / 0.06))


def roughness(mu0, mu, cosg, theta_deg):
    """Hapke's (1984, Icarus 59, 41) roughness relative to a smooth Lommel-Seeliger surface, from the paper's equations."""
    tangent = np.tan(np.radians(theta_deg))
    chi = 1 / np.sqrt(1 + np.pi * tangent**2)
    mu0, mu, cosg = np.broadcast_arrays(*(np.asarray(x, np.float64) for x in (mu0, mu, cosg)))
    sin_i, sin_e = (np.sqrt(np.clip(1 - x * x, 1e-12, None)) for x in (mu0, mu))
    psi = np.arccos(np.clip((cosg - mu0 * mu) / (sin_i * sin_e), -1, 1))
    between = np.exp(-2 * np.tan(np.minimum(psi, np.pi - 1e-6) / 2))
    cot_i, cot_e = mu0 / sin_i, mu / sin_e
    first = {k: np.exp(-2 / np.pi * c / tangent) for k, c in (("i", cot_i), ("e", cot_e))}
    second = {k: np.exp(-(c**2) / np.pi / tangent**2) for k, c in (("i", cot_i), ("e", cot_e))}
    share = psi / np.pi
    half = np.sin(psi / 2) ** 2

    def eta(cosine, sine, key):
        return chi * (cosine + sine * tangent * second[key] / (2 - first[key]))

    def effective(sun_lower: bool):
        """Effective cosines where the Sun stands lower than the camera (i >= e), and the other way round."""
        a, b = ("i", "e") if sun_lower else ("e", "i")
        below = 2 - first[a] - share * first[b]
        grazing = (second[a] - half * second[b]) / below
        other = (np.cos(psi) * second[a] + half * second[b]) / below
        sine_a, sine_b = (sin_i, sin_e) if sun_lower else (sin_e, sin_i)
        low = chi * ((mu0 if sun_lower else mu) + sine_a * tangent * grazing)
        high = chi * ((mu if sun_lower else mu0) + sine_b * tangent * other)
        return (low, high) if sun_lower else (high, low)

    lower = mu0 <= mu
    sun, view = (np.where(lower, a, b) for a, b in zip(effective(True), effective(False), strict=True))
    eta_i, eta_e = eta(mu0, sin_i, "i"), eta(mu, sin_e, "e")
    blocked = np.where(lower, mu / eta_e, mu0 / eta_i)  # of the smaller angle
    shadow = view / eta_e * mu0 / eta_i * chi / (1 - between + between * chi * blocked)
    return shadow * sun / (sun + view) * (mu0 + mu) / mu0


LAWS = {
    law.__name__: law for law in (linear, hapke, hapke_rough, lunar_lambert, akimov, minnaert, lroc_2014, lroc_2019)
}

__all__ = ["LAWS", "roughness"]
