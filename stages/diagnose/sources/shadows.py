"""What cast shadows tell by themselves: which ground is dark, whatever the law of the ground.

Where the Sun should shine on a facet, the share of its light that arrives is measured, brightness over that of the sunlit facet, and
compared with the share of the Sun's disc above the horizon, as errors of the DEM blur and lift it (``edges.py``). Effects that move or
widen shadows are tried at the values that they name (``shadow_trials``), beside what all ground does; each piece of ground is judged at
the value that other ground likes best.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.common.arrays import Floats
from stages.diagnose.data.parallel import per_site
from stages.diagnose.judge.claim import Rival
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.intervals import folds, interval, jackknife_error
from stages.diagnose.model.chain import Chain
from stages.diagnose.settings import FALLS, OPEN, SHADED, UNITS
from stages.diagnose.sources.edges import PARTS, Edges, Horizons, move, squares
from stages.diagnose.sources.measured import Measured, measured
from stages.effects import Effect, effect_names, get_effect

ROUNDS = 5  # at most, in which the horizons' errors are fitted at a value's best
LARGEST = 1.0  # rad px: heights are off by no more than a pixel, however dark a wall leaves the images
SETTLED = 1e-3  # of the squares: what less would be gained by is the end


@dataclass
class Tried:
    """An effect at all values that were tried. products : (values, pieces of ground, 3, 3), about these errors of horizons"""

    effects: list[Effect]
    products: Floats
    about: Horizons

    def left(self, kept: NDArray[np.bool_] | slice = slice(None)) -> tuple[Floats, Floats]:
        """(values,) least squares on these pieces of ground, and (values, 2) how the horizons' errors move to get there."""
        total = self.products[:, kept].sum(1)
        moves = np.array([move(p) for p in total])
        return np.array([squares(p, m) for p, m in zip(total, moves, strict=True)]), moves

    @property
    def best(self) -> Effect:
        """Where the squares are least."""
        return self.effects[int(np.argmin(self.left()[0]))]

    def held_out(self) -> Floats:
        """(pieces,) squares at the value, and beside the errors of horizons, that other ground likes best."""
        fold = folds(self.products.shape[1])
        out = np.zeros(len(fold))
        for f in set(fold):
            left, moves = self.left(fold != f)
            k = int(np.argmin(left))
            out[fold == f] = squares(self.products[k, fold == f], moves[k])
        return out

    def value(self, without: int | None = None) -> float:
        """Of the first coordinate, where the squares are least, between values by a parabola; ``without`` one piece of ground."""
        total, _ = self.left(np.arange(self.products.shape[1]) != without if without is not None else slice(None))
        k = int(np.argmin(total))
        first, *others = (p.name for p in self.effects[0].fitted())
        at = np.array([float(e.values[first]) for e in self.effects])
        near = [j for j in (k - 1, k, k + 1) if 0 <= j < len(at)]
        if len(near) < 3 or any(self.effects[j].values[n] != self.effects[k].values[n] for j in near for n in others):
            return float(at[k])
        bend, slope, _ = np.polyfit(at[near] - at[k], total[near], 2)
        away = -slope / (2 * bend) if bend > 0 else 0.0
        return float(np.clip(at[k] + away, at[near].min(), at[near].max()))

    def error(self, grounds: Sequence[int] | NDArray[np.int64]) -> float:
        """Of that value, by leaving out one of these pieces of ground after the other; not less than values that were tried are apart."""
        name = self.effects[0].fitted()[0].name
        apart = [abs(float(e.values[name]) - float(self.best.values[name])) for e in self.effects]
        scatter = float(jackknife_error(np.array([self.value(int(k)) for k in grounds])))
        return max(scatter, min(a for a in apart if a > 0) / math.sqrt(12))

    def open_between(self, more: float) -> tuple[Effect, float]:
        """The middle of what is left open, and the scatter of the first coordinate there, which is one of factors.

        Of each value of the further coordinates the best counts, if it leaves at most so many squares ``more`` than the least.
        """
        first, *others = (p.name for p in self.effects[0].fitted())
        total, _ = self.left()
        best: dict[tuple[float, ...], int] = {}
        for k, effect in enumerate(self.effects):
            at = tuple(float(effect.values[n]) for n in others)
            if at not in best or total[k] < total[best[at]]:
                best[at] = k
        kept = [self.effects[k] for k in best.values() if total[k] <= total.min() + more]
        values = np.array([float(e.values[first]) for e in kept])  # heights, above nothing
        middle = float(np.median(values))
        return kept[int(np.argmin(np.abs(values - middle)))], middle * float(np.log(values).std())


