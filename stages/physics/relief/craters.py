"""Craters: how many of which size and age, what a fresh one looks like, and how diffusion wears it down.

Sources of the numbers. Production: cumulative slope -3 below a kilometre (Neukum et al. 2001, NPF between 100 m and 1 km).
Equilibrium: N(>D) = 10^-1.1 D^-2 per km2, D in km (Trask 1966; Xiao & Werner 2015). Simple craters: rim height 0.036 D,
depth 0.196 D from rim to floor (Pike 1977). Ejecta thins as (r/R)^-3 (McGetchin et al. 1973). Old craters are fresh ones
after topographic diffusion (Soderblom 1970; Fassett & Thomson 2014), here in units K = kappa t / R^2.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from stages.common.arrays import Floats32
from stages.physics.relief.noise import gradient_noise

EQUILIBRIUM_PER_KM2 = 10**-1.1  # craters > 1 km per km2, cumulative slope -2
PRODUCTION_SLOPE, EQUILIBRIUM_SLOPE = 3.0, 2.0
DEPTH, RIM = 0.196, 0.036  # of the diameter, fresh
FLOOR, WALL = 0.10, 1.70  # radius of the flat floor; slope of the wall, in depths per radius
WORN_OUT = 0.38  # K at which a crater no longer counts: a fresh bowl is then about 0.03 D deep
REACH = 4.0  # radii that topography extends to
EJECTA_REACH = 9.0  # radii that bright ejecta of young craters extends to
STATES, SAMPLES = 40, 320  # of the table of worn profiles
YOUNG = 0.12  # share of the lifetime during which ejecta stays bright


@dataclass(frozen=True)
class Craters:
    """A population, largest first.

    x, y, diameter : (n,) m; age : (n,) 0 fresh .. 1 worn out, as a share of the lifetime of its size;
    depth_factor : (n,) scatter of the depth; seed : (n,) shape
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    diameter: NDArray[np.float64]
    age: NDArray[np.float64]
    depth_factor: NDArray[np.float64]
    seed: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.x)

    def select(self, keep: NDArray) -> Craters:
        """Those that ``keep``, (n,) bool or indices, names."""
        return Craters(
            *(a[keep] for a in (self.x, self.y, self.diameter, self.age, self.depth_factor, self.seed)),
        )


def cumulative_density(diameter: NDArray | float, density: float, transition: float) -> NDArray:
    """Craters larger than ``diameter`` (m) per m2: equilibrium below ``transition`` (m), production above.

    diameter : (n,) or a number
    """
    d = np.asarray(diameter, float)
    at_transition = density * EQUILIBRIUM_PER_KM2 * (transition / 1000.0) ** -EQUILIBRIUM_SLOPE * 1e-6
    slope = np.where(d < transition, EQUILIBRIUM_SLOPE, PRODUCTION_SLOPE)
    return at_transition * (d / transition) ** -slope


def diameters(share: NDArray, low: float, high: float, density: float, transition: float) -> NDArray:
    """Diameters between two, m, as the law distributes them; share : (n,) 0 gives ``low``, 1 gives ``high``."""
    many, few, middle = (float(cumulative_density(d, density, transition)) for d in (low, high, transition))
    n = (many - share * (many - few)) / middle
    return transition * np.where(n > 1, n ** (-1 / EQUILIBRIUM_SLOPE), n ** (-1 / PRODUCTION_SLOPE))


def depth_factors(scatter: NDArray, diameter: NDArray) -> NDArray:
    """Depths over those of large fresh craters; scatter, diameter : (n,) about 1, m.

    Shallower and more scattered when small: regolith targets and secondaries (Stopar et al. 2017).
    """
    return np.clip(scatter, 0.7, 1.15) * (1 - 0.22 / (1 + (diameter / 150.0) ** 2))


