"""The ways in which the law of the ground may differ from the nominal one, at the angles at hand.

Laws are drawn with parameters over their published ranges and evaluated at angles of the data. The nominal law is fitted to each. The main
directions of what it leaves (principal components) are open in the model, with the scatter of measured laws as their prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg import eigh
from torch import Tensor

from stages.common.arrays import Floats
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import ReflectanceModel, get_model
from stages.physics.photometry.roughness import roughness_factor

DRAWS = 360  # laws: the scatter of a direction is known to a tenth
DIRECTIONS = 24  # in which laws may differ: further ones change brightness by less than 0.01 %
DEGREE = 6  # of the polynomials in both cosines and the root of the phase angle that stand for a law
ROUGH = math.radians(20), math.radians(38)  # Hapke's roughness bends where no polynomial does ...
ROUGH_DEGREE = 2  # ... and is another one for other parameters: of the polynomials that multiply it
SPREAD = 10  # angles of the data for one between them
SEED = 1
BLOCK = 1 << 16  # pixels whose products are held at a time
Term = tuple[int, int, int]  # degrees in the three factors
TERMS: list[Term] = [
    (i, j, k) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) for k in range(DEGREE + 1 - i - j)
]
SIMPLE = [n for n, term in enumerate(TERMS) if sum(term) <= ROUGH_DEGREE]


class Departures:
    """What other laws add to the nominal one: Lommel-Seeliger's law times polynomials of the angles, one for each direction.

    An amount of 1 is one standard deviation among measured laws. weights : (K, terms); low, high : (3,) range of the factors' arguments
    """

    def __init__(self, low: Floats, high: Floats, weights: Floats) -> None:
        self.low, self.high = low, high
        self.weights = torch.from_numpy(weights).float()

    def __len__(self) -> int:
        return len(self.weights)

    def parts(self, angles: Angles) -> Tensor:
        """(K, ...) I/F that an amount of 1 in each direction adds, where facets face the Sun and the camera."""
        return self._sums(self.weights, angles) * _seeliger(angles)

    def added(self, amounts: Tensor, angles: Angles) -> Tensor:
        """(...) I/F that these amounts (K,) add."""
        return self._sums(amounts[None].to(self.weights) @ self.weights, angles)[0] * _seeliger(angles)

    def _sums(self, weights: Tensor, angles: Angles) -> Tensor:
        """(R, ...) sums of all terms, weighted by (R, terms), in blocks of pixels that fit into a processor's cache."""
        shape = angles.cos_incidence.shape
        every = [x.expand(shape).flatten() for x in (angles.cos_incidence, angles.cos_emission, angles.cos_phase)]
        out = torch.empty(len(weights), len(every[0]), dtype=every[0].dtype)
        weights = weights.to(out.dtype)
        for at in range(0, out.shape[1], BLOCK):
            factors = _factors(Angles(*(x[at : at + BLOCK] for x in every)), self.low, self.high)
            out[:, at : at + BLOCK] = (
                _sum_of_one(weights[0], factors) if len(weights) == 1 else weights @ _terms(factors)
            )
        return out.unflatten(1, shape)


def _seeliger(angles: Angles) -> Tensor:
    """(...) of Lommel and Seeliger's law, 0 where a facet is not lit or not seen."""
    facing = (angles.cos_incidence > 0) & (angles.cos_emission > 0)
    return torch.where(facing, angles.cos_incidence / (angles.cos_incidence + angles.cos_emission).clamp(min=1e-6), 0.0)


