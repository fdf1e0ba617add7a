"""The values of all named effects that fit best together: Gauss-Newton steps, rendered again each time."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.common.intervals import effective_units, student_quantile
from stages.diagnose.judge.state import Cause, State, View
from stages.diagnose.likelihood.intervals import jackknife_error
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.settings import LONGEST, SETTLED, SHORTEST, STEPS
from stages.effects import Survey, get_effect

EXTRAPOLATED = 3.0  # multiples of a column, beyond which it says little of how large an effect is


def as_effect(found, data: Survey, frames: int, whole):
    """The effect at the first estimate of its values, within bounds."""
    cls = get_effect(found.effect)
    values = {**cls.null(), **found.guise.trial.fixed}
    if found.guise.per_frame:
        table = np.zeros(len(whole.plan.per_frame) * frames)
        places = whole.places(found.guise)
        table[places - whole.first] = found.amount
        for k, column in zip(found.guise.columns, found.guise.trial.columns, strict=True):
            ((name, size),) = column.items()
            values[name] = torch.from_numpy(table[k * frames : (k + 1) * frames] * size).float()
        return cls(values, data)
    for amount, column in zip(found.amount, found.guise.trial.columns, strict=True):
        for name, at in column.items():
            low, high = cls.bounds(name)
            null = cls.null()[name]
            values[name] = min(max(null + float(amount) * (at - null), low), high)
    effect = cls(values, data)
    touched = {name for column in found.guise.trial.columns for name in column}
    effect.held = tuple(p.name for p in cls.fitted() if p.name not in touched and p.name not in cls.shaped)
    return effect


def refine(state: State, view: View) -> View:
    """Fit the nominal model and all causes' values together; sets values and errors; returns the last look.

    view : at nearly the same values: what it has of other effects is not rendered again
    """
    look: View | None = None
    least, last = math.inf, math.inf  # squares left at the best values so far, length of the last step
    share = used = 1.0  # of a step, and of the last one
    best = [c.effect for c in state.causes]
    state.fit()  # from here on the coefficients move along as columns
    for _ in range(STEPS):
        now = state.again(view, along(state, view), look.model if look else None)
        left = _left(state, now)
        if look is not None and abs(left - least) < SETTLED:
            break
        if left > least:  # the step was too long: half of it, from where it started
            share = used / 2
            for cause, effect in zip(state.causes, best, strict=True):
                cause.effect = effect
            if share < SHORTEST:
                break
        else:
            look, least = now, left
            best = [c.effect for c in state.causes]
        assert look is not None
        moved, used = _step(state, look, share), share
        if moved < SETTLED:
            break
        if look is now:  # steps that do not get shorter are too short: the squares are no parabola
            share = min(2 * share, LONGEST) if moved > max(0.5 * last, 1.0) else share
            last = moved
    _take_out_means(state)
    state.fit()
    assert look is not None
    return look


def _take_out_means(state: State) -> None:
    """Of values per image whose mean is the nominal model's brightness: the fit may let both run off, each against the other."""
    for cause in state.causes:
        cls = type(cause.effect)
        if not (cls.about_mean and cause.found.guise.per_frame):
            continue
        table = {p.name: torch.as_tensor(cause.effect.values[p.name]).clone() for p in cls.fitted()}
        for values in table.values():
            known = values != 0
            if bool(known.any()):
                values[known] = (1 + values[known]) / (1 + values[known].mean()) - 1
        cause.effect = cls({**cause.effect.values, **table}, state.data)


def start_nearer(state: State, view: View, cause: Cause) -> None:
    """Halve the first estimate of a single amount for all images while that leaves less, where its column was extrapolated to many times its size
    and until it is not any more: effects that grow faster than their column come out far too large at first, and are not found back from there.
    """
    cls = type(cause.effect)
    if state.free_gains:  # they follow what is rendered, and squares of different values are no measure of it
        return
    if not cause.single or cls.linear or abs(float(cause.found.amount[0])) < EXTRAPOLATED:
        return
    names = [n for column in cause.found.guise.trial.columns for n in column]
    kept, least, amount = cause.effect, math.inf, 2 * abs(float(cause.found.amount[0]))
    while (amount := amount / 2) > 1:
        left = _left(state, state.again(view, along(state, view), view.model))
        if left > least:
            break
        kept, least = cause.effect, left
        halved = {n: 0.5 * (float(kept.values[n]) + cls.null()[n]) for n in names}
        cause.effect = cls({**kept.values, **halved}, state.data)
        cause.effect.held = kept.held
    cause.effect = kept


