"""What hidden ground does beyond its law, in forms other than the catalogue's: each is a factor on I/F.

The catalogue's parameters of the same world are not those given here but those of the nearest form in the catalogue;
``equivalents`` finds them by least squares, up to brightness.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

LOBE = 0.24  # asymmetry of the backward lobe that a steeper phase curve starts from (Sato et al. 2014, mean Moon)


def surge(cosg, B0, h):
    """An exponential peak at opposition (Buratti et al. 1996, Icarus 124, 490), as wide at half its height as Hapke's."""
    width = 2 * np.arctan(h) / np.log(2)
    return 1 + B0 * np.exp(-np.arccos(cosg) / width)


def steeper(cosg, per_radian):
    """A single-particle lobe (Henyey and Greenstein 1941) that is longer, so that brightness falls faster with phase."""
    ends = np.cos([0.3, 1.5])

    def excess(lobe):
        first, last = np.log(_lobe(ends, lobe) / _lobe(ends, LOBE))
        return (first - last) / 1.2 - per_radian

    lobe = brentq(excess, -0.9, 0.9)
    return _lobe(cosg, lobe) / _lobe(cosg, LOBE)


def _lobe(cosg, lobe):
    return (1 - lobe**2) / (1 - 2 * lobe * cosg + lobe**2) ** 1.5


def limb(mu0, mu, share):
    """Minnaert's (1941) exponent lowered: grazing light and views lose less."""
    return (np.maximum(mu0, 1e-3) * np.maximum(mu, 1e-3)) ** (-0.6 * share)


def lineated(sun, east, north):
    """Lee and stoss slopes of bedforms too small for the DEM, one side brighter: stronger under a low Sun."""
    return 1 + 0.9 * (east * sun[0] + north * sun[1]) / (sun[2] + 0.3)


def equivalents(effect: dict, samples: list[tuple]) -> dict[str, float]:
    """Effect -> its first parameter in the catalogue's form, for these lit pixels.

    samples : per image (mu0, mu, cosg, sun, base); (n,) cosines, I/F of the law
    """
    found = {}
    for name in FORMS.keys() & effect.keys():
        given = effect[name]
        target, columns, weights = [], [], []
        for mu0, mu, cosg, sun, base in samples:
            target.append(np.log(factor(name, given, mu0, mu, cosg, sun) + 0 * mu0))
            columns.append(np.stack([FORMS[name](mu0, mu, cosg, sun, given) + 0 * mu0, 1 + 0 * mu0], 1))
            weights.append(np.sqrt(base))
        w = np.concatenate(weights)[:, None]
        solved = np.linalg.lstsq(np.concatenate(columns) * w, np.concatenate(target) * w[:, 0], rcond=None)[0]
        found[name] = float(solved[0])
    return found


def factor(name, given, mu0, mu, cosg, sun):
    """The departure ``name`` with its planted parameters, (n,) or a number."""
    if name == "opposition_surge":
        return surge(cosg, given["B0"], given["h"])
    if name == "phase_slope":
        return steeper(cosg, given["per_radian"])
    if name == "limb_darkening":
        return limb(mu0, mu, given["share"])
    return lineated(sun, given["east"], given["north"])


# how the logarithm of I/F changes with the first parameter of the catalogue's own form (../shared/diagnosis.md)
FORMS = {
    "opposition_surge": lambda mu0, mu, cosg, sun, given: 1 / (1 + np.tan(np.arccos(cosg) / 2) / given["h"]),
    "phase_slope": lambda mu0, mu, cosg, sun, given: -np.arccos(cosg),
    "limb_darkening": lambda mu0, mu, cosg, sun, given: 2 / (mu0 + mu) - 1,
    "azimuthal_anisotropy": lambda mu0, mu, cosg, sun, given: (
        (sun[0] + sun[1] * given["north"] / given["east"]) / np.hypot(sun[0], sun[1])
    ),
}

__all__ = ["FORMS", "equivalents", "factor"]
