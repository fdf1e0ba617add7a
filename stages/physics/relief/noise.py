"""Fractal noise that is a function of place: any block of any scene, in any order, gives the same values.

Gradient noise (Perlin 1985, 2002) summed over octaves whose amplitude grows as wavelength^hurst, each turned and shifted
against the last so that no lattice shows. Every value depends on (x, y, seed) only: scenes of any size stream.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from stages.common.arrays import Floats32

LACUNARITY = 1.87  # not 2: octaves must not share lattice lines
TURN = 0.655  # rad between octaves
UNIT_STD = 0.26  # standard deviation of one octave of unit-gradient noise, by integration over the unit square


@njit(inline="always")
def _hash(ix, iy, seed):
    h = (
        np.uint32(ix) * np.uint32(0x9E3779B1)
        ^ np.uint32(iy) * np.uint32(0x85EBCA77)
        ^ np.uint32(seed) * np.uint32(0xC2B2AE3D)
    )
    h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return h


_ANGLES = np.arange(256) * (2 * math.pi / 256)
_GX, _GY = np.cos(_ANGLES), np.sin(_ANGLES)
_SIDES = (-1.0, 1.0)
_EDGES = np.array(  # of a cube: gradients in space
    [e for a in _SIDES for b in _SIDES for e in ((0.0, a, b), (a, 0.0, b), (a, b, 0.0))]
)


@njit(inline="always")
def _corner(ix, iy, seed, dx, dy):
    k = _hash(ix, iy, seed) & np.uint32(255)
    return _GX[k] * dx + _GY[k] * dy


@njit(fastmath=True)
def gradient_noise(x, y, seed):
    """One octave at (x, y) in lattice cells; zero mean, standard deviation UNIT_STD."""
    fx, fy = math.floor(x), math.floor(y)
    ix, iy = int(fx), int(fy)
    u, v = x - fx, y - fy
    a = _corner(ix, iy, seed, u, v)
    b = _corner(ix + 1, iy, seed, u - 1.0, v)
    c = _corner(ix, iy + 1, seed, u, v - 1.0)
    d = _corner(ix + 1, iy + 1, seed, u - 1.0, v - 1.0)
    s = u * u * u * (u * (6.0 * u - 15.0) + 10.0)
    t = v * v * v * (v * (6.0 * v - 15.0) + 10.0)
    top = a + s * (b - a)
    return top + t * (c + s * (d - c) - top)


@njit(inline="always")
def _corner3(ix, iy, iz, seed, dx, dy, dz):
    k = _hash(ix, iy, seed + iz * 7919) % np.uint32(12)
    return _EDGES[k, 0] * dx + _EDGES[k, 1] * dy + _EDGES[k, 2] * dz


@njit(fastmath=True)
def gradient_noise3(x, y, z, seed):
    """One octave in space at (x, y, z) in lattice cells; zero mean (Perlin 2002)."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    s = u * u * u * (u * (6.0 * u - 15.0) + 10.0)
    t = v * v * v * (v * (6.0 * v - 15.0) + 10.0)
    q = w * w * w * (w * (6.0 * w - 15.0) + 10.0)
    total = 0.0
    for k in range(2):
        a = _corner3(ix, iy, iz + k, seed, u, v, w - k)
        b = _corner3(ix + 1, iy, iz + k, seed, u - 1.0, v, w - k)
        c = _corner3(ix, iy + 1, iz + k, seed, u, v - 1.0, w - k)
        d = _corner3(ix + 1, iy + 1, iz + k, seed, u - 1.0, v - 1.0, w - k)
        top = a + s * (b - a)
        total += (q if k else 1.0 - q) * (top + t * (c + s * (d - c) - top))
    return total


@njit(parallel=True, fastmath=True, cache=True)
def _fractal(out, x0, y0, step, longest, shortest, hurst, seed):
    height, width = out.shape
    for r in prange(height):
        for c in range(width):
            out[r, c] = 0.0
        wavelength, turn, octave = longest, 0.0, 0
        while wavelength >= shortest:
            ct, st = math.cos(turn), math.sin(turn)
            amplitude = (wavelength / longest) ** hurst / UNIT_STD
            # the last octaves fade instead of ending, so that a finer grid adds nothing to a coarser one abruptly
            amplitude *= min(1.0, (wavelength / shortest - 1.0) / (LACUNARITY - 1.0))
            key = seed * 131 + octave
            ox, oy = 17.31 * (octave + 1), -9.77 * (octave + 1)
            y = y0 - r * step
            for c in range(width):
                x = x0 + c * step
                u = (ct * x - st * y) / wavelength + ox
                v = (st * x + ct * y) / wavelength + oy
                out[r, c] += np.float32(amplitude * gradient_noise(u, v, key))
            wavelength /= LACUNARITY
            turn += TURN
            octave += 1


def fractal(
    shape: tuple[int, int],
    x0: float,
    y0: float,
    step: float,
    *,
    longest: float,
    shortest: float,
    hurst: float,
    seed: int,
) -> Floats32:
    """Fractal noise at the pixel centres of a block whose first centre is (x0, y0), m; rows run south.

    The octave of wavelength ``longest`` has standard deviation 1, others (wavelength / longest)^hurst: a surface with
    that Hurst exponent. Octaves shorter than ``shortest`` are left out.
    """
    out = np.empty(shape, np.float32)
    _fractal(out, float(x0), float(y0), float(step), float(longest), float(shortest), float(hurst), int(seed))
    return out
