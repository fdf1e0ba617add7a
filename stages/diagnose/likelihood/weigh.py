"""Evidence for every candidate: likelihood ratios beside the nuisance, calibrated on sham residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.diagnose.likelihood.found import Found
from stages.diagnose.likelihood.products import Array
from stages.diagnose.likelihood.tails import surprise
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.rows.columns import Guise, Plan
from stages.diagnose.settings import LEVELS, SURE
from stages.effects import get_effect


def weigh_all(whole: Whole) -> tuple[dict[str, Found], Array]:
    """The best guise of every effect with its family-wise p, and the largest surprise of every sham."""
    best: dict[str, Found] = {}
    null: dict[str, Array] = {}
    every = [
        (guise, *weigh(whole, guise))
        for guise in whole.plan.guises
        if not get_effect(guise.effect).judged_apart
        and len(whole.places(guise))
        and whole.seen[whole.places(guise)].all()
    ]
    others = {_look(guise): (found.surprise, shams) for guise, found, shams in every}
    for guise, found, shams in every:
        e = guise.effect
        if get_effect(e).one_sided:
            alike, by_chance = others.get(_look(guise, -1), (0.0, np.zeros(1)))
            found.surprise, shams = max(found.surprise - alike, 0.0), np.maximum(shams - by_chance, 0.0)
        null[e] = np.maximum(null[e], shams) if e in null else shams
        if e not in best or found.surprise > best[e].surprise:
            best[e] = found
    if not best:
        return {}, np.zeros(1)
    largest = np.max(np.stack(list(null.values())), 0)
    for found in best.values():
        found.p = (1 + float((largest >= found.surprise).sum())) / (1 + len(largest))
    return best, largest


def _look(guise: Guise, sign: int = 1) -> tuple[object, ...]:
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
    surprises = surprise(np.concatenate([[ratio], null]) / inflation, len(places))
    found = Found(guise.effect, guise, amount, error, float(surprises[0]))
    if len(whole.scattered):
        beside, spread, instead = beside_gains(whole.levels or whole, places, whole.exclude(guise))
        if beside > ratio:
            found.surprise = max(found.surprise, float(surprise(np.array([beside / inflation]), len(places))[0]))
            found.beside, found.instead = spread, instead is not None and _agree(instead, amount, error)
            found.amount = amount if instead is None else instead
        if found.instead:
            found.odds = odds_over_gains(whole.levels or whole, places, whole.exclude(guise))
    return found, surprises[1:]


def _agree(instead: Array, amount: Array, error: Array) -> bool:
    """Whether amounts that stand for gains may be those that the insides of the images, beside free gains, tell of the effect."""
    return bool((np.abs(instead - amount) <= SURE * error).all())


def beside_gains(whole: Whole, places: NDArray[np.int64], exclude: Sequence[int]) -> tuple[float, float, Array | None]:
    """Twice the log likelihood that the columns gain if the scatter of the gains is estimated with and without them, and it;
    their amounts where they stand for the gains.

    Columns that alone, or beside gains no larger than all data have, explain what gains of every image do, less two for each of their
    values (Akaike 1974), stand for these. Alone, nothing is taken off for what gains would explain; else what ordinary gains would.
    """
    gains = whole.scattered
    j = len(places)
    information, score, _, _ = whole.reduce(np.concatenate([places, gains]), exclude)
    own = np.linalg.pinv(information[:j, :j], rcond=1e-9, hermitian=True)
    with_ = information[j:, j:] - information[j:, :j] @ own @ information[:j, j:]
    left = score[j:] - information[j:, :j] @ own @ score[:j]
    explained = float(score[:j] @ own @ score[:j])
    best, spread = _scatter(with_, left)
    none, large = _scatter(information[j:, j:], score[j:])
    if explained - 2 * j > none:
        return explained, spread, own @ score[:j]
    usual = _usual(whole.plan)
    if large <= usual:  # nothing more has to be explained
        return max(explained + best - none, 0.0), spread, None
    beside, usually = _scatter(with_, left, usual)
    if explained + beside - 2 * j > none:
        less, _ = _scatter(information[j:, j:], score[j:], usual)
        known = information + np.diag([0.0] * j + [usually**-2] * len(gains))
        return (
            max(explained + beside - less, 0.0),
            usually,
            (np.linalg.pinv(known, rcond=1e-9, hermitian=True) @ score)[:j],
        )
    return max(explained + best - none, 0.0), spread, None


def odds_over_gains(whole: Whole, places: NDArray[np.int64], exclude: Sequence[int]) -> float:
    """Nats by which columns, beside gains as all data have, are likelier than gains of any scatter alone. Either kind of value is drawn from about nothing
    with one standard deviation, that which fits best: of few images as few gains explain as much as the columns do (Bayes factor: MacKay 2003, ch. 28).
    """
    gains, j = whole.scattered, len(places)
    information, score, _, _ = whole.reduce(np.concatenate([places, gains]), exclude)
    alone, _ = _scatter(information[j:, j:], score[j:])
    columns, spread = _scatter(information[:j, :j], score[:j])
    known = np.linalg.inv(information[:j, :j] + np.eye(j) * spread**-2)
    rest, _ = _scatter(
        information[j:, j:] - information[j:, :j] @ known @ information[:j, j:],
        score[j:] - information[j:, :j] @ known @ score[:j],
        _usual(whole.plan),
    )
    return (columns + rest - alone) / 2


def _usual(plan: Plan) -> float:
    """Scatter of the images' gains that all data have, in the sizes worth knowing in which these are counted."""
    (gains,) = {c for c in map(get_effect, plan.per_frame) if c.scatters and not c.displaces}
    ((ordinary,), (size,)) = gains.tolerance.values(), gains.strong.values()
    return ordinary / size


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
    amount = variance @ score
    error = np.sqrt(np.maximum(variance.diagonal(), 0))
    found = Found(guise.effect, guise, amount, error, float(best[0]) / 2 / math.log(10), spread=spread)
    return found, null / 2 / math.log(10)


def _scatter(information: Array, score: Array, most: float = 10.0) -> tuple[float, float]:
    """Twice the log likelihood of values that scatter about nothing, at the best of their standard deviations up to ``most``, and it."""
    power, axes = np.linalg.eigh((information + information.T) / 2)
    power, squares = np.maximum(power, 0.0), (axes.T @ score) ** 2
    every = [
        (float((squares / (power + v**-2)).sum() - np.log1p(v * v * power).sum()), v)
        for v in np.geomspace(1e-3, most, 25)
    ]
    return max(every)


__all__ = ["beside_gains", "weigh_all"]