def populate(
    bounds: tuple[float, float, float, float],
    smallest: float,
    largest: float,
    density: float,
    transition: float,
    rng: np.random.Generator,
) -> Craters:
    """Draw craters over ``bounds`` (left, bottom, right, top, m) and remove those that younger larger ones buried.

    Below the transition every state of decay is equally common (equilibrium); above it the surface is too young for
    the old states to exist.
    """
    left, bottom, right, top = bounds
    sizes = []
    # the margin outside grows with the size, so that small craters are not drawn where they cannot be seen
    edges = np.geomspace(smallest, largest, 25)
    xs, ys = [], []
    for low, high in itertools.pairwise(edges):
        margin = REACH * high / 2
        area = (right - left + 2 * margin) * (top - bottom + 2 * margin)
        many, few = (float(cumulative_density(d, density, transition)) for d in (low, high))
        count = rng.poisson((many - few) * area)
        sizes.append(diameters(rng.random(count), low, high, density, transition))
        xs.append(rng.uniform(left - margin, right + margin, count))
        ys.append(rng.uniform(bottom - margin, top + margin, count))
    diameter, x, y = np.concatenate(sizes), np.concatenate(xs), np.concatenate(ys)
    order = np.argsort(-diameter, kind="stable")
    diameter, x, y = diameter[order], x[order], y[order]
    age = rng.random(len(x)) * np.minimum(1.0, transition / diameter)
    depth_factor = depth_factors(rng.normal(1.0, 0.08, len(x)), diameter)
    craters = Craters(x, y, diameter, age, depth_factor, rng.integers(1, 2**30, len(x)))
    absolute = age * diameter  # lifetimes grow with size: the time since the impact on one clock
    return craters.select(~_buried(x, y, diameter, absolute, rng.random(len(x))))


def _buried(x: NDArray, y: NDArray, diameter: NDArray, time: NDArray, luck: NDArray) -> NDArray:
    """Which craters an at least twice larger, younger one has erased (inside it) or its ejecta covered (near it)."""
    cell = 100.0
    if len(x) == 0:
        return np.zeros(0, bool)
    x0, y0 = x.min(), y.min()
    columns = int((x.max() - x0) / cell) + 1
    rows = int((y.max() - y0) / cell) + 1
    key = ((y - y0) / cell).astype(np.int64) * columns + ((x - x0) / cell).astype(np.int64)
    order = np.argsort(key, kind="stable")
    start = np.searchsorted(key[order], np.arange(rows * columns + 1))
    return _bury(x, y, diameter, time, luck, order, start, rows, columns, cell, x0, y0)


@njit(cache=True)
def _bury(x, y, diameter, time, luck, order, start, rows, columns, cell, x0, y0):
    gone = np.zeros(len(x), np.bool_)
    for k in range(len(x)):
        reach = 0.85 * diameter[k]
        if reach < 0.5 * cell:  # small against the grid of cells: what they bury is not worth the search
            break
        c0, c1 = max(0, int((x[k] - reach - x0) / cell)), min(columns - 1, int((x[k] + reach - x0) / cell))
        r0, r1 = max(0, int((y[k] - reach - y0) / cell)), min(rows - 1, int((y[k] + reach - y0) / cell))
        for r in range(r0, r1 + 1):
            for m in range(start[r * columns + c0], start[r * columns + c1 + 1]):
                j = order[m]
                if diameter[j] > 0.5 * diameter[k] or time[j] <= time[k]:
                    continue
                distance = math.hypot(x[j] - x[k], y[j] - y[k]) / (0.5 * diameter[k])
                # ejecta buries what is shallower than it is thick; farther out only small ones
                if distance < 1.05 or (distance < 1.7 and luck[j] < 1.7 - distance):
                    gone[j] = True
    return gone


def fresh_profile(r: NDArray) -> NDArray:
    """Height over diameter of a fresh simple crater at r radii from its centre.

    r : (n,); returns (n,). Rim and depth after Pike (1977), ejecta after McGetchin et al. (1973)
    """
    r = np.asarray(r, float)
    # flat floor, parabolic foot, straight wall at the angle of repose (tan = 2 DEPTH WALL = 0.67)
    foot = FLOOR + 2 * (1 - FLOOR - 1 / WALL)
    a = WALL / (2 * (foot - FLOOR))
    t = np.clip(r - FLOOR, 0, None)
    rise = np.where(t < foot - FLOOR, a * t * t, WALL * (t - (foot - FLOOR) / 2))
    bowl = RIM - DEPTH + DEPTH * rise
    ejecta = RIM * np.maximum(r, 1e-6) ** -3.0
    # thins to nothing at REACH instead of ending in a step
    fade = np.clip((REACH - r) / (REACH - 1.0), 0.0, 1.0)
    return np.where(r < 1.0, bowl, ejecta * fade)