def departures(model: ReflectanceModel, vector: Tensor, cosines: Tensor) -> Departures:
    """The directions in which measured lunar laws differ from the nominal one, once its coefficients are fitted to each of them.

    vector : (C,) coefficients about which a curved model is linearised
    cosines : (3, N) of incidence, emission and phase, all facets lit and seen
    """
    here = cosines.double()
    at = torch.stack([here[0], here[1], Angles(*here).phase.sqrt()])
    low = at.amin(1).numpy()
    high = np.maximum(at.amax(1).numpy(), low + 1e-3)
    angles = Angles(*torch.cat([here, _between(low, high, here.shape[1] // SPREAD)], 1))
    known = slice(here.shape[1])
    laws = _draw(angles)
    laws = laws / laws[:, known].mean(1, keepdims=True)
    mean = laws.mean(0)
    tangents = _tangents(model, vector.double(), angles)
    basis = tangents / mean
    fitted = np.linalg.lstsq(basis[:, known].T, (laws / mean)[:, known].T, rcond=1e-9)[0]
    sizes, axes = _main_directions(laws / mean - fitted.T @ basis, here.shape[1])
    shapes = axes * (sizes[:, None] * math.sqrt(here.shape[1])) * mean * tangents[0, known].mean()
    seeliger = _seeliger(angles).numpy()
    terms = _terms(_factors(angles, low, high)).numpy()
    # by what is wrong with brightness, since laws differ without bound at grazing light
    weights = np.linalg.lstsq((terms * seeliger).T, shapes.T, rcond=1e-10)[0].T
    return Departures(low, high, weights)


def _tangents(model: ReflectanceModel, vector: Tensor, angles: Angles) -> Floats:
    """(1 + C, N) I/F of the nominal law, and what a small step of each coefficient adds to it."""

    def law(coefficients: Tensor) -> Tensor:
        return model.radiance_factor(model.unpack(coefficients[None, :, None], dim=1), angles)[0]

    first = law(vector)
    out = [first]
    for k, size in enumerate(vector.abs()):
        moved = vector.clone()
        step = 0.05 * float(size) + 1e-4
        moved[k] += step
        out.append((law(moved) - first) / step)
    return torch.stack(out).double().numpy()


def _between(low: Floats, high: Floats, count: int) -> Tensor:
    """(3, at most count) cosines spread evenly between the lowest and highest of the data: where one steep crater has its angles to itself
    polynomials that nothing held there would run away.
    """
    rng = np.random.default_rng(SEED)
    mu0, mu, root = rng.uniform(low[:, None], high[:, None], (3, 4 * count))
    incidence, emission, phase = np.arccos(mu0), np.arccos(mu), root**2
    possible = (np.abs(incidence - emission) <= phase) & (phase <= incidence + emission)
    return torch.from_numpy(np.stack([mu0, mu, np.cos(phase)])[:, possible][:, :count])


def _main_directions(departures: Floats, known: int) -> tuple[Floats, Floats]:
    """Standard deviations (K,) and directions (K, N) of the scatter of (laws, N) about nothing, the largest first: unit vectors over the
    first ``known``, among which it is sought.
    """
    data = departures[:, :known]
    among = data @ data.T / data.size  # far fewer laws than angles
    count = min(DIRECTIONS, *data.shape)
    squares, mixtures = eigh(among, subset_by_index=[len(among) - count, len(among) - 1])
    sizes = np.sqrt(np.maximum(squares[::-1], 0.0))
    axes = mixtures.T[::-1] @ departures / (np.maximum(sizes, 1e-12)[:, None] * math.sqrt(data.size))
    return sizes, axes


def _factors(angles: Angles, low: Floats, high: Floats) -> list[list[Tensor]]:
    """What terms are products of: polynomials of degree 0 to DEGREE of both cosines and the root of the phase angle; roughness.

    What is beyond the known angles counts as the nearest.
    """
    out = []
    for x, a, b in zip((angles.cos_incidence, angles.cos_emission, angles.phase.sqrt()), low, high, strict=True):
        scaled = ((x - a) * (2 / (b - a)) - 1).clamp(-1, 1)
        each = [torch.ones_like(scaled), scaled]
        while len(each) <= DEGREE:
            each.append(2 * scaled * each[-1] - each[-2])
        out.append(each)
    return [*out, list(roughness_factor(angles, torch.tensor(ROUGH, dtype=out[0][0].dtype)[:, None]))]


def _terms(factors: list[list[Tensor]]) -> Tensor:
    """(terms, N): products of polynomials up to the total degree, then the simple ones times roughness; factors : of N pixels each."""
    first, second, third, rough = factors
    out = torch.empty(len(TERMS) + len(rough) * len(SIMPLE), len(first[0]), dtype=first[0].dtype)
    pairs = {(i, j): first[i] * second[j] for i, j, k in TERMS if k == 0}
    for row, (i, j, k) in zip(out, TERMS, strict=False):
        torch.mul(pairs[i, j], third[k], out=row)
    for n, factor in enumerate(rough):
        start = len(TERMS) + n * len(SIMPLE)
        torch.mul(out[SIMPLE], factor, out=out[start : start + len(SIMPLE)])
    return out


def _sum_of_one(weights: Tensor, factors: list[list[Tensor]]) -> Tensor:
    """(N,) the sum of :func:`_terms` weighted by (terms,), one factor taken out after the other."""
    first, second, third, rough = factors
    out = _polynomial(weights[: len(TERMS)], DEGREE, TERMS, first, second, third)
    simple = [TERMS[k] for k in SIMPLE]
    for n, factor in enumerate(rough):
        own = weights[len(TERMS) + n * len(SIMPLE) :][: len(SIMPLE)]
        out.addcmul_(factor, _polynomial(own, ROUGH_DEGREE, simple, first, second, third))
    return out


def _polynomial(
    weights: Tensor, degree: int, terms: Sequence[Term], first: list[Tensor], second: list[Tensor], third: list[Tensor]
) -> Tensor:
    """(N,) sum of products of one of each factors, each product times its weight; terms : (i, j, k) of i + j + k up to the degree"""
    among = weights.new_zeros((degree + 1,) * 3)
    among[tuple(zip(*terms, strict=True))] = weights
    powers = torch.stack(third[: degree + 1])
    out = torch.zeros_like(first[0])
    for i in range(degree + 1):
        row = torch.zeros_like(out)
        for part, factor in zip(among[i, : degree + 1 - i] @ powers, second, strict=False):
            row.addcmul_(part, factor)
        out.addcmul_(row, first[i])
    return out


def _draw(angles: Angles) -> Floats:
    """(DRAWS, N) I/F of laws whose parameters scatter as those that were published for the Moon.

    Hapke: maps of Sato et al. (2014). Disk functions: Akimov's exponent from maria to theory (Shkuratov et al. 2011), McEwen's (1996)
    share of Lommel-Seeliger's law, Minnaert's exponent as it grows with phase (McEwen 1991), and the LROC team's fits with slopes
    that scatter as they differ from each other. Phase functions of disk functions: exp(-beta g) times an opposition surge
    (Hicks et al. 2011, Velikodsky et al. 2011).
    """
    rng = np.random.default_rng(SEED)
    g = angles.phase.numpy()
    degrees = np.degrees(g)
    mu0, mu = angles.cos_incidence.numpy(), angles.cos_emission.numpy()

    def published(name: str, **values: float) -> Floats:
        model = get_model(name)
        every = {k: torch.tensor(float(v), dtype=torch.float64) for k, v in {**model.defaults(), **values}.items()}
        return model.radiance_factor(every, angles).double().numpy()

    def phase_function() -> Floats:
        surge = 1 + rng.uniform(0, 1) / (1 + np.tan(g / 2) / rng.uniform(0.02, 0.12))
        return np.exp(-rng.uniform(0.3, 1.2) * g) * surge

    def hapke() -> Floats:
        return published(
            "hapke", w=rng.uniform(0.15, 0.6), b=rng.uniform(0.1, 0.4), c=rng.uniform(-0.1, 0.8), Bs0=rng.uniform(0.5, 2.5),
            hs=rng.uniform(0.02, 0.12), theta=math.radians(rng.uniform(8, 40)),
        )  # fmt: skip

    def akimov() -> Floats:
        return published("akimov", eta=rng.uniform(0.2, 1.0)) * phase_function()

    def minnaert() -> Floats:
        k = rng.uniform(0.45, 0.8) + rng.uniform(0, 0.006) * degrees
        return mu0**k * mu ** (k - 1) * phase_function()

    def lunar_lambert() -> Floats:
        share = 1 - rng.uniform(0.7, 1.3) * (0.019 * degrees - 2.42e-4 * degrees**2 + 1.46e-6 * degrees**3)
        return (2 * share * mu0 / (mu0 + mu) + (1 - share) * mu0) * phase_function()

    def lroc() -> Floats:
        name = ("lroc_empirical_2014", "lroc_empirical_2019")[int(rng.integers(2))]
        slopes = rng.normal(0, 0.15, 3)
        return published(name) * np.exp(slopes[0] * g + slopes[1] * mu0 + slopes[2] * mu)

    kinds = (hapke, hapke, akimov, minnaert, lunar_lambert, lroc)
    return np.stack([kinds[k % len(kinds)]() for k in range(DRAWS)])


__all__ = ["Departures", "departures"]