def _left(state: State, view: View) -> float:
    """Whitened squares of the residual, all nuisance fitted along, and of values per frame over their scatter."""
    whole = view.whole
    kept = dict(whole.precision)
    for place in _scene_places(view)[0]:
        whole.precision.pop(int(place), None)
    _, score, _, _ = whole.reduce(np.zeros(1, dtype=np.int64), _stood_for(state, whole))
    whole.precision = kept
    scattered = [c for c in state.causes if c.found.guise.per_frame]
    return float(score[0]) + sum(
        float(((_per_frame(c, whole.frames) / _sizes(c)[:, None] / c.found.spread) ** 2).sum()) for c in scattered
    )


def _per_frame(cause: Cause, frames: int) -> Floats:
    """(coordinates, frames) the values of a cause."""
    values = [np.asarray(cause.effect.values[p.name], np.float64) for p in type(cause.effect).fitted()]
    return np.stack([np.broadcast_to(v, (frames,)) for v in values])


def _sizes(cause: Cause) -> Floats:
    """(coordinates,) sizes worth knowing, in which values per frame scatter."""
    cls = type(cause.effect)
    return np.array([cls.strong[p.name] for p in cls.fitted()])


def settle(state: State, view: View) -> None:
    """Values and errors of all causes, fitted together once more."""
    if state.causes:
        errors_over_images(state, refine(state, view))
    else:
        state.fit()


def along(state: State, view: View) -> list[str]:
    """Effects that are fitted beside the causes: those that all data have a little of."""
    known = {*view.plan.shared, *view.plan.per_frame}
    ordinary = [n for n in state.open_names() if n in known]
    return [n for n in ordinary if _ordinary(n) or get_effect(n).always]


def errors_over_images(state: State, view: View) -> None:
    """Errors of scene-wide values by a jackknife over images.

    What is wrong with the law goes with an image's geometry and is the same on all ground: leaving out ground does not show it.
    What only shapes an effect stays as it is: it means nothing where the effect may be nothing.
    """
    every, owned = _scene_places(view)
    amounts = [k for k, (place, name, _) in enumerate(owned) if name not in type(state.causes[place].effect).shaped]
    places = every[amounts]
    if not len(places):
        return
    left, covariances = [], []
    for whole in state.without_images(view):
        for p in every:
            whole.precision.pop(int(p), None)
        if whole.seen[places].all():
            moves, _, covariance = _amounts(state, whole, places)
            left.append(moves)
            covariances.append(covariance)
    if len(left) < 2:
        return
    table, kept = np.array(left), [owned[k] for k in amounts]
    for place in {place for place, _, _ in kept}:
        cause = state.causes[place]
        own = [k for k, (p, _, _) in enumerate(kept) if p == place]
        null = type(cause.effect).null()
        found = np.array([float(cause.effect.values[kept[k][1]]) - null[kept[k][1]] for k in own])
        parts = [c[np.ix_(own, own)] for c in covariances]
        known = [np.linalg.pinv(c, rcond=1e-9, hermitian=True) for c in parts]
        rest = np.array([float(found @ precision @ found) for precision in known])
        # of one factor on all values: each counts as far as the images that are left know it
        shares = np.array([float(found @ precision @ move[own]) for precision, move in zip(known, left, strict=True)])
        told = np.maximum(rest.sum() / (len(rest) - 1) - rest, 0.0)  # by each group of images, if it adds up
        groups = effective_units(told) if told.any() else len(told)
        if groups < 3 and cause.effect.lights_shadows:  # few images show deep shadow
            # what an image may have of its own is in the likelihood, and too few are left to see it
            cause.over_images, cause.share_error = {}, 0.0
            continue
        cause.share_error, cause.share_freedom = (
            float(jackknife_error(shares / np.maximum(rest, 1e-30), rest)),
            max(groups - 1, 1.0),
        )
        errors = jackknife_error(table[:, own], 1 / np.maximum([c.diagonal() for c in parts], 1e-30))
        cause.over_images = {kept[k][1]: float(error) for k, error in zip(own, errors, strict=True)}


