"""Tables of position and pointing over time: reading them at any time, the way the USGS CSM cameras do.

Positions (Hermite between the entries, with their velocities) and pointing (slerp) are first brought to evenly spaced
times; between these, Lagrange polynomials of up to eighth order apply, of lower order towards the table's ends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from schemas.errors import InputError
from stages.common.arrays import Floats
from stages.physics.cameras import document as read

LEAST_NODES = 25  # of the even position table
_UNITS = {"m": 1.0, "km": 1000.0}


@dataclass(frozen=True)
class States:
    """Positions over time in an inertial frame.

    times : (n,), s; positions : (n, 3), m; velocities : (n, 3), m/s, or None where unknown
    """

    times: Floats
    positions: Floats
    velocities: Floats | None

    def at(self, times: ArrayLike) -> Floats:
        """(k, 3): cubic Hermite with velocities, else a natural cubic spline; one entry holds for all times."""
        times = np.asarray(times, float)
        n = len(self.times)
        if n == 1:
            return np.broadcast_to(self.positions[0], times.shape + (3,)).copy()
        velocities = self.velocities
        if velocities is None:
            # Half of the time of importing this package, for tables without velocities alone.
            from scipy.interpolate import CubicSpline

            velocities = CubicSpline(self.times, self.positions, bc_type="natural")(self.times, 1)
        i = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, n - 2)
        h = (self.times[i + 1] - self.times[i])[:, None]
        t = (times[:, None] - self.times[i][:, None]) / h
        return (
            (1 + 2 * t) * (1 - t) ** 2 * self.positions[i]
            + t * (1 - t) ** 2 * h * velocities[i]
            + t * t * (3 - 2 * t) * self.positions[i + 1]
            + t * t * (t - 1) * h * velocities[i + 1]
        )


@dataclass(frozen=True)
class Rotations:
    """Rotations over time, from an inertial frame.

    times : (n,), s; quaternions : (n, 4), scalar first, signs as :func:`align_signs` gives them
    constant : (3, 3), applied after them
    """

    times: Floats
    quaternions: Floats
    constant: Floats

    def at(self, times: ArrayLike) -> Floats:
        """(k, 3, 3): slerp between entries and beyond the ends; one entry holds for all times."""
        times = np.asarray(times, float)
        if len(self.times) == 1:
            quaternions = np.broadcast_to(self.quaternions[0], times.shape + (4,))
        else:
            quaternions = slerp(self.times, self.quaternions, times)
        return self.constant @ read.quaternion_matrix(quaternions)


class EvenTable(NamedTuple):
    """Values at evenly spaced times, as numba kernels take them. values : (n, k); ``start`` and ``step`` in s."""

    start: float
    step: float
    values: Floats

    def at(self, times: ArrayLike) -> Floats:
        """(..., k) at ``times`` by Lagrange polynomials."""
        times = np.asarray(times, float)
        out = np.empty((times.size, self.values.shape[1]))
        _lagrange_each(self, np.ascontiguousarray(times).ravel(), out)
        return out.reshape(times.shape + (-1,))


def read_states(document: Mapping[str, Any], key: str, where: str, origin: float) -> States:
    """An ISD's ``instrument_position`` or ``sun_position``; times count from ``origin``. Raises InputError."""
    times = _times(document, key, where)
    unit = str(read.value(document, f"{key}.unit", where) if read.has(document, f"{key}.unit") else "km").lower()
    if unit not in _UNITS:
        raise InputError(f"{where}: expected the unit m or km in '{key}.unit', found '{unit}'; correct the ISD.")
    positions = read.array(document, f"{key}.positions", where, (-1, 3)) * _UNITS[unit]
    velocities = None
    if read.has(document, f"{key}.velocities"):
        velocities = read.array(document, f"{key}.velocities", where, (-1, 3)) * _UNITS[unit]
    for name, table in (("positions", positions), ("velocities", velocities)):
        if table is not None and len(table) != len(times):
            raise InputError(
                f"{where}: expected {len(times)} entries in '{key}.{name}' as in its times, found {len(table)}; correct the ISD."
            )
    if velocities is not None and not velocities.any():
        velocities = None  # some writers fill what they do not know with zeros
    return States(times - origin, positions, velocities)


