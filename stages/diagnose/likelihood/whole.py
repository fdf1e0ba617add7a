"""The sums over all pieces of ground, with the nuisance among the columns: errors of amounts, and what they gain on held-out ground."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from stages.diagnose.likelihood.columns import Guise, Plan
from stages.diagnose.likelihood.intervals import folds, jackknife_error
from stages.diagnose.likelihood.products import Array, Products
from stages.diagnose.settings import UNITS
from stages.effects import Effect, get_effect

# places of what is fitted, its weights, and places that are excluded
Fit = tuple[NDArray[np.int64], Array, list[int]]


class Whole:
    """All units' products put together, with the nuisance among the columns."""

    def __init__(self, units: Sequence[Products], plan: Plan, frames: int, drifting: bool = True) -> None:
        self.units, self.plan, self.frames = list(units), plan, frames
        self.given = self.units  # before the drift of coefficients is taken out of them
        levels = [u.level for u in units if u.level is not None]
        # brightness of images as wholes, which what is not known of their insides must not decide on
        self.levels = Whole(levels, plan, frames, drifting=False) if levels else None
        self.first = 1 + len(plan.shared)
        if drifting:
            self._let_coefficients_drift()
        lit = self.first + len(plan.per_frame) * frames
        self.own_light = lit + np.arange(frames)  # places of the light of its own in the shadows of every frame
        self.size = lit + frames
        self.gram = np.zeros((self.size, self.size))
        shams = units[0].sham.shape[1]
        self.sham, self.sham_squares = np.zeros((self.size, shams)), np.zeros(shams)
        for u in self.units:
            self.gram[np.ix_(u.place, u.place)] += u.gram
            self.sham[u.place] += u.sham
            self.sham_squares += u.sham_squares
        self.seen = self.gram.diagonal() > 1e-12 * max(self.gram.diagonal().max(), 1e-30)
        self.scattered = np.zeros(0, np.int64)  # places of the gains per frame
        self.precision = self._precision()
        self.labels = self._labels()
        self.sizes = np.bincount(self.labels, weights=[u.gram[0, 0] for u in self.units]).astype(np.float64)
        fold = folds(len(self.sizes))[self.labels]
        self.folds = [np.flatnonzero(fold == k) for k in np.unique(fold)]

    def _labels(self) -> list[int]:
        """Which units are left out together: all of a site, or each by itself where sites are few."""
        sites = sorted({u.site for u in self.units})
        return list(range(len(self.units))) if len(sites) < UNITS else [sites.index(u.site) for u in self.units]

    def _let_coefficients_drift(self) -> None:
        """Take out of every unit what the nominal coefficients may be there beside the rest: reflectance varies over the ground.

        Their scatter is estimated along the main directions in which they change the images (expectation-maximisation), and
        the amounts of each unit are integrated out.
        """
        known = np.sum([u.gram[: 1 + len(self.plan.shared), : 1 + len(self.plan.shared)] for u in self.units], 0)
        # images that are left out may be all that tells of the law
        told = known.diagonal() > 1e-12 * known.diagonal().max()
        free = [k for k, n in enumerate(self.plan.shared) if n.startswith("coefficient") and told[1 + k]]
        places = 1 + np.array([*free, *(k for k in self.plan.ground if told[1 + k])], dtype=np.int64)
        if not len(places):
            return
        total = known[np.ix_(places, places)]
        scale = 1 / np.sqrt(np.maximum(total.diagonal(), 1e-30))
        axes = np.eye(len(places))
        if free:
            axes[: len(free), : len(free)] = np.linalg.eigh((total * np.outer(scale, scale))[: len(free), : len(free)])[
                1
            ]
        main = (scale[:, None] * axes) * math.sqrt(len(self.units))  # a unit's column has about unit information
        common = np.arange(len(places)) < len(free)  # the others have no amount that is the same everywhere
        spread = np.full(main.shape[1], 1.0)
        squares = [main.T @ u.gram[np.ix_(places, places)] @ main for u in self.units]
        score = np.array([main.T @ u.gram[places, 0] for u in self.units])
        for _ in range(10):
            posterior = [np.linalg.inv(g + np.diag(spread**-2)) for g in squares]
            weight = [np.eye(len(spread)) - g @ c for g, c in zip(squares, posterior, strict=True)]
            top = sum(w @ g for w, g in zip(weight, squares, strict=True))
            right = np.sum([w @ s for w, s in zip(weight, score, strict=True)], 0)
            mean = np.zeros(len(places))
            mean[common] = np.linalg.solve(top[np.ix_(common, common)] + 1e-9 * np.eye(len(free)), right[common])
            own = np.array([c @ (s - g @ mean) for c, g, s in zip(posterior, squares, score, strict=True)])
            variance = own**2 + np.array([c.diagonal() for c in posterior])
            spread = np.sqrt(np.maximum(variance.mean(0), 1e-8))
        self.units = [_integrated_out(u, places, main, spread) for u in self.units]

    def frame_places(self, columns: Sequence[int]) -> NDArray[np.int64]:
        """Places of columns per frame in the whole, frame by frame within a column."""
        places = [self.first + a * self.frames + np.arange(self.frames) for a in columns]
        out = np.concatenate(places) if places else np.zeros(0, np.int64)
        return out[self.seen[out]]

    def places(self, guise: Guise) -> NDArray[np.int64]:
        """Where the columns of a candidate stand among all."""
        if guise.per_frame:
            return self.frame_places(guise.columns)
        return np.array([1 + k for k in guise.columns])

    def mirrored(self, guise: Guise) -> Guise | None:
        """The same effect on the other side, where it is one that has two."""
        if not (side := get_effect(guise.effect).one_sided):
            return None
        fixed = {**guise.trial.fixed, side: -guise.trial.fixed[side]}
        return next((g for g in self.plan.guises if g.effect == guise.effect and g.trial.fixed == fixed), None)

    def _precision(self) -> dict[int, float]:
        """Place of every nuisance column -> inverse prior variance."""
        out: dict[int, float] = {}
        for k, sd in self.plan.prior.items():
            if self.seen[1 + k]:
                out[1 + k] = 1e-10 * self.gram[1 + k, 1 + k] + (0.0 if math.isinf(sd) else sd**-2)
        for k, sd in self.plan.frame_prior.items():
            for place in self.frame_places([k]):
                out[int(place)] = sd**-2
        return out | {int(place): 1.0 for place in self.own_light if self.seen[place]}

    def nuisance(self, without: Sequence[int] = ()) -> NDArray[np.int64]:
        """Places of the nuisance, ``without`` some."""
        gone = {int(w) for w in without}
        return np.array([k for k in sorted(self.precision) if k not in gone], dtype=np.int64)

    def weight(self, places: NDArray[np.int64]) -> Array:
        """Inverse prior variances."""
        return np.array([self.precision.get(int(k), 1.0) for k in places])

    def _least(self, places: NDArray[np.int64]) -> Array:
        """Weights that keep at nothing what other ground says nothing of, once all that does is left out."""
        return 1e-6 * self.gram.diagonal()[places]

    def let_scatter(self, places: NDArray[np.int64], least: float = 1e-4, most: float = math.inf) -> float:
        """Estimate the scatter of nuisance about nothing by expectation-maximisation, make it their prior, and return it."""
        if not len(places):
            return 0.0
        places = np.sort(places)
        spread = 0.3
        for _ in range(8):
            for p in places:
                self.precision[int(p)] = spread**-2
            n = self.nuisance()
            at = np.searchsorted(n, places)
            scaled, scale = scaled_to_one(self.gram[np.ix_(n, n)] + np.diag(self.weight(n)))
            inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
            mean = (inverse @ self._score(self.gram, ())[n])[at] + [self.plan.pull.get(int(p) - 1, 0.0) for p in places]
            spread = min(max(math.sqrt(float((mean**2 + inverse.diagonal()[at]).mean())), least), most)
        for p in places:
            self.precision[int(p)] = spread**-2
        return spread

    def reduce(
        self, places: NDArray[np.int64], exclude: Sequence[int] = ()
    ) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        """(information (J, J), score (J,), sham scores (J, R), nuisance) once the nuisance is fitted along."""
        n = self.nuisance([*places, *exclude])
        a = self.gram[np.ix_(n, n)] + np.diag(self.weight(n))
        scaled, scale = scaled_to_one(a)
        first = self._score(self.gram, exclude)
        right = np.concatenate([self.gram[np.ix_(n, places)], first[n, None], self.sham[n]], 1)
        solved = scale[:, None] * cho_solve(cholesky(scaled), scale[:, None] * right)
        j = len(places)
        cross = self.gram[np.ix_(places, n)]
        information = self.gram[np.ix_(places, places)] - cross @ solved[:, :j]
        score = first[places] - cross @ solved[:, j]
        shams = self.sham[places] - cross @ solved[:, j + 1 :]
        return (information + information.T) / 2, score, shams, n

    def _without_departures(self, exclude: Sequence[int]) -> Array:
        """(size,) amounts that take what is rendered of the law's departures away, where these are excluded."""
        out = np.zeros(self.size)
        for k in self.plan.form:
            if 1 + k in exclude:
                out[1 + k] = -self.plan.pull.get(k, 0.0)
        return out

    def _score(self, gram: Array, exclude: Sequence[int]) -> Array:
        """(size,) products of all columns with the residual, without the departures that are excluded, and with the prior of the others."""
        out = gram[:, 0] - gram @ self._without_departures(exclude)
        for k, amount in self.plan.pull.items():
            if 1 + k not in exclude:
                out[1 + k] -= self.precision.get(1 + k, 0.0) * amount
        return out

    def exclude(self, guise: Guise) -> list[int]:
        """What the nuisance does without beside this effect: ordinary amounts of it, and of all that lights shadows where it does;
        what :meth:`stood_for` names.
        """
        cls = get_effect(guise.effect)
        alike = [n for n in self.plan.ordinary if cls.lights_shadows and get_effect(n).lights_shadows]
        ordinary = [p for n in dict.fromkeys([guise.effect, *alike]) for p in self.ordinary_places(n)]
        return ordinary + self.stood_for([cls])

    def stood_for(self, causes: Sequence[type[Effect]]) -> list[int]:
        """Places of what these effects stand for: another form of the law, errors of the DEM."""
        form = self.form_places().tolist() if any(c.of_law for c in causes) else []
        relief = any(c.slot == "geometry" and not c.displaces for c in causes)
        return form + ([1 + k for k in self.plan.dem_errors] if relief else [])

    def ordinary_places(self, effect: str) -> list[int]:
        """Places of the ordinary amounts of an effect among the nuisance."""
        return [1 + k for k in self.plan.ordinary.get(effect, [])]

    def form_places(self) -> NDArray[np.int64]:
        """Places of the columns of another form of the reflectance that the data say anything of."""
        return np.array([1 + k for k in self.plan.form if self.seen[1 + k]], dtype=np.int64)

    def expected_errors(self, guise: Guise) -> Array:
        """(J,) standard errors of the amounts, each alone, at least as wide as sham residuals scatter."""
        if judge := self.by_levels(guise):
            return judge.expected_errors(guise)
        information, _, shams, _ = self.reduce(self.places(guise), self.exclude(guise))
        power = np.maximum(information.diagonal(), 1e-12)
        inflation = np.maximum((shams**2).mean(1) / power, 1.0) if shams.shape[1] else 1.0
        return np.sqrt(inflation / power)

    def by_levels(self, guise: Guise) -> Whole | None:
        """The sums that tell an effect which changes the brightness of images as wholes; None for any other."""
        effect = get_effect(guise.effect)
        return self.levels if effect.scatters and not effect.displaces else None

    def with_added(self, places: NDArray[np.int64], amount: Array) -> Whole:
        """The sums as if these amounts of columns were in the residual as well."""
        added = np.zeros(self.size)
        added[places] = amount
        out = copy.copy(self)
        out.units = [dataclasses.replace(u, gram=_added(u.gram, added[u.place])) for u in self.units]
        out.gram = _added(self.gram, added)
        out.sizes = np.bincount(self.labels, weights=[u.gram[0, 0] for u in out.units]).astype(np.float64)
        out.levels = self.levels.with_added(places, amount) if self.levels is not None else None
        return out

    def power(self, places: NDArray[np.int64], amount: Array) -> Array:
        """(labels,) squares of these amounts on every piece of ground, to which what they gain is in proportion but for chance."""
        every = np.zeros(self.size)
        every[places] = amount
        squares = [float(every[u.place] @ u.gram @ every[u.place]) for u in self.units]
        return np.bincount(self.labels, weights=squares).astype(np.float64)

    def held_out(self, places: NDArray[np.int64], exclude: Sequence[int] = (), spread: float = 0.0) -> Array:
        """(labels,) nats that the columns gain on ground that they and the nuisance were not fitted to.

        Beside light of its own in every image nothing is left to gain: other ground tells how much that is.
        """
        n, gone = self.nuisance([*places, *exclude, *self.own_light]), [int(p) for p in exclude]
        own = np.full(len(places), spread**-2 if spread else 0.0)
        full = np.concatenate([n, places]), np.concatenate([self.weight(n), own]), gone
        return self._gains((n, self.weight(n), gone), full)

    def law_gains(self, exclude: Sequence[int] = ()) -> Array:
        """(labels,) the same of the law's departures over the nominal law alone."""
        forms, gone = self.form_places(), [int(p) for p in exclude]
        n = self.nuisance([*forms, *exclude, *self.own_light])
        every = np.concatenate([n, forms])
        return self._gains((n, self.weight(n), [*gone, *forms.tolist()]), (every, self.weight(every), gone))

    def _gains(self, plain: Fit, full: Fit) -> Array:
        """(labels,) nats by which the second fit predicts ground that it was not fitted to better than the first."""
        out = np.zeros(max(self.labels) + 1)
        for fold in self.folds:
            rest = self.gram.copy()
            for k in fold:
                u = self.units[k]
                rest[np.ix_(u.place, u.place)] -= u.gram
            for (places, weights, exclude), sign in ((plain, 0.5), (full, -0.5)):
                amounts, score = self._without_departures(exclude), self._score(rest, exclude)[places]
                # what other ground says nothing of stays at nothing
                weight = np.diag(weights + self._least(places))
                amounts[places] = solve(rest[np.ix_(places, places)] + weight, score)
                for k in fold:
                    out[self.labels[k]] += sign * _left(self.units[k], amounts)
        return out

    def without_one(
        self,
        places: NDArray[np.int64],
        exclude: Sequence[int] = (),
        spread: float = 0.0,
        now: Array | None = None,
        of: Sequence[int] = (),
    ) -> Array:
        """(labels, J) amounts with one piece of ground left out each; ``spread`` draws them, beside ``now``, to nothing.

        of : of every unit, the number of its ground; its label if empty
        """
        labels = of or self.labels
        n = self.nuisance([*places, *exclude])
        every = np.concatenate([n, places])
        pull = spread**-2 if spread else 0.0
        more = np.diag(np.concatenate([self.weight(n), np.full(len(places), pull)]) + self._least(every))
        pulled = np.concatenate([np.zeros(len(n)), pull * now if now is not None else np.zeros(len(places))])
        out = []
        for label in sorted(set(labels)):
            rest = self.gram.copy()
            for u, own in zip(self.units, labels, strict=True):
                if own == label:
                    rest[np.ix_(u.place, u.place)] -= u.gram
            first = self._score(rest, exclude)
            out.append(solve(rest[np.ix_(every, every)] + more, first[every] - pulled)[len(n) :])
        return np.array(out)

    def errors(self, places: NDArray[np.int64], exclude: Sequence[int] = ()) -> tuple[Array, Array, Array]:
        """Amounts, their standard errors, which are the larger of the likelihood's and the jackknife's, and the likelihood's covariance."""
        information, score, _, _ = self.reduce(places, exclude)
        inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
        scatter = jackknife_error(self.without_one(places, exclude))
        errors: Array = np.maximum(np.sqrt(np.maximum(inverse.diagonal(), 0)), scatter).astype(np.float64)
        return inverse @ score, errors, inverse.astype(np.float64)


