"""The sums over all pieces of ground, with the nuisance among the columns: errors of amounts, and what they gain on held-out ground."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from stages.diagnose.likelihood.found import Found, interval
from stages.diagnose.likelihood.jackknife import folds, jackknife_error
from stages.diagnose.likelihood.products import Array, Products
from stages.diagnose.likelihood.solving import cholesky, scaled_to_one, solve
from stages.diagnose.rows.columns import Guise, Plan
from stages.diagnose.settings import SIMPLER, UNITS
from stages.effects import Effect, get_effect


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
        for k, at in plan.pull.items():  # what is known of a coefficient beforehand, as one more observation
            weight = plan.prior[k] ** -2
            self.gram[0, 0] += weight * at**2
            self.gram[0, 1 + k] -= weight * at
            self.gram[1 + k, 0] -= weight * at
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

    def let_scatter(self, places: NDArray[np.int64]) -> None:
        """Estimate the scatter of nuisance about nothing by expectation-maximisation and make it their prior."""
        if not len(places):
            return
        places = np.sort(places)
        spread = 0.3
        for _ in range(8):
            for p in places:
                self.precision[int(p)] = spread**-2
            n = self.nuisance()
            at = np.searchsorted(n, places)
            scaled, scale = scaled_to_one(self.gram[np.ix_(n, n)] + np.diag(self.weight(n)))
            inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
            mean = inverse @ self.gram[n, 0]
            spread = math.sqrt(max(float((mean[at] ** 2 + inverse.diagonal()[at]).mean()), 1e-10))
        for p in places:
            self.precision[int(p)] = max(spread, 1e-4) ** -2

    def reduce(
        self, places: NDArray[np.int64], exclude: Sequence[int] = ()
    ) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        """(information (J, J), score (J,), sham scores (J, R), nuisance) once the nuisance is fitted along."""
        n = self.nuisance([*places, *exclude])
        a = self.gram[np.ix_(n, n)] + np.diag(self.weight(n))
        scaled, scale = scaled_to_one(a)
        right = np.concatenate([self.gram[np.ix_(n, places)], self.gram[n, :1], self.sham[n]], 1)
        solved = scale[:, None] * cho_solve(cholesky(scaled), scale[:, None] * right)
        j = len(places)
        cross = self.gram[np.ix_(places, n)]
        information = self.gram[np.ix_(places, places)] - cross @ solved[:, :j]
        score = self.gram[places, 0] - cross @ solved[:, j]
        shams = self.sham[places] - cross @ solved[:, j + 1 :]
        return (information + information.T) / 2, score, shams, n

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
        n = self.nuisance([*places, *exclude, *self.own_light])
        every = np.concatenate([n, places])
        precision = self.weight(n) + self._least(n)
        more = np.concatenate([precision, np.full(len(places), spread**-2 if spread else 0.0) + self._least(places)])
        out = np.zeros(max(self.labels) + 1)
        for fold in self.folds:
            rest = self.gram.copy()
            for k in fold:
                u = self.units[k]
                rest[np.ix_(u.place, u.place)] -= u.gram
            with_ = solve(rest[np.ix_(every, every)] + np.diag(more), rest[every, 0])
            without = solve(rest[np.ix_(n, n)] + np.diag(precision), rest[n, 0])
            b1, b0 = np.zeros(self.size), np.zeros(self.size)
            b1[every], b0[n] = with_, without
            for k in fold:
                out[self.labels[k]] += 0.5 * (_left(self.units[k], b0) - _left(self.units[k], b1))
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
            out.append(solve(rest[np.ix_(every, every)] + more, rest[every, 0] - pulled)[len(n) :])
        return np.array(out)

    def errors(self, places: NDArray[np.int64], exclude: Sequence[int] = ()) -> tuple[Array, Array, Array]:
        """Amounts, their standard errors, which are the larger of the likelihood's and the jackknife's, and the likelihood's covariance."""
        information, score, _, _ = self.reduce(places, exclude)
        inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
        scatter = jackknife_error(self.without_one(places, exclude))
        errors: Array = np.maximum(np.sqrt(np.maximum(inverse.diagonal(), 0)), scatter).astype(np.float64)
        return inverse @ score, errors, inverse.astype(np.float64)

    def another_law(self, guise: Guise | None, surely: bool = False) -> float:
        """Nats that another form of the reflectance has to add beside an effect of the law, which explains less than most of what
        that form does alone; 0 where it has not. surely : with a lower bound above zero
        """
        added = self.law_adds(guise)
        if surely and interval(added, self.sizes)[0] <= 0:
            return 0.0
        if added.sum() <= 0 or added.sum() < (1 - SIMPLER) * self.law_adds(None).sum():
            return 0.0
        return float(added.sum())

    def law_adds(self, guise: Guise | None) -> Array:
        """(labels,) nats that another form of the reflectance gains on held-out ground, alone or beside an effect of the law."""
        places = self.places(guise) if guise else np.zeros(0, np.int64)
        ordinary = self.ordinary_places(guise.effect) if guise else []
        return self._held_out_beside(places, self.form_places(), [k for k in ordinary if k not in places])

    def gains_beside(self, found: Found, other: Found) -> Array:
        """(labels,) nats that an effect gains on held-out ground where any amount of another one stands beside it."""
        return self._held_out_beside(
            self.places(other.guise), self.places(found.guise), self.exclude(found.guise), found.spread
        )

    def _held_out_beside(
        self, free: NDArray[np.int64], places: NDArray[np.int64], exclude: Sequence[int], spread: float = 0.0
    ) -> Array:
        """:meth:`held_out` beside any amounts of the columns ``free``."""
        kept = dict(self.precision)
        self.precision |= {int(p): 1e-10 * self.gram[p, p] for p in free}
        gains = self.held_out(places, exclude, spread)
        self.precision = kept
        return gains


def _integrated_out(u: Products, places: NDArray[np.int64], main: Array, spread: Array) -> Products:
    """The unit without its own amounts, along the directions ``main`` of the columns at ``places``, which scatter by ``spread``."""
    r, sham = main.T @ u.gram[places], main.T @ u.sham[places]
    inner = np.linalg.inv(main.T @ u.gram[np.ix_(places, places)] @ main + np.diag(spread**-2))
    return dataclasses.replace(u, gram=u.gram - r.T @ inner @ r, sham=u.sham - r.T @ inner @ sham)


def _left(unit: Products, b: Array) -> float:
    own = b[unit.place]
    return float(unit.gram[0, 0] - 2 * own @ unit.gram[:, 0] + own @ unit.gram @ own)


__all__ = ["Whole"]
