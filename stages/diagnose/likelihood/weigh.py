"""Evidence for every effect: likelihood ratios beside all that is fitted along, calibrated on sham residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.diagnose.likelihood.columns import Guise
from stages.diagnose.likelihood.intervals import surprise
from stages.diagnose.likelihood.products import Array
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.settings import LEVELS, SURE
from stages.effects import get_effect


@dataclass
class Found:
    """An effect in its best guise. amount, error : in multiples of the guise's columns (per frame: of ``strong``)

    surprise : -log10 of the chance of so much likelihood, calibrated on shams; p : family-wise
    spread : standard deviation over the frames, of an effect per frame
    levels : whether it explains what gains of every image would, which are no nuisance then
    """

    effect: str
    guise: Guise
    amount: Array
    error: Array
    surprise: float
    p: float = 1.0
    spread: float = 0.0
    levels: bool = False

    @property
    def values(self) -> int:
        """How many numbers it takes to say."""
        return len(self.amount)


def weigh_all(whole: Whole) -> tuple[dict[str, Found], Array]:
    """The best guise of every effect with its family-wise p, and the largest surprise of every sham."""
    every = {_key(guise): (guise, *weigh(whole, guise)) for guise in whole.plan.guises if _counts(whole, guise)}
    best: dict[str, Found] = {}
    null: dict[str, Array] = {}
    for guise, found, shams in every.values():
        name = guise.effect
        if get_effect(name).one_sided and (
            mirrored := every.get(_key(guise, -1))
        ):  # only what is not alike on both sides
            found.surprise, shams = (
                max(found.surprise - mirrored[1].surprise, 0.0),
                np.maximum(shams - mirrored[2], 0.0),
            )
        null[name] = np.maximum(null[name], shams) if name in null else shams
        if name not in best or found.surprise > best[name].surprise:
            best[name] = found
    largest = np.max(np.stack(list(null.values())), 0) if null else np.zeros(1)
    for found in best.values():
        found.p = family_wise(found.surprise, largest)
    return best, largest


def family_wise(value: float, largest: Array) -> float:
    """Chance that the largest surprise of all effects is as large where nothing is there; largest : (R,) of every sham."""
    return (1 + float((largest >= value).sum())) / (1 + len(largest))


def _counts(whole: Whole, guise: Guise) -> bool:
    places = whole.places(guise)
    return not get_effect(guise.effect).judged_apart and len(places) > 0 and bool(whole.seen[places].all())


def _key(guise: Guise, sign: int = 1) -> tuple[object, ...]:
    """What tells a guise from the others of its effect; or the same on the other side."""
    side = get_effect(guise.effect).one_sided
    fixed = ((k, sign * v if k == side else v) for k, v in sorted(guise.trial.fixed.items()))
    return guise.effect, *fixed, *(tuple(sorted(c.items())) for c in guise.trial.columns)


def weigh(whole: Whole, guise: Guise) -> tuple[Found, Array]:
    """Evidence for one guise, and the same of every sham."""
    if judge := whole.by_levels(guise):
        return weigh(judge, guise)
    places = whole.places(guise)
    information, score, shams, _ = whole.reduce(places, whole.exclude(guise))
    if guise.per_frame:
        return _weigh_frames(guise, information, score, shams)
    inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    amount = inverse @ score
    ratio = float(score @ amount)
    null = np.einsum("ar,ab,br->r", shams, inverse, shams)
    inflation = max(1.0, float(null.mean()) / len(places)) if len(null) else 1.0
    error = np.sqrt(np.maximum(inverse.diagonal(), 0))
    found = Found(guise.effect, guise, amount, error, 0.0)
    if len(whole.scattered):
        in_place, instead = in_place_of_gains(whole.levels or whole, places, whole.exclude(guise))
        if in_place > ratio:
            ratio = in_place
            # the insides of the images have to agree
            found.levels = bool((np.abs(instead - amount) <= SURE * error).all())
            found.amount = instead if found.levels else amount
    surprises = surprise(np.concatenate([[ratio], null]) / inflation, len(places))
    found.surprise = float(surprises[0])
    return found, surprises[1:]


def in_place_of_gains(whole: Whole, places: NDArray[np.int64], exclude: Sequence[int]) -> tuple[float, Array]:
    """Twice the log likelihood that the columns gain where the scatter of the images' gains is estimated with and without them; their amounts."""
    j = len(places)
    information, score, _, _ = whole.reduce(np.concatenate([places, whole.scattered]), exclude)
    own = np.linalg.pinv(information[:j, :j], rcond=1e-9, hermitian=True)
    with_ = information[j:, j:] - information[j:, :j] @ own @ information[:j, j:]
    left = score[j:] - information[j:, :j] @ own @ score[:j]
    best, spread = _scatter(with_, left)
    none, _ = _scatter(information[j:, j:], score[j:])
    explained = float(score[:j] @ own @ score[:j])
    if explained - 2 * j > none:  # alone they explain what the gains do, less two for each value (Akaike 1974)
        return explained, own @ score[:j]
    known = information + np.diag([0.0] * j + [spread**-2] * (len(information) - j))
    amount = np.linalg.pinv(known, rcond=1e-9, hermitian=True) @ score
    return explained + best - none, amount[:j]


def _weigh_frames(guise: Guise, information: Array, score: Array, shams: Array) -> tuple[Found, Array]:
    power, axes = np.linalg.eigh(information)
    power = np.maximum(power, 0.0)

    def ratio(squares: Array) -> tuple[Array, Array]:
        """Twice the log likelihood at the best level, and which it is; squares (J, R)."""
        every = np.stack([(squares / (power[:, None] + v**-2)).sum(0) - np.log1p(v * v * power).sum() for v in LEVELS])
        return np.maximum(every.max(0), 0.0), every.argmax(0)

    best, level = ratio((axes.T @ score)[:, None] ** 2)
    null, _ = ratio((axes.T @ shams) ** 2)
    spread = LEVELS[int(level[0])]
    variance = (axes / (power + spread**-2)) @ axes.T
    error = np.sqrt(np.maximum(variance.diagonal(), 0))
    found = Found(guise.effect, guise, variance @ score, error, float(best[0]) / 2 / math.log(10), spread=spread)
    return found, null / 2 / math.log(10)


def _scatter(information: Array, score: Array) -> tuple[float, float]:
    """Twice the log likelihood of values that scatter about nothing, at the best of their standard deviations, and it."""
    power, axes = np.linalg.eigh((information + information.T) / 2)
    power, squares = np.maximum(power, 0.0), (axes.T @ score) ** 2
    return max(
        (float((squares / (power + v**-2)).sum() - np.log1p(v * v * power).sum()), v)
        for v in np.geomspace(1e-3, 10, 25)
    )


def beyond_bounds(found: Found) -> bool:
    """Whether a coordinate of the first estimate is surely not within its bounds: what these allow is not what was found."""
    cls = get_effect(found.effect)
    for amount, error, column in zip(found.amount, found.error, found.guise.trial.columns, strict=True):
        for name, at in column.items():
            null, (low, high) = cls.null()[name], cls.bounds(name)
            value, least = null + amount * (at - null), SURE * error * abs(at - null)
            if value < low - least or value > high + least:
                return True
    return False


__all__ = ["Found", "beyond_bounds", "family_wise", "weigh_all"]