def _integrated_out(u: Products, places: NDArray[np.int64], main: Array, spread: Array) -> Products:
    """The unit without its own amounts, along the directions ``main`` of the columns at ``places``, which scatter by ``spread``."""
    r, sham = main.T @ u.gram[places], main.T @ u.sham[places]
    inner = np.linalg.inv(main.T @ u.gram[np.ix_(places, places)] @ main + np.diag(spread**-2))
    return dataclasses.replace(u, gram=u.gram - r.T @ inner @ r, sham=u.sham - r.T @ inner @ sham)


def _added(gram: Array, amount: Array) -> Array:
    """Products where the first column has so much of the others in it as well; gram : (M, M), amount : (M,)"""
    out = gram.copy()
    more = gram @ amount
    out[0, :] += more
    out[:, 0] += more
    out[0, 0] += float(amount @ more)
    return out


def _left(unit: Products, b: Array) -> float:
    own = b[unit.place]
    return float(unit.gram[0, 0] - 2 * own @ unit.gram[:, 0] + own @ unit.gram @ own)


def scaled_to_one(a: Array) -> tuple[Array, Array]:
    """A matrix with a diagonal of ones, and by what its rows and columns were multiplied."""
    scale = 1 / np.sqrt(np.maximum(a.diagonal(), 1e-30))
    return a * np.outer(scale, scale) + 1e-10 * np.eye(len(a)), scale


def cholesky(scaled: Array) -> tuple[Array, bool]:
    """Cholesky factor; columns that are alike to single precision, in which products are summed, are kept apart by as much as that takes."""
    for more in (0.0, 1e-7, 1e-6, 1e-5, 1e-4):
        try:
            return cho_factor(scaled + more * np.eye(len(scaled)))
        except LinAlgError:
            continue
    return cho_factor(scaled + 1e-2 * np.eye(len(scaled)))


def solve(a: Array, b: Array) -> Array:
    """x of a x = b, for a symmetric positive definite a."""
    scaled, scale = scaled_to_one(a)
    return scale * cho_solve(cholesky(scaled), scale * b)


__all__ = ["Whole"]
