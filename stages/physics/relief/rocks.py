"""Rocks: how many of which size lie on the ground, and how high they stand.

A share F(D) = k exp(-q D) of the ground is covered by rocks of diameter D (m) or more, with q = 1.79 + 0.152 / k, and k the share
that all rocks cover (Golombek & Rapp 1997, J. Geophys. Res. 102, 4117). A rock of diameter D covers pi D^2 / 4.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FEWEST = 1e-10  # rocks per m2 that are worth looking for
HEIGHT = 0.5  # of the diameter: half of a ball that lies on the ground up to its middle


def rock_density(diameter: NDArray | float, abundance: float) -> NDArray:
    """Rocks larger than ``diameter`` (m) per m2: the integral of -dF / (pi D^2 / 4). diameter : (n,) or a number"""
    from scipy.special import exp1

    d, q = np.asarray(diameter, float), 1.79 + 0.152 / abundance
    return 4 * abundance * q / math.pi * np.maximum(np.exp(-q * d) / d - q * exp1(q * d), 0.0)


def largest_rock(abundance: float) -> float:
    """Diameter above which there are FEWEST rocks, m."""
    d = np.geomspace(0.01, 100.0, 400)
    return float(d[np.argmax(rock_density(d, abundance) < FEWEST)])


def rock_diameters(share: NDArray, low: float, high: float, abundance: float) -> NDArray:
    """Diameters between two, m, as the law distributes them; share : (n,) 0 gives ``low``, 1 gives ``high``."""
    d = np.geomspace(low, high, 64)
    n = rock_density(d, abundance)
    return np.interp(share, (n[0] - n) / max(n[0] - n[-1], 1e-300), d)


@njit(cache=True)
def add_rocks(elevation, x0, y0, step, x, y, diameter):
    """Add half balls to heights (H, W), m; the first pixel's centre is (x0, y0), rows run south; x, y, diameter : (n,) m."""
    height, width = elevation.shape
    for k in range(len(x)):
        radius = 0.5 * diameter[k]
        r0, r1 = int(math.ceil((y0 - y[k] - radius) / step)), int(math.floor((y0 - y[k] + radius) / step)) + 1
        c0, c1 = int(math.ceil((x[k] - radius - x0) / step)), int(math.floor((x[k] + radius - x0) / step)) + 1
        for r in range(max(0, r0), min(height, r1)):
            for c in range(max(0, c0), min(width, c1)):
                dx, dy = x0 + c * step - x[k], y0 - r * step - y[k]
                inside = radius * radius - dx * dx - dy * dy
                if inside > 0.0:
                    elevation[r, c] += np.float32(2.0 * HEIGHT * math.sqrt(inside))
