"""Lens distortion in the focal plane, by the names that ISDs use and those that ISIS kernels and OpenCV define.

Each model is closed in one direction, as its instrument's kernel defines it; :func:`_solve` inverts it to 1e-13 of the focal
plane's size. Places are millimetres, d distorted and u undistorted, r their distance from the model's centre.

radial          (k0, k1, k2)  u = d (1 - (k0 + k1 r^2 + k2 r^4)); one coefficient k: u = d (1 - k r^2)
transverse      (20)          d = two cubic polynomials in u: 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3
lrolrocnac      (k)           u_y = d_y / (1 + k d_y^2), u_x = d_x         (LROC instrument kernel)
kplo_shadowcam  (k)           u_y = d_y (1 + k d_y^2), u_x = d_x           (ShadowCam instrument kernel)
dawnfc          (k)           d = u (1 + k r^2)                            (Dawn Framing Camera kernel)
kaguyalism      (10)          u = d + b + a0 + a1 r + a2 r^2 + a3 r^3 per axis  (Kaguya LISM kernels)
lunarorbiter    (px, py, x0, y0, k0, k1)  p = d (1 + px d_x + py d_y), u = p - (p - c)(k0 + k1 r^2)  (Lunar Orbiter High)
radtan          (k1, k2, p1, p2[, k3[, k4, k5, k6]])  OpenCV's Brown-Conrady, in u / f
fisheye         (k1, k2, k3, k4)                      OpenCV's fisheye, in u / f
metric          (x0, y0, k1, k2, k3, j1, j2, t0)  u = (d - c)(1 + k1 r^2 + k2 r^4 + k3 r^6) + (j1 r^2 + j2 r^4)(-sin t0, cos t0)
                                                      (Apollo Metric kernels)
uvvis           (x0, y0, k0, k1, k2, p1, p2)  u = d + (d - c)(k0 + k1 r^2 + k2 r^4) + Brown's decentring  (Clementine UVVIS)
centred         (x0, y0, k0, k1, k2)  d = u + (u - c)(k0 + k1 r^2 + k2 r^4)  (Lunar Orbiter Medium)
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

NONE, RADIAL, LRO_NAC, SHADOWCAM, KAGUYA_LISM, LUNAR_ORBITER, METRIC, UVVIS = range(8)  # give u from d
TRANSVERSE, DAWN_FC, RADTAN, FISHEYE, CENTRED = range(8, 13)  # give d from u
_REMOVING = UVVIS  # the last of the models that give u from d

# name in an ISD -> its code and how many coefficients it may have
_LENGTHS = {
    "radial": (RADIAL, (1, 3)),
    "lrolrocnac": (LRO_NAC, (1,)),
    "kplo_shadowcam": (SHADOWCAM, (1,)),
    "dawnfc": (DAWN_FC, (1,)),
    "radtan": (RADTAN, (4, 5, 8)),
    "fisheye": (FISHEYE, (4,)),
    "metric": (METRIC, (8,)),
    "uvvis": (UVVIS, (7,)),
    "centred": (CENTRED, (5,)),
}
NAMES = (*_LENGTHS, "transverse", "kaguyalism", "lunarorbiter")


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
    if lowered == "lunarorbiter":
        names = ("perspective_x", "perspective_y", "center_point_x", "center_point_y")
        first = [read.number(document, f"{key}.{part}", where) for part in names]
        return LUNAR_ORBITER, np.concatenate([first, _lunar_orbiter_radial(document, where)])
    if lowered == "cahvor":
        raise InputError(f"{where}: expected a camera in orbit, found a CAHVOR model, which rovers and landers have.")
    if lowered not in _LENGTHS:
        raise RegistryError(f"{where}: {RegistryError.unknown('distortion model', lowered, NAMES)}")
    code = _LENGTHS[lowered][0]
    scale = read.number(document, "focal_length_model.focal_length", where) if code in (RADTAN, FISHEYE) else 1.0
    return code, pack(code, read.array(document, f"{key}.coefficients", where, (-1,)), f"{where}: '{key}'", scale)


def pack(code: int, coefficients: NDArray[np.float64], where: str, scale: float = 1.0) -> NDArray[np.float64]:
    """(m,) coefficients of a model as the kernels take them, none left out. Raises InputError for another number of them.

    coefficients : (k,); scale : what OpenCV's models divide focal-plane places by: the focal length, or 1 where these are tangents already
    """
    lengths = next(n for c, n in _LENGTHS.values() if c == code)
    if len(coefficients) not in lengths:
        numbers = " or ".join(str(n) for n in lengths)
        raise InputError(f"{where}: expected {numbers} coefficients, found {len(coefficients)}; mend the camera model.")
    if code == RADIAL and len(coefficients) == 1:
        return np.array([0.0, coefficients[0], 0.0])
    if code in (RADTAN, FISHEYE):
        return np.concatenate([coefficients, np.zeros(8 - len(coefficients)), [scale]])
    return coefficients


def _lunar_orbiter_radial(document: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """k0 and k1: ALE leaves them among the kernel's keywords."""
    if read.has(document, "optical_distortion.lunarorbiter.coefficients"):
        return read.array(document, "optical_distortion.lunarorbiter.coefficients", where, (-1,))[:2]
    keywords = document.get("naif_keywords", {})
    key = next((k for k in keywords if str(k).endswith("_OD_K")), None)
    if key is None:
        raise InputError(
            f"{where}: expected 'optical_distortion.lunarorbiter.coefficients' or INS..._OD_K in 'naif_keywords', found "
            "neither; make the ISD again."
        )
    return read.array(keywords, key, f"{where}: 'naif_keywords'", (-1,))[:2]