def read_rotations(document: Mapping[str, Any], key: str, where: str, origin: float) -> Rotations:
    """An ISD's ``instrument_pointing`` or ``body_rotation``. Raises InputError or GeometryError."""
    times = _times(document, key, where)
    quaternions = read.array(document, f"{key}.quaternions", where, (-1, 4))
    if len(quaternions) != len(times):
        raise InputError(
            f"{where}: expected {len(times)} entries in '{key}.quaternions' as in its times, found {len(quaternions)}; correct the ISD."
        )
    quaternions = read.check_quaternions(quaternions, f"{where}: '{key}.quaternions'")
    constant = np.eye(3)
    if read.has(document, f"{key}.constant_rotation"):
        constant = read.rotation(document, f"{key}.constant_rotation", where)
    return Rotations(times - origin, align_signs(quaternions), constant)


def _times(document: Mapping[str, Any], key: str, where: str) -> Floats:
    times = read.array(document, f"{key}.ephemeris_times", where, (-1,))
    if len(times) == 0 or (np.diff(times) <= 0).any():
        raise InputError(
            f"{where}: expected rising times in '{key}.ephemeris_times', found {len(times)} that do not; correct the ISD."
        )
    return times


def align_signs(quaternions: Floats) -> Floats:
    """The same rotations with signs such that neighbours are close: interpolation must not cross from q to -q.

    quaternions : (n, 4), scalar first
    """
    flip = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(-1) < 0, -1.0, 1.0))
    return np.concatenate([quaternions[:1], quaternions[1:] * flip[:, None]])


def slerp(times: Floats, quaternions: Floats, at: Floats) -> Floats:
    """Unit quaternions at times ``at``, great circles between the entries and continued beyond the ends.

    times : (n,) s, rising; quaternions : (n, 4) there; at : (k,) s; returns (k, 4)
    """
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    t = (at - times[i]) / (times[i + 1] - times[i])
    a, b = quaternions[i], quaternions[i + 1]
    # the chord keeps small angles exact, where arccos of the dot product would lose them
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(b - a, axis=-1) / 2, 0, 1))
    sine = np.sin(angle)
    close = sine < 1e-12
    sine = np.where(close, 1.0, sine)
    first = np.where(close, 1 - t, np.sin((1 - t) * angle) / sine)
    second = np.where(close, t, np.sin(t * angle) / sine)
    result = first[:, None] * a + second[:, None] * b
    return result / np.linalg.norm(result, axis=-1, keepdims=True)


def matrix_quaternions(rotations: Floats) -> Floats:
    """(n, 4) unit quaternions, scalar first, of (n, 3, 3) rotations (Shepperd's choice of the largest component)."""
    m = rotations
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = np.stack([trace, *(2 * m[:, k, k] - trace for k in range(3))], axis=1) + 1.0
    largest = squares.argmax(axis=1)
    products = np.empty((len(m), 4, 4))  # 4 q q^T
    for k in range(4):
        products[:, k, k] = squares[:, k]
    for i, j, axis in ((2, 1, 1), (0, 2, 2), (1, 0, 3)):
        products[:, 0, axis] = products[:, axis, 0] = m[:, i, j] - m[:, j, i]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        products[:, i + 1, j + 1] = products[:, j + 1, i + 1] = m[:, i, j] + m[:, j, i]
    rows = products[np.arange(len(m)), largest]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def even_positions(states: States, times: Floats, body: Rotations) -> EvenTable:
    """Body-fixed positions, m, on the even grid that the entries ``times`` span.

    times : (n,) s
    """
    if len(times) == 1:
        return EvenTable(float(times[0]), 1.0, (body.at(times) @ states.at(times)[..., None])[..., 0])
    grid = np.linspace(times[0], times[-1], max(LEAST_NODES, len(times)))
    values = (body.at(grid) @ states.at(grid)[..., None])[..., 0]
    return EvenTable(float(grid[0]), float(grid[1] - grid[0]), values)


