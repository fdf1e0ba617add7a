"""What cast shadows tell by themselves: which ground is dark, whatever the law of the ground.

Where the Sun should shine on a facet, the share of its light that arrives is measured, brightness over that of the sunlit facet, and
compared with the share of the Sun's disc above the horizon. Effects that move or widen shadows are tried at the values that they name
(``shadow_trials``), beside what relief finer than the DEM does on all ground; each piece of ground is judged at the value that other ground
likes best.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.diagnose.likelihood.jackknife import gain_chance, gain_interval, jackknife_error, nats
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.parallel import per_site
from stages.diagnose.result.answer import Named
from stages.diagnose.search.state import State
from stages.diagnose.settings import CORRELATED, DARKEST, FOLDS, SHADED, UNITS
from stages.effects import Effect, effect_names, get_effect

PARTS = 4  # bands of a site's lines that are judged apart, where grounds are few


@dataclass
class Tried:
    """An effect at all values that were tried. squares : (values, pieces of ground); held_out : (pieces,) at the value that other ground likes best"""

    effects: list[Effect]
    squares: Floats
    held_out: Floats

    @property
    def best(self) -> Effect:
        """Where the squares are least."""
        return self.effects[int(np.argmin(self.squares.sum(1)))]

    def value(self, without: int | None = None) -> float:
        """Of the first coordinate, where the squares are least, between values by a parabola; ``without`` one piece of ground."""
        kept = np.arange(self.squares.shape[1]) != without if without is not None else slice(None)
        total = self.squares[:, kept].sum(1)
        k = int(np.argmin(total))
        first, *others = (p.name for p in self.effects[0].fitted())
        at = np.array([float(e.values[first]) for e in self.effects])
        near = [j for j in (k - 1, k, k + 1) if 0 <= j < len(at)]
        if len(near) < 3 or any(self.effects[j].values[n] != self.effects[k].values[n] for j in near for n in others):
            return float(at[k])
        bend, slope, _ = np.polyfit(at[near] - at[k], total[near], 2)
        move = -slope / (2 * bend) if bend > 0 else 0.0
        return float(np.clip(at[k] + move, at[near].min(), at[near].max()))

    def error(self, grounds: Sequence[int] | NDArray[np.int64]) -> float:
        """Of that value, by leaving out one of these pieces of ground after the other; not less than values that were tried are apart."""
        name = self.effects[0].fitted()[0].name
        apart = [abs(float(e.values[name]) - float(self.best.values[name])) for e in self.effects]
        scatter = float(jackknife_error(np.array([self.value(int(k)) for k in grounds])))
        return max(scatter, min(a for a in apart if a > 0) / math.sqrt(12))

    def open_between(self, squares: float) -> tuple[Effect, float]:
        """The middle of what is left open, and the first coordinate's standard deviation there.

        Of each value of the further coordinates the best counts, if it leaves at most so many ``squares`` more than the least.
        """
        first, *others = (p.name for p in self.effects[0].fitted())
        total = self.squares.sum(1)
        best: dict[tuple[float, ...], int] = {}
        for k, effect in enumerate(self.effects):
            at = tuple(float(effect.values[n]) for n in others)
            if at not in best or total[k] < total[best[at]]:
                best[at] = k
        left = [self.effects[k] for k in best.values() if total[k] <= total.min() + squares]
        values = np.array([float(e.values[first]) for e in left])
        return left[int(np.argmin(np.abs(values - np.median(values))))], float(values.std())


class Shadows:
    """All shadows of the data, and every effect that moves or widens them, at every value to try (name -> effects)."""

    def __init__(self, state: State) -> None:
        self.chains = [c for c in state.chains() if c.state.sun_horizon is not None]
        self.every: dict[str, list[Effect]] = {}
        for e in _of_shadows(state):
            self.every.setdefault(e.name, []).append(e)
        group = [c.site.ground for c in self.chains for _ in range(PARTS)]
        enough = len(set(group)) >= UNITS
        self.numbers = np.unique(group, return_inverse=True)[1] if enough else np.arange(len(group))

    def tried(self, effects: list[Effect], beside: Sequence[Effect]) -> Tried:
        """What these values leave, beside other effects."""
        of_sites = per_site(lambda chain: _squares(chain, effects, beside), self.chains)
        squares = np.array(
            [np.bincount(self.numbers, weights=s) for s in np.concatenate(of_sites, 1)], dtype=np.float64
        )
        fold = np.arange(squares.shape[1]) % FOLDS
        chosen = [int(np.argmin(squares[:, fold != f].sum(1))) for f in fold]
        return Tried(effects, squares, squares[chosen, np.arange(len(fold))])

    def usual(self, beside: Sequence[Effect] = ()) -> list[Tried]:
        """What all ground does, one effect after the other, each beside those before it."""
        out: list[Tried] = []
        for effects in self.every.values():
            if ordinary := [e for e in effects if e.shadows_ordinarily(e.values)]:
                out.append(self.tried(ordinary, [*(t.best for t in out), *beside]))
        return out

    def unusual(self, beside: Sequence[Effect], named: Container[str]) -> list[Tried]:
        """What not all ground does, one effect at a time."""
        beyond = {
            n: [e for e in effects if not e.shadows_ordinarily(e.values)]
            for n, effects in self.every.items()
            if n not in named
        }
        return [self.tried(effects, beside) for effects in beyond.values() if effects]

    def in_turn(self, effects: list[Effect]) -> Tried:
        """The same where what all ground does was fitted without these effects and took a part of them: the two are fitted in turn."""
        best, found = math.inf, self.tried(effects, [])
        while (least := float(found.squares.sum(1).min())) < best:
            best, kept = least, found
            found = self.tried(effects, [t.best for t in self.usual([kept.best])])
        return kept


def by_shadows(state: State) -> list[Named]:
    """The cause that moves shadows surely, more than is ordinary and more than any other does; [] where there is none."""
    shadows = Shadows(state)
    named = {type(c.effect).name for c in state.causes}
    if any(c.effect.slot == "geometry" and not c.effect.displaces for c in state.causes):
        # relief that is wrong casts wrong shadows
        named |= {n for n in shadows.every if get_effect(n).shadow_error}
    if (
        not shadows.chains or not shadows.every or state.free_gains
    ):  # how dark a shadow is nobody knows beside free offsets
        return []
    usual = shadows.usual()
    found = shadows.unusual([t.best for t in usual], named)
    first = min(found, key=lambda t: float(t.held_out.sum()), default=None)
    shown = usual[-1].held_out > 0
    if first is None or not shown.any():
        return []
    before, after = usual[-1].held_out[shown], first.held_out[shown]
    percent = gain_interval(before, after)
    effect, value = first.best, first.value()
    name = effect.fitted()[0].name
    error = first.error(np.flatnonzero(shown))
    nearer = math.copysign(max(abs(value) - 2 * error, 0.0), value)
    most = max(abs(float(e.values[name])) for e in first.effects)
    if (
        not percent[1] > 0
        or abs(value) >= most
        or percent[0] < 100 * SHADED
        or effect.shadows_ordinarily({**effect.values, name: nearer})
    ):
        return []
    if around := effect.shadow_neighbours(state.data):
        near = shadows.in_turn([type(effect)({**t.fixed, **t.columns[0]}, state.data) for t in around])
        effect, scatter = near.open_between(SHADED * float(before.sum()))
        value, error = float(effect.values[name]), math.hypot(error, scatter)
    made = type(effect)({**effect.values, name: value}, state.data)
    rivals = [t.best.name for t in found if t is not first and not gain_interval(t.held_out[shown], after)[1] > 0]
    pixels = float(sum(c.site.valid.sum() for c in shadows.chains))
    return [_named(made, error, before, after, pixels, rivals)]


def _named(made: Effect, error: float, before: Floats, after: Floats, pixels: float, rivals: Sequence[str]) -> Named:
    """The cause with its parameters and evidence. before, after : squares on every piece of ground"""
    name, percent = made.fitted()[0].name, gain_interval(before, after)
    units = {p.name: p.unit for p in made.parameters}
    known = {name: math.hypot(error, made.shadow_error)}
    report = made.report({k: float(v) for k, v in made.values.items()}, known)
    total = nats(float(before.sum()), float(after.sum()), pixels, CORRELATED)
    spread = abs(total) * (percent[2] - percent[1]) / (4 * percent[0])
    was, now = (math.sqrt(float(x.sum()) / pixels) for x in (before, after))
    parameters = {k: (v, e, units[k]) for k, (v, e) in report.items()}
    return Named(made, parameters, gain_chance(before, after), total, spread, was, now, percent, [made.name, *rivals])


def _of_shadows(state: State) -> list[Effect]:
    """Every effect that moves or widens shadows, at every value to try."""
    classes = [get_effect(n) for n in effect_names()]
    return [c({**t.fixed, **t.columns[0]}, state.data) for c in classes for t in c.shadow_trials(state.data)]


def contradicted(state: State) -> dict[str, tuple[float, str]]:
    """Take back causes that change the relief where shadows surely fit worse with them; effect -> nats, why."""
    out: dict[str, tuple[float, str]] = {}
    wide = [e for e in _of_shadows(state) if e.shadows_ordinarily(e.values) and not e.shadow_error]
    for cause in [c for c in state.causes if c.effect.slot == "geometry" and not c.effect.displaces]:
        others = [c.effect for c in state.causes if c is not cause]
        chains = [c for c in state.chains() if c.state.sun_horizon is not None]
        if not (chains and wide) or state.free_gains:
            return out
        with_ = np.concatenate([_squares(c, wide, []) for c in chains], 1)
        plain = [_squares(c, wide, [], state.nominal.chain(c.site, others)) for c in chains]
        before, after = (x[int(np.argmin(x.sum(1)))] for x in (np.concatenate(plain, 1), with_))
        percent = gain_interval(before[before > 0], after[before > 0])
        if percent[2] < 0:
            state.causes.remove(cause)
            state.fit()  # the coefficients were fitted beside it
            why = (
                f"shadows contradict it: they fit worse by {-percent[0]:.1f} % ({-percent[2]:.1f} .. {-percent[1]:.1f})"
            )
            out[cause.effect.name] = cause.found.gain, why
    return out


def _squares(chain: Chain, effects: Sequence[Effect], beside: Sequence[Effect], ground: Chain | None = None) -> Floats:
    """(effects, PARTS) of measured less expected share of sunlight, on facets that the Sun would shine on.

    ground : the chain whose relief casts the shadows, if it is another one
    """
    site, facet = chain.site, chain.state.reflectance
    lit = chain.lit() & site.valid
    level = (facet * lit).sum((-2, -1), keepdim=True) / lit.sum((-2, -1), keepdim=True).clamp(min=1)
    use = (site.valid & (facet > DARKEST * level)).float()
    known = chain.state.sun_visibility
    assert known is not None
    measured = (known + (site.image - chain.predict()) / facet.clamp(min=1e-9)).clamp(0, 1)
    out = []
    for effect in effects:
        share = (ground or chain).visibility([*(b for b in beside if b.name != effect.name), effect])
        assert share is not None
        lines = ((measured - share) ** 2 * use).sum((0, 2))
        out.append([float(p.sum()) for p in torch.tensor_split(lines, PARTS)])
    return np.array(out)


__all__ = ["by_shadows", "contradicted"]