@numba.njit(cache=True)
def _closed(model, k, x, y):
    """The direction in which a model is defined: u of d (mm) up to UVVIS, d of u from TRANSVERSE on."""
    if model == RADIAL:
        r2 = x * x + y * y
        scale = 1.0 - (k[0] + r2 * (k[1] + r2 * k[2]))
        return x * scale, y * scale
    if model == LRO_NAC:
        return x, y / (1.0 + k[0] * y * y)
    if model == SHADOWCAM:
        return x, y * (1.0 + k[0] * y * y)
    if model == KAGUYA_LISM:
        r = math.sqrt(x * x + y * y)
        ux = x + k[0] + k[1] + r * (k[2] + r * (k[3] + r * k[4]))
        uy = y + k[5] + k[6] + r * (k[7] + r * (k[8] + r * k[9]))
        return ux, uy
    if model == LUNAR_ORBITER:
        perspective = 1.0 + k[0] * x + k[1] * y
        px, py = x * perspective, y * perspective
        cx, cy = px - k[2], py - k[3]
        scale = k[4] + k[5] * (cx * cx + cy * cy)
        return px - scale * cx, py - scale * cy
    if model == METRIC:
        cx, cy = x - k[0], y - k[1]
        r2 = cx * cx + cy * cy
        scale = 1.0 + r2 * (k[2] + r2 * (k[3] + r2 * k[4]))
        aside = r2 * (k[5] + r2 * k[6])
        return cx * scale - aside * math.sin(k[7]), cy * scale + aside * math.cos(k[7])
    if model == UVVIS:
        cx, cy = x - k[0], y - k[1]
        r2 = cx * cx + cy * cy
        scale = k[2] + r2 * (k[3] + r2 * k[4])
        tx = k[5] * (r2 + 2.0 * cx * cx) + 2.0 * k[6] * cx * cy
        ty = 2.0 * k[5] * cx * cy + k[6] * (r2 + 2.0 * cy * cy)
        return x + cx * scale + tx, y + cy * scale + ty
    if model == TRANSVERSE:
        return _cubic(k, 0, x, y), _cubic(k, 10, x, y)
    if model == DAWN_FC:
        scale = 1.0 + k[0] * (x * x + y * y)
        return x * scale, y * scale
    if model == RADTAN:
        a, b = x / k[8], y / k[8]
        r2 = a * a + b * b
        scale = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        dx = a * scale + 2.0 * k[2] * a * b + k[3] * (r2 + 2.0 * a * a)
        dy = b * scale + k[2] * (r2 + 2.0 * b * b) + 2.0 * k[3] * a * b
        return dx * k[8], dy * k[8]
    if model == FISHEYE:
        r = math.sqrt(x * x + y * y) / abs(k[8])
        theta = math.atan(r)
        t2 = theta * theta
        scale = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r if r > 0 else 1.0
        return x * scale, y * scale
    if model == CENTRED:
        cx, cy = x - k[0], y - k[1]
        r2 = cx * cx + cy * cy
        scale = k[2] + r2 * (k[3] + r2 * k[4])
        return x + cx * scale, y + cy * scale
    return x, y


@numba.njit(cache=True)
def _solve(model, k, x, y):
    """The inverse of :func:`_closed`, by Newton's method with differences for its slopes.

    Where there is none the place is left as it is, as USGSCSM does: such places lie off any detector.
    """
    a, b = x, y
    size = 1.0 + abs(x) + abs(y)
    h = 1e-6 * size
    for _ in range(60):
        fx, fy = _closed(model, k, a, b)
        gx, gy = _closed(model, k, a + h, b)
        qx, qy = _closed(model, k, a, b + h)
        xx, yx, xy, yy = (gx - fx) / h, (gy - fy) / h, (qx - fx) / h, (qy - fy) / h
        determinant = xx * yy - xy * yx
        if not abs(determinant) > 1e-6:
            return x, y
        sx = (yy * (x - fx) - xy * (y - fy)) / determinant
        sy = (xx * (y - fy) - yx * (x - fx)) / determinant
        a += sx
        b += sy
        if abs(sx) + abs(sy) < 1e-13 * size:
            return a, b
    return (a, b) if abs(sx) + abs(sy) < 1e-9 * size else (x, y)


@numba.njit(cache=True)
def undistort(model, k, dx, dy):
    """Undistorted focal-plane place (mm) of a distorted one."""
    if model == NONE:
        return dx, dy
    return _closed(model, k, dx, dy) if model <= _REMOVING else _solve(model, k, dx, dy)


@numba.njit(cache=True)
def distort(model, k, ux, uy):
    """Distorted focal-plane place (mm) of an undistorted one: the inverse of :func:`undistort`."""
    if model == NONE:
        return ux, uy
    if model == LRO_NAC:  # k uy dy^2 - dy + uy = 0
        under = 1.0 - 4.0 * k[0] * uy * uy
        return ux, 2.0 * uy / (1.0 + math.sqrt(under)) if under >= 0 else math.nan
    return _solve(model, k, ux, uy) if model <= _REMOVING else _closed(model, k, ux, uy)


@numba.njit(cache=True)
def _cubic(k, at, x, y):
    return (
        k[at]
        + x * (k[at + 1] + x * (k[at + 3] + x * k[at + 6]) + y * (k[at + 4] + x * k[at + 7] + y * k[at + 8]))
        + y * (k[at + 2] + y * (k[at + 5] + y * k[at + 9]))
    )


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