@lru_cache(maxsize=1)
def profile_table() -> tuple[Floats32, float]:
    """Profiles worn by diffusion: (STATES, SAMPLES) heights over diameter, and the spacing in radii.

    State k has K = kappa t / R^2 = WORN_OUT (k / (STATES - 1))^2, plus a little that even fresh rims have. The
    axisymmetric heat kernel is applied in the transform domain (Hankel transform of order 0).
    """
    from scipy.special import j0

    reach = 8.0
    r = (np.arange(4000) + 0.5) * (reach / 4000)
    h = fresh_profile(r)
    q = (np.arange(1200) + 0.5) * 0.05
    kernel = j0(np.outer(q, r))
    spectrum = kernel @ (h * r) * (r[1] - r[0])
    target = np.arange(SAMPLES) * (REACH / (SAMPLES - 1))
    back = j0(np.outer(target, q)) * q * 0.05
    wear = WORN_OUT * (np.arange(STATES) / (STATES - 1)) ** 2 + 0.0012
    table = np.stack([back @ (spectrum * np.exp(-q * q * k)) for k in wear])
    edge = np.clip((REACH - target) / 0.8, 0, 1)
    return (table * edge * edge * (3 - 2 * edge)).astype(np.float32), REACH / (SAMPLES - 1)


@njit(parallel=True, fastmath=True, cache=True)
def _stamp(
    elevation, freshness, ejecta, gx, gy, step, x, y, diameter, age, depth_factor, seed, table, spacing, order, start
):
    """Add every crater to the block, by bands of rows: threads never share a pixel."""
    height, width = elevation.shape
    states = table.shape[0]
    bands = len(start) - 1
    for band in prange(bands):
        first, last = band * height // bands, (band + 1) * height // bands
        for m in range(start[band], start[band + 1]):
            k = order[m]
            radius = 0.5 * diameter[k]
            young = max(0.0, 1.0 - age[k] / YOUNG)
            big = radius > 12.0 * step
            reach = radius * (EJECTA_REACH if young > 0 and big else REACH)
            r0 = max(first, int(math.ceil((gy - y[k] - reach) / step)))
            r1 = min(last, int(math.floor((gy - y[k] + reach) / step)) + 1)
            c0 = max(0, int(math.ceil((x[k] - reach - gx) / step)))
            c1 = min(width, int(math.floor((x[k] + reach - gx) / step)) + 1)
            if r1 <= r0 or c1 <= c0:
                continue
            # nothing is sharper than the grid resolves
            state = math.sqrt(min(1.0, age[k])) * (states - 1)
            blur = math.sqrt(0.5 * (0.6 * step / radius) ** 2 / WORN_OUT) * (states - 1)
            state = min(states - 1.001, math.sqrt(state * state + blur * blur))
            low = int(state)
            share = state - low
            phase = (seed[k] & 1023) * 0.006135923
            oval = 0.015 + 0.035 * ((seed[k] >> 10) & 255) / 255.0
            scale = diameter[k] * depth_factor[k]
            fresh = young**1.5
            for r in range(r0, r1):
                dy = gy - r * step - y[k]
                for c in range(c0, c1):
                    dx = gx + c * step - x[k]
                    d2 = dx * dx + dy * dy
                    if d2 > reach * reach:
                        continue
                    d = math.sqrt(d2) / radius
                    stretched = d
                    if d > 0.05:
                        # cos and sin of the azimuth without trigonometry: outlines are ovals with lobes
                        ca, sa = dx / (d * radius), dy / (d * radius)
                        c2, s2 = ca * ca - sa * sa, 2 * sa * ca
                        c3, s3 = c2 * ca - s2 * sa, s2 * ca + c2 * sa
                        cp, sp = math.cos(phase), math.sin(phase)
                        lobes = c2 * cp + s2 * sp + 0.6 * (c3 * sp - s3 * cp)
                        if big:
                            lobes += 1.1 * gradient_noise(2.1 * ca + 0.31 * d, 2.1 * sa, seed[k] & 65535)
                            lobes += 0.55 * gradient_noise(6.3 * ca, 6.3 * sa + 0.7 * d, (seed[k] >> 3) & 65535)
                        stretched = d * (1.0 + oval * lobes)
                    if stretched < 3.999:
                        t = stretched / spacing
                        i = int(t)
                        f = t - i
                        a = table[low, i] + f * (table[low, i + 1] - table[low, i])
                        b = table[low + 1, i] + f * (table[low + 1, i + 1] - table[low + 1, i])
                        h = a + share * (b - a)
                        if big and stretched > 0.9:
                            # blocky, rayed ejecta: thickness varies with azimuth
                            h *= 1.0 + 0.5 * min(1.0, (stretched - 0.9) * 4.0) * gradient_noise(
                                5.0 * dx / (d * radius) + 0.8 * d, 5.0 * dy / (d * radius), seed[k] & 32767
                            )
                        elevation[r, c] += np.float32(scale * h)
                    if young > 0:
                        inner = 1.0
                        if stretched > 1.05:
                            fade = max(0.0, 1.0 - (stretched - 1.05) / 1.6)
                            inner = fade * fade
                        elif stretched < 0.5:  # floors fill with mixed debris
                            inner = 0.55 + 0.45 * stretched / 0.5
                        freshness[r, c] = max(freshness[r, c], np.float32(fresh * inner))
                        if stretched >= 1.0 and big:
                            ca, sa = dx / (d * radius), dy / (d * radius)
                            # broad lobes, some of them empty, broken into narrower streaks and patches
                            lobe = 0.25 + 2.2 * gradient_noise(2.3 * ca, 2.3 * sa, (seed[k] >> 5) & 65535)
                            streak = gradient_noise(8.0 * ca + 0.15 * d, 8.0 * sa, (seed[k] >> 7) & 65535)
                            streak += 0.7 * gradient_noise(19.0 * ca, 19.0 * sa + 0.3 * d, (seed[k] >> 9) & 65535)
                            streak += 0.8 * gradient_noise(1.7 * d * ca, 1.7 * d * sa, (seed[k] >> 4) & 65535)
                            streak = max(0.0, lobe + 0.9 * streak)
                            fade = stretched**-1.15 * max(0.0, 1.0 - stretched / 9.0)
                            fade *= min(1.0, (stretched - 1.0) / 0.3)
                            ejecta[r, c] += np.float32(fresh * fade * streak)