def _scene_places(view: View) -> tuple[NDArray[np.int64], list[tuple[int, str, float]]]:
    """Places of the values of scene-wide causes among the columns, and whose they are."""
    plan = view.plan
    first = next((k for k, n in enumerate(plan.shared) if "." in n), len(plan.shared))
    return np.array([1 + first + k for k in range(len(plan.steps))], dtype=np.int64), list(plan.steps)


def _ordinary(name: str) -> bool:
    cls = get_effect(name)
    return cls.scope == "scene" and bool(cls.tolerance)


def _step(state: State, view: View, share: float) -> float:
    """Move all values by a share of the Gauss-Newton step; returns the largest move in standard errors."""
    whole = view.whole
    places, steps = _scene_places(view)
    scene = list(enumerate(steps))
    largest = 0.0
    if scene:
        seen = whole.seen[places]
        for p in places:
            whole.precision.pop(int(p), None)
        amounts, errors, _ = _amounts(state, whole, places[seen])
        owned = [step for (_, step), ok in zip(scene, seen, strict=True) if ok]
        amount_only = np.array([name not in type(state.causes[place].effect).shaped for place, name, _ in owned])
        if amount_only.any():
            amounted = [o for o, ok in zip(owned, amount_only, strict=True) if ok]
            _set_away(state, amounted, *_amounts(state, whole, places[seen][amount_only])[1:])
        for p in places:
            whole.precision[int(p)] = 1e-10 * whole.gram[p, p]
        for (place, name, _), amount, error in zip(owned, amounts, errors, strict=True):
            cause = state.causes[place]
            cls = type(cause.effect)
            low, high = cls.bounds(name)
            # what is no more than ordinary stays so, whatever it stands for beside another cause
            if cause.ordinary and name in cls.tolerance:
                middle, least = cls.null()[name], cls.tolerance[name]
                low, high = max(low, middle - least), min(high, middle + least)
            now = float(cause.effect.values[name])
            limit = max(abs(now - cls.null()[name]), 10 * cls.step(name, state.data))
            moved = min(max(now + share * float(np.clip(amount, -limit, limit)), low), high)
            largest = max(largest, abs(moved - now) / max(error, 1e-12))
            effect = cls({**cause.effect.values, name: moved}, state.data)
            effect.held = cause.effect.held
            cause.effect = effect
            cause.errors[name] = float(error)
    for cause in state.causes:
        if cause.found.guise.per_frame:
            largest = max(largest, _step_frames(state, view, cause, share))
    return largest


def _set_away(
    state: State, owned: list[tuple[int, str, float]], errors: NDArray[np.float64], covariance: NDArray[np.float64]
) -> None:
    """Errors of amounts where what only shapes an effect is held, and how far each cause is from nothing by all of them together.

    Values that stand for each other have large errors each, and may be sure together: that is what the covariance says.
    """
    for place in {place for place, _, _ in owned}:
        cause = state.causes[place]
        own = [k for k, (p, _, _) in enumerate(owned) if p == place]
        names = [owned[k][1] for k in own]
        cause.of_given_shape |= dict(zip(names, errors[own].tolist(), strict=True))
        null = type(cause.effect).null()
        found = np.array([float(cause.effect.values[n]) - null[n] for n in names])
        known = covariance[np.ix_(own, own)]
        wider = float((errors[own] ** 2 / np.maximum(known.diagonal(), 1e-30)).mean())
        squares = float(found @ np.linalg.pinv(known, rcond=1e-9, hermitian=True) @ found)
        cause.away = math.sqrt(max(squares, 0.0) / max(wider, 1.0))