class Shadows:
    """All shadows of the data, and every effect that moves or widens them, at every value to try (name -> effects)."""

    def __init__(self, state: State, edges: Sequence[Edges]) -> None:
        self.edges = list(edges)
        self.every: dict[str, list[Effect]] = {}
        classes = [get_effect(n) for n in effect_names()]
        for e in [c({**t.fixed, **t.columns[0]}, state.data) for c in classes for t in c.shadow_trials(state.data)]:
            self.every.setdefault(e.name, []).append(e)
        count = len(self.edges)
        self.numbers = np.repeat(np.arange(count), PARTS) if count >= UNITS else np.arange(count * PARTS)

    def tried(self, effects: list[Effect], beside: Sequence[Effect], about: Horizons = Horizons()) -> Tried:
        """What these values leave, beside other effects; ``about``: errors of horizons to start from."""
        for _ in range(ROUNDS):
            of_sites = per_site(lambda edges: edges.products(effects, beside, about), self.edges)  # noqa: B023
            rows = np.concatenate(of_sites, 1)  # (values, sites * PARTS, 3, 3)
            total = np.stack([rows[:, self.numbers == k].sum(1) for k in range(self.numbers.max() + 1)], 1)
            found = Tried(effects, total, about)
            left, moves = found.left()
            k = int(np.argmin(left))
            if left[k] > (1 - SETTLED) * total[k].sum(0)[0, 0]:
                break
            blur = float(np.clip(about.blur + moves[k, 0], about.blur / 2, min(2 * about.blur, LARGEST)))
            about = Horizons(blur, about.lift + float(np.clip(moves[k, 1], -blur, blur)), about.fall)
        return found

    def usual(self, beside: Sequence[Effect] = (), fall: float = FALLS[0]) -> list[Tried]:
        """What all ground does, one effect after the other, each beside those before it and beside these. fall : of :class:`Horizons`"""
        out: list[Tried] = []
        for name, effects in self.every.items():
            if name in {e.name for e in beside}:
                continue
            if ordinary := [e for e in effects if e.shadows_ordinarily(e.values)]:
                about = out[-1].about if out else Horizons(fall=fall)
                out.append(self.tried(ordinary, [*_best(out), *beside], about))
        return out

    def unusual(self, usual: Sequence[Tried], named: Container[str]) -> list[Tried]:
        """What not all ground does, one effect at a time beside what all does."""
        beyond = {
            n: [e for e in effects if not e.shadows_ordinarily(e.values)]
            for n, effects in self.every.items()
            if n not in named
        }
        return [self.tried(e, _best(usual), usual[-1].about) for e in beyond.values() if e]

    def in_turn(self, effects: list[Effect], fall: float = FALLS[0]) -> Tried:
        """The same where what all ground does was fitted without these effects and took a part of them: the two are fitted in turn."""
        best, found = math.inf, self.tried(effects, [], Horizons(fall=fall))
        while (least := float(found.left()[0].min())) < best:
            best, kept = least, found
            usual = self.usual([kept.best], fall)
            found = self.tried(effects, _best(usual), usual[-1].about)
        return kept


def _best(every: Sequence[Tried]) -> list[Effect]:
    """Of each the best values, where these do anything."""
    return [t.best for t in every if any(t.best.values[k] != v for k, v in t.best.null().items())]