def stamp(
    craters: Craters, x0: float, y0: float, step: float, shape: tuple[int, int]
) -> tuple[Floats32, Floats32, Floats32]:
    """Heights (m), freshness of walls and near ejecta (0..1) and rays of ejecta (0..) of a block.

    (x0, y0) is the centre of the first pixel; rows run south. Largest first, so that the result is the same however
    the scene is cut into blocks.
    """
    elevation = np.zeros(shape, np.float32)
    freshness = np.zeros(shape, np.float32)
    ejecta = np.zeros(shape, np.float32)
    height, width = shape
    rayed = (craters.age < YOUNG) & (craters.diameter > 24.0 * step)
    reach = 0.5 * craters.diameter * np.where(rayed, EJECTA_REACH, REACH)
    near = (
        (craters.x + reach >= x0)
        & (craters.x - reach <= x0 + (width - 1) * step)
        & (craters.y - reach <= y0)
        & (craters.y + reach >= y0 - (height - 1) * step)
    )
    index = np.flatnonzero(near)
    if len(index):
        table, spacing = profile_table()
        bands = max(1, min(64, height // 16))
        edges = np.arange(bands + 1) * height // bands
        top = (y0 - craters.y[index] - reach[index]) / step
        end = (y0 - craters.y[index] + reach[index]) / step
        lists = [index[(end >= a) & (top <= b)] for a, b in itertools.pairwise(edges)]
        start = np.concatenate([[0], np.cumsum([len(v) for v in lists])])
        _stamp(
            elevation,
            freshness,
            ejecta,
            float(x0),
            float(y0),
            float(step),
            craters.x,
            craters.y,
            craters.diameter,
            craters.age,
            craters.depth_factor,
            craters.seed,
            table,
            spacing,
            np.concatenate(lists),
            start,
        )
    return elevation, freshness, ejecta
