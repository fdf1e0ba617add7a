"""Lens distortion in the focal plane, by the names that ISDs use.

Each model gives undistorted from distorted focal-plane millimetres or the other way round, whichever its instrument
kernel defines; the inverse is closed or iterated to 1e-12 of the focal plane's size.

radial      (k0, k1, k2)  u = d (1 - (k0 + k1 r^2 + k2 r^4)), r = |d|
transverse  (20)          d = two cubic polynomials in u: 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3
lrolrocnac  (k)           u_y = d_y / (1 + k d_y^2), u_x = d_x         (LROC instrument kernel)
dawnfc      (k)           d = u (1 + k |u|^2)                          (Dawn Framing Camera kernel)
kaguyalism  (10)          u = d + b + a0 + a1 r + a2 r^2 + a3 r^3 per axis  (Kaguya LISM kernels)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, RegistryError
from stages.physics.cameras import document as read

NONE, RADIAL, TRANSVERSE, LRO_NAC, DAWN_FC, KAGUYA_LISM = range(6)
_LENGTHS = {"radial": (RADIAL, 3), "lrolrocnac": (LRO_NAC, 1), "dawnfc": (DAWN_FC, 1)}
NAMES = ("radial", "transverse", "lrolrocnac", "dawnfc", "kaguyalism")


def read_distortion(document: Mapping[str, Any], where: str) -> tuple[int, NDArray[np.float64]]:
    """(model code, coefficients) of an ISD's ``optical_distortion``. Raises InputError or RegistryError."""
    models = read.value(document, "optical_distortion", where)
    if not isinstance(models, Mapping) or len(models) != 1:
        raise InputError(f"{where}: expected one model in 'optical_distortion', found {models!r:.80}; correct the ISD.")
    name = next(iter(models))
    key = f"optical_distortion.{name}"
    lowered = str(name).lower()
    if lowered == "transverse":
        return TRANSVERSE, np.concatenate([read.array(document, f"{key}.{axis}", where, (10,)) for axis in "xy"])
    if lowered == "kaguyalism":
        axes = [
            np.append(
                read.number(document, f"{key}.boresight_{axis}", where),
                read.array(document, f"{key}.{axis}", where, (4,)),
            )
            for axis in "xy"
        ]
        return KAGUYA_LISM, np.concatenate(axes)
    if lowered not in _LENGTHS:
        raise RegistryError(f"{where}: {RegistryError.unknown('distortion model', lowered, NAMES)}")
    code, length = _LENGTHS[lowered]
    return code, read.array(document, f"{key}.coefficients", where, (length,))


@numba.njit(cache=True)
def undistort(model, k, dx, dy):
    """Undistorted focal-plane place (mm) of a distorted one."""
    if model == LRO_NAC:
        return dx, dy / (1.0 + k[0] * dy * dy)
    if model == RADIAL:
        r2 = dx * dx + dy * dy
        scale = 1.0 - (k[0] + r2 * (k[1] + r2 * k[2]))
        return dx * scale, dy * scale
    if model == KAGUYA_LISM:
        r = math.sqrt(dx * dx + dy * dy)
        ux = dx + k[0] + k[1] + r * (k[2] + r * (k[3] + r * k[4]))
        uy = dy + k[5] + k[6] + r * (k[7] + r * (k[8] + r * k[9]))
        return ux, uy
    if model == DAWN_FC:
        d = math.sqrt(dx * dx + dy * dy)
        u = d
        for _ in range(30):  # Newton on u (1 + k u^2) = d
            step = (u * (1.0 + k[0] * u * u) - d) / (1.0 + 3.0 * k[0] * u * u)
            u -= step
            if abs(step) < 1e-14 * (1.0 + d):
                break
        scale = u / d if d > 0 else 1.0
        return dx * scale, dy * scale
    if model == TRANSVERSE:
        ux, uy = dx, dy
        for _ in range(60):  # Newton on both axes
            x, y = _cubic(k, 0, ux, uy), _cubic(k, 10, ux, uy)
            xx, xy = _cubic_slopes(k, 0, ux, uy)
            yx, yy = _cubic_slopes(k, 10, ux, uy)
            determinant = xx * yy - xy * yx
            if abs(determinant) < 1e-6:  # no inverse there: left as it is, as USGSCSM does
                return ux, uy
            sx = (yy * (dx - x) - xy * (dy - y)) / determinant
            sy = (xx * (dy - y) - yx * (dx - x)) / determinant
            ux += sx
            uy += sy
            if abs(sx) + abs(sy) < 1e-13 * (1.0 + abs(ux) + abs(uy)):
                break
        return ux, uy
    return dx, dy