def even_pointing(pointing: Rotations, body: Rotations) -> EvenTable:
    """Quaternions that take camera vectors to body-fixed ones, on an even grid of as many times as both tables hold."""
    times = pointing.times
    if len(times) > 1 and len(body.times) > 1:
        times = np.union1d(times, body.times)
    quaternions = matrix_quaternions(body.at(times) @ np.swapaxes(pointing.at(times), -1, -2))
    if len(times) == 1:
        return EvenTable(float(times[0]), 1.0, quaternions)
    grid = np.linspace(times[0], times[-1], len(times))
    return EvenTable(
        float(grid[0]), float(grid[1] - grid[0]), align_signs(slerp(times, align_signs(quaternions), grid))
    )


def check_times(where: str, key: str, times: Floats, first: float, last: float) -> None:
    """Refuse a table that does not cover an image's times. Raises InputError.

    Tables cut at the exposure may miss one step at either end, and at most a tenth of their span.

    times : (n,) s, of the table; first, last : s, of the image
    """
    if len(times) == 1:
        return
    slack = min(float(np.diff(times).max()), 0.1 * (times[-1] - times[0])) * (1 + 1e-6)
    if first < times[0] - slack or last > times[-1] + slack:
        raise InputError(
            f"{where}: expected '{key}' to cover the image's times {first:.3f}..{last:.3f} s from its middle, "
            f"found {times[0]:.3f}..{times[-1]:.3f} s; make the ISD again for this image."
        )


@numba.njit(cache=True)
def lagrange(table, time, out):
    """Write an EvenTable's values at ``time`` into ``out`` (k,): Lagrange polynomial of the 2..8 entries around it."""
    start, step, values = table
    n, k = values.shape
    if n == 1:
        for c in range(k):
            out[c] = values[0, c]
        return
    x = (time - start) / step
    index = min(max(int(x), 0), n - 2)
    tau = x - index
    half = min(4, index + 1, n - 1 - index)  # as many nodes before as after
    for c in range(k):
        out[c] = 0.0
    if half == 4:
        a, b, d, e = tau + 3, tau + 2, tau + 1, tau
        f, g, h, i = tau - 1, tau - 2, tau - 3, tau - 4
        ab, de, fg, hi = a * b, d * e, f * g, h * i
        abde, fghi = ab * de, fg * hi
        w0 = -b * de * fghi / 5040.0
        w1 = a * de * fghi / 720.0
        w2 = -ab * e * fghi / 240.0
        w3 = ab * d * fghi / 144.0
        w4 = -abde * g * hi / 144.0
        w5 = abde * f * hi / 240.0
        w6 = -abde * fg * i / 720.0
        w7 = abde * fg * h / 5040.0
        j = index - 3
        for c in range(k):
            out[c] = (
                w0 * values[j, c]
                + w1 * values[j + 1, c]
                + w2 * values[j + 2, c]
                + w3 * values[j + 3, c]
                + w4 * values[j + 4, c]
                + w5 * values[j + 5, c]
                + w6 * values[j + 6, c]
                + w7 * values[j + 7, c]
            )
        return
    for m in range(1 - half, half + 1):
        weight = 1.0
        for q in range(1 - half, half + 1):
            if q != m:
                weight *= (tau - q) / (m - q)
        for c in range(k):
            out[c] += weight * values[index + m, c]


@numba.njit(cache=True)
def _lagrange_each(table, times, out):
    for i in range(times.size):
        lagrange(table, times[i], out[i])