def _amounts(state: State, whole: Whole, places: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Moves of all coordinates, their errors, and the likelihood's covariance."""
    return list(whole.errors(places, _stood_for(state, whole)))


def _stood_for(state: State, whole: Whole) -> list[int]:
    """Places of what the causes stand for."""
    return whole.stood_for([type(c.effect) for c in state.causes])


def _step_frames(state: State, view: View, cause: Cause, share: float) -> float:
    """Move the values per frame, drawn to nothing as far as the first estimate found."""
    whole = view.whole
    guise = next((g for g in view.plan.guises if g.effect == cause.effect.name), None)
    if guise is None:
        return 0.0
    places = whole.places(guise)
    if not len(places):  # no frame is seen well enough beside the other causes
        return 0.0
    cls = type(cause.effect)
    names, sizes = [p.name for p in cls.fitted()], _sizes(cause)
    index = places - whole.first
    column, frame = index // whole.frames - min(guise.columns), index % whole.frames
    table = _per_frame(cause, whole.frames)
    now = table[column, frame] / sizes[column]
    prior = cause.found.spread**-2
    information, score, _, _ = whole.reduce(places)
    inverse = np.linalg.inv(information + prior * np.eye(len(places)))
    move = share * inverse @ (score - prior * now)
    out = table.copy()
    out[column, frame] = (now + move) * sizes[column]
    cause.effect = cls({n: torch.from_numpy(out[k].copy()).float() for k, n in enumerate(names)}, state.data)
    # where the mean of the images is the nominal model's, they are told apart by values about it
    alike = cls.about_mean * (column[:, None] == column) / np.bincount(column)[column]
    frames = max(len(set(frame.tolist())) - cls.about_mean, 1)

    def apart(values: NDArray[np.float64]) -> NDArray[np.float64]:
        sized = values * sizes[column]
        return (1 + sized) / (1 + alike @ sized) - 1

    own, scale = np.eye(len(places)) - alike, sizes[column] / (1 + alike @ ((now + move) * sizes[column]))
    covariance = np.asarray(own @ inverse @ own * np.outer(scale, scale), np.float64)

    def rms(values: NDArray[np.float64]) -> float:
        # the mean square of values is that of their estimates, which are drawn to nothing, and their variances
        return math.sqrt(float((apart(values) ** 2 + covariance.diagonal()).sum()) / frames)

    # the law differs from site to site: pieces of one have that in common, and few sites agree in it by chance
    sites = [u.site for u in whole.units]
    without = [rms(now + m) for m in whole.without_one(places, spread=cause.found.spread, now=now, of=sites)]
    show = float(np.median(np.bincount(np.concatenate([s.frames for s in state.sites]), minlength=whole.frames)[frame]))
    scatter = float(jackknife_error(np.array(without)))
    cause.rms = rms(now + move)
    left_open = error_of_rms(apart(now + move), covariance, cause.rms, frames)
    cause.errors["rms"] = max(
        _error_over_sites(scatter, show, len(without), max(cls.tolerance.values(), default=0.0)), left_open
    )
    return float(np.sqrt((move**2).mean() / max(inverse.diagonal().mean(), 1e-12)))


def _error_over_sites(scatter: float, show: float, sites: int, ordinary: float) -> float:
    """Of an rms whose jackknife error over sites is ``scatter``, where two errors are asked for; show : sites that show a frame.

    Sites that show the same frame tell by themselves what the law does in it. Where one or two do, an image has of its law no more than is ordinary
    of the effect: up to 1.1 % of gain in other people's files.
    """
    told, ground = (student_quantile(max(count - 1, 1.0)) / 2 * scatter for count in (show, sites))
    return min(told, math.hypot(ground, ordinary / math.sqrt(show)))


def error_of_rms(mean: Floats, covariance: Floats, rms: float, frames: int) -> float:
    """Of the rms of normal values about nothing: their squares scatter by what the values and what is left open of them do together."""
    squares = 4 * mean @ covariance @ mean + 2 * float((covariance**2).sum())
    return math.sqrt(squares) / frames / max(2 * rms, 1e-12)


__all__ = ["along", "as_effect", "error_of_rms", "errors_over_images", "refine", "settle", "start_nearer"]