@numba.njit(cache=True)
def distort(model, k, ux, uy):
    """Distorted focal-plane place (mm) of an undistorted one: the inverse of :func:`undistort`."""
    if model == LRO_NAC:  # k uy dy^2 - dy + uy = 0
        under = 1.0 - 4.0 * k[0] * uy * uy
        return ux, 2.0 * uy / (1.0 + math.sqrt(under)) if under >= 0 else math.nan
    if model == RADIAL:
        u = math.sqrt(ux * ux + uy * uy)
        d = u
        for _ in range(30):  # Newton on d (1 - k0 - k1 d^2 - k2 d^4) = u
            d2 = d * d
            slope = 1.0 - k[0] - d2 * (3.0 * k[1] + 5.0 * d2 * k[2])
            step = (d * (1.0 - (k[0] + d2 * (k[1] + d2 * k[2]))) - u) / slope
            d -= step
            if abs(step) < 1e-14 * (1.0 + u):
                break
        scale = d / u if u > 0 else 1.0
        return ux * scale, uy * scale
    if model == DAWN_FC:
        scale = 1.0 + k[0] * (ux * ux + uy * uy)
        return ux * scale, uy * scale
    if model == TRANSVERSE:
        return _cubic(k, 0, ux, uy), _cubic(k, 10, ux, uy)
    if model == KAGUYA_LISM:
        dx, dy = ux, uy
        for _ in range(60):  # the shift hardly depends on the place, so that a fixed point is reached fast
            x, y = undistort(model, k, dx, dy)
            dx += ux - x
            dy += uy - y
            if abs(ux - x) + abs(uy - y) < 1e-13 * (1.0 + abs(ux) + abs(uy)):
                break
        return dx, dy
    return ux, uy


@numba.njit(cache=True)
def _cubic(k, at, x, y):
    return (
        k[at]
        + x * (k[at + 1] + x * (k[at + 3] + x * k[at + 6]) + y * (k[at + 4] + x * k[at + 7] + y * k[at + 8]))
        + y * (k[at + 2] + y * (k[at + 5] + y * k[at + 9]))
    )


@numba.njit(cache=True)
def _cubic_slopes(k, at, x, y):
    by_x = k[at + 1] + x * (2 * k[at + 3] + 3 * x * k[at + 6]) + y * (k[at + 4] + 2 * x * k[at + 7] + y * k[at + 8])
    by_y = k[at + 2] + x * (k[at + 4] + x * k[at + 7] + 2 * y * k[at + 8]) + y * (2 * k[at + 5] + 3 * y * k[at + 9])
    return by_x, by_y


@numba.njit(cache=True)
def _each(model, k, x, y, forward, out_x, out_y):
    for i in range(x.size):
        out_x[i], out_y[i] = distort(model, k, x[i], y[i]) if forward else undistort(model, k, x[i], y[i])


def undistort_arrays(model: int, k: NDArray, dx: NDArray, dy: NDArray) -> tuple[NDArray, NDArray]:
    """:func:`undistort` for arrays.

    dx, dy : (...,) mm; k : (m,) coefficients of the model; returns (...,) each
    """
    return _arrays(model, k, dx, dy, False)


def distort_arrays(model: int, k: NDArray, ux: NDArray, uy: NDArray) -> tuple[NDArray, NDArray]:
    """:func:`distort` for arrays.

    ux, uy : (...,) mm; k : (m,) coefficients of the model; returns (...,) each
    """
    return _arrays(model, k, ux, uy, True)


def _arrays(model: int, k: NDArray, x: NDArray, y: NDArray, forward: bool) -> tuple[NDArray, NDArray]:
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    out_x, out_y = np.empty(x.size), np.empty(x.size)
    _each(model, k, np.ascontiguousarray(x).ravel(), np.ascontiguousarray(y).ravel(), forward, out_x, out_y)
    return out_x.reshape(x.shape), out_y.reshape(x.shape)