def by_shadows(state: State) -> list[Measured]:
    """The effect that moves shadows most, with all others that do nearly as much as its group."""
    chains = [c for c in state.chains() if c.state.sun_horizon is not None]
    # how dark a shadow is nobody knows beside free offsets
    if not chains or state.free_gains:
        return []
    shadows = Shadows(state, per_site(Edges, chains))
    known = {type(c.effect).name for c in state.causes}
    if any(c.effect.slot == "geometry" and not c.effect.displaces for c in state.causes) or any(map(_turned, chains)):
        # relief that is wrong casts wrong shadows; a horizon is known in the direction where the Sun was said to be
        known |= {n for n in shadows.every if get_effect(n).shadow_error}
    usual = shadows.usual()
    found = shadows.unusual(usual, known)
    if not found or not usual[-1].held_out().any():
        return []
    first = min(found, key=lambda t: float(t.held_out().sum()))
    return [_claimed(state, shadows, usual[-1], first, [t for t in found if t is not first])]


def _claimed(state: State, shadows: Shadows, usual: Tried, first: Tried, others: Sequence[Tried]) -> Measured:
    """The value of the first effect, with how far it is open by the errors of the DEM's horizons."""
    before, after = usual.held_out(), first.held_out()
    effect, shown = first.best, before > 0
    name = effect.fitted()[0].name
    around = effect.shadow_neighbours(state.data)
    pixels = float(sum(e.chain.site.valid.sum() for e in shadows.edges))
    least = SHADED * before if around else 0.0  # what errors of the DEM gain anyway
    if not interval((before - after - least)[shown], before[shown])[0] > 0:
        value = float(effect.values[name])
        return measured(effect, (name, abs(value), math.inf), {name: (value, math.inf)}, before, after + least, pixels)
    line = [e for e in shadows.every[effect.name] if _on_one_line(e, effect)]
    wholes = [shadows.in_turn(line, fall) for fall in FALLS]
    values = np.array([w.value() for w in wholes])
    effect, value, apart = wholes[0].best, float(values.mean()), float(np.ptp(values)) / 2
    error, scatter, odd = wholes[0].error(np.flatnonzero(shown)), 0.0, ""
    # a wall is looked at further than the highest that was tried; where others end there, it is no estimate
    largest = max(abs(float(e.values[name])) for e in line)
    if not around and np.abs(values).max() >= largest:
        odd = f"{name} = {value:.3g}, at the end of what was tried"
    if around:  # how far away a wall stands is open
        near = shadows.in_turn([type(effect)({**t.fixed, **t.columns[0]}, state.data) for t in around])
        effect, scatter = near.open_between(OPEN * float(before.sum()))
        value = float(effect.values[name])
    # what horizons whose errors fall more slowly with distance explain is no gain
    slow = shadows.usual(fall=FALLS[1])[-1].held_out() - wholes[1].held_out()
    gains = np.minimum(before - after, slow) - least
    made = type(effect)({**effect.values, name: value}, state.data)
    whole = math.hypot(error, scatter, apart, effect.shadow_error)
    nearer = math.copysign(max(abs(value) - apart - 2 * math.hypot(error, effect.shadow_error), 0.0), value)
    ordinary = 0.0 if effect.shadows_ordinarily({**effect.values, name: nearer}) else math.inf
    report = made.report({k: float(v) for k, v in made.values.items()}, {name: whole})
    rivals = [Rival(t.best.name, gains - (t.held_out() - after)) for t in others]
    return measured(
        made, (name, abs(value), whole), report, before, before - gains, pixels,
        away=ordinary, odd=odd, rivals=[Rival(r.name, r.gains[shown]) for r in rivals],
    )  # fmt: skip


def _turned(chain: Chain) -> bool:
    """Whether a cause turned the Sun about the vertical."""
    (east, north), (given_east, given_north) = (
        d[:, :2].unbind(-1) for d in (chain.state.sun_direction, chain.site.observation.sun_direction)
    )
    return bool(((east * given_north - north * given_east).abs() > 1e-4).any())


def _on_one_line(first: Effect, second: Effect) -> bool:
    """Whether two sets of values differ in the first coordinate only."""
    others = [p.name for p in first.fitted()][1:]
    return all(first.values[n] == second.values[n] for n in others)


__all__ = ["Shadows", "by_shadows"]
