"""One look at the data: the evidence for every effect that is still open, each in the rows where it shows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from stages.diagnose.chain import Chain
from stages.diagnose.columns import BASELINE, Candidate, make_candidates, relief_blur, trial_columns
from stages.diagnose.evidence import Evidence, best_guises, weigh
from stages.diagnose.images import (
    FEWEST,
    OVERSHOOT,
    ImageEvidence,
    ImageProducts,
    as_effect,
    gather_images,
    weigh_images,
)
from stages.diagnose.pattern import PatternEvidence, weigh_pattern
from stages.diagnose.preparing import Remains, left_over, ready
from stages.diagnose.projection import FREE_SLOPES
from stages.diagnose.refining import start
from stages.diagnose.relief import ALONG, Relief, open_relief, weigh_relief
from stages.diagnose.state import Search
from stages.diagnose.statistics import Statistics, gather_site, gather_static, given, join, swap, without
from stages.effects import get_effect

# Of the elevation (its tangent) at which a wall stands above the crop's centre, and of its distance from there, about the
# best of the ladder before: shadows tell the elevation well, and how far away it stands hardly.
LADDERS = (
    ((0.72, 0.82, 0.92, 1.0, 1.08, 1.2, 1.35), (0.52, 1.0, 2.0)),
    ((0.92, 0.95, 0.975, 1.0, 1.025, 1.05, 1.08), (0.65, 0.75, 0.87, 1.0, 1.15, 1.32, 1.5)),
)
ALIGNMENTS = 3
ENOUGH_PX = 0.06
SAME = 0.6  # agreement over the sites, below which shifts are something else
QUIET_GAIN, QUIET_FID = 6.0, 0.012  # below both an effect is not looked at again
DARK_ENOUGH = 0.05  # of a shadow: with a hundredth of one walls imitate what acts by image
SURE = 0.01  # of the two halves of the blocks agreeing by chance


@dataclass
class Round:
    """What one look at the data found.

    best : the best guise of every scene-wide effect; images : effects with values per image; pattern : a broad albedo
    pattern
    """

    works: list[Remains]
    best: dict[str, Evidence]
    images: dict[str, ImageEvidence]
    pattern: PatternEvidence | None = None
    others: list[Evidence] = field(default_factory=list)  # guises that lost
    edges: list[Remains] = field(default_factory=list)  # the sites with the pixels about shadow edges
    statistics: Statistics | None = None  # of the effects of lit ground


@dataclass
class _Seen:
    """What a look finds at one site: products of effects on lit ground, on albedo, on slopes and about shadow edges."""

    work: Remains
    lit: Statistics
    images: ImageProducts | None
    ground: Statistics | None = None
    relief: list[Relief] = field(default_factory=list)
    wide: Remains | None = None
    walls: Statistics | None = None
    discs: Statistics | None = None


def look(state: Search, names: Sequence[str]) -> Round:
    """Evidence for the effects of these names."""
    kinds = {n: get_effect(n) for n in names}
    lit = [n for n, c in kinds.items() if c.scope == "scene" and c.channel == "lit" and n not in BASELINE]
    edge = [n for n, c in kinds.items() if c.channel == "edge"]
    albedo = [n for n, c in kinds.items() if c.channel == "albedo" and c.scope == "scene"]
    relief = [n for n in ALONG if n in kinds and state.deepest >= FREE_SLOPES]
    candidates = make_candidates(lit, state.data)
    walls = make_candidates([n for n in edge if n == "distant_shadow"], state.data)
    discs = make_candidates([n for n in edge if n != "distant_shadow"], state.data)
    on_ground = make_candidates(albedo, state.data)
    images = [n for n, c in kinds.items() if c.scope == "image"]

    def of(chain: Chain) -> _Seen:
        work = ready(chain, state.dn)
        products = gather_site(work, candidates, state.data)
        seen = _Seen(work.remains(), products, gather_images(work, images, state.dn, state.data))
        if on_ground:
            columns = [c for e in on_ground for c in trial_columns(chain, e.effect, e.trial, state.data)]
            seen.ground = gather_static(work, on_ground, columns)
        seen.relief = [open_relief(work, name, state.data) for name in relief]
        if discs:  # before the others: they leave the texture to them
            far = ready(chain, state.dn, wide=True, far=True)
            seen.discs = gather_site(far, discs, state.data, [relief_blur(chain)])
        if edge:
            wide = ready(chain, state.dn, wide=True)
            seen.wide = wide.remains()
            if walls:
                seen.walls = gather_site(wide, walls, state.data, [relief_blur(chain)])
        return seen

    title = f"looking for causes, round {len(state.causes) + 1}"
    every = state.each(of, lambda done: state.progress(done, len(state.sites), title))
    works, edges = [s.work for s in every], [s.wide for s in every if s.wide is not None]
    statistics = join([s.lit for s in every])
    evidence = weigh(statistics)
    if on_ground:
        evidence += weigh(join([s.ground for s in every if s.ground is not None]))
    for k in range(len(relief)):
        evidence += weigh_relief([s.relief[k] for s in every])
    if "psf_blur" in kinds:
        blurred = swap(statistics, "psf_blur", state.data)
        # judged beside a DEM smoother than the ground, if the maps of slopes show one: no DEM is sharper than the ground
        drop = [] if _smooth(state, evidence) else ["dem_smoothing"]
        evidence += weigh(without(blurred, drop, blurred.candidates))
    if discs:
        evidence += _disc(weigh(join([s.discs for s in every if s.discs is not None])))
    if walls:
        evidence += _wall(state, weigh(join([s.walls for s in every if s.walls is not None])))
    evidence = [e for e in evidence if _plausible(e, state)]
    pattern = weigh_pattern(works) if "albedo_map" in kinds else None
    return Round(
        works,
        best_guises(evidence),
        weigh_images([s.images for s in every], state.frames),
        pattern,
        evidence,
        edges or works,
        statistics,
    )


def align(state: Search) -> ImageEvidence | None:
    """Estimate the shift of every image and take it out of the measurement; the evidence for shifts at all, if any.

    A shift of a third of a pixel is ordinary and no cause, but its second order looks like a blur or a reflectance.
    """
    cls, first, last = get_effect("misregistration"), None, math.inf
    for _ in range(ALIGNMENTS if state.deepest >= FEWEST else 0):
        every = state.each(lambda chain: gather_images(ready(chain, state.dn), [cls.name], state.dn, state.data))
        found = weigh_images(every, state.frames).get(cls.name)
        if found is None or found.p > SURE or found.gain < 0 or found.agreement < SAME or found.rms > last:
            break
        first, last = first or found, found.rms
        state.aligned = as_effect(found, state.aligned, state.data, OVERSHOOT)
        state.fit()
        if found.rms < ENOUGH_PX:
            break
    return first


def _disc(found: list[Evidence]) -> list[Evidence]:
    """The guise that fits best as what it says: a disc of its radius in full, not a share of a wider one, as relief is.

    A column worth ``gain`` at its best amount a is worth gain (2 a - 1) / a^2 at amount 1.
    """

    def whole(e: Evidence) -> float:
        amount = max(float(e.amount[0]), 0.1)
        return e.gain * (2 * amount - 1) / amount**2 if e.gain > 0 else e.gain

    return [max(found, key=whole)]


def _wall(state: Search, found: list[Evidence]) -> list[Evidence]:
    """The best wall, and where there may be one the best of a finer ladder about it."""
    top = max(found, key=lambda e: e.gain)
    seen = top.gain > 12 and float(top.amount[0]) > DARK_ENOUGH and top.fid > 0.015
    return [top, *(_climb(state, top) if seen else [])]


def _climb(state: Search, top: Evidence) -> list[Evidence]:
    """The wall's distance and height on finer ladders: a shadow's edge moves with them, and no linear model follows."""
    cls, crop = get_effect("distant_shadow"), state.data.crop_px
    spread = 0.0
    for tangents, distances in LADDERS:
        ((_, height),) = top.candidate.trial.columns[0].items()
        fixed = top.candidate.trial.fixed
        away = fixed["distance_px"] / crop + 0.5  # from the crop's centre, in crops
        tangent = height / (away * crop * state.data.gsd)
        trials = [
            cls.trial(state.data, tangent * t, max(away * d - 0.5, 0.0), int(fixed["side"]))
            for d in distances
            for t in tangents
        ]
        candidates = [Candidate(cls.name, t, slice(k, k + 1)) for k, t in enumerate(trials)]

        def of(chain: Chain, candidates: list[Candidate] = candidates) -> Statistics:
            wide = ready(chain, state.dn, wide=True)
            return gather_site(wide, candidates, state.data, [relief_blur(chain)])

        joined = join(state.each(of))
        found = weigh(joined)
        best = max(found, key=lambda e: e.gain)
        spread = _spread(found, (joined.image, joined.place))
        if best.gain <= top.gain:
            break
        top = best
    return [dataclasses.replace(top, along={"height_m": spread})]


def _spread(rungs: list[Evidence], clusterings: Sequence[np.ndarray]) -> float:
    """Standard error of the wall's height by which rung is best, jackknifed over clusters (Efron & Stein 1981)."""
    height = torch.tensor([next(iter(e.candidate.trial.columns[0].values())) for e in rungs], dtype=torch.float64)
    shares, largest = torch.stack([e.share for e in rungs]), 0.0
    for labels in clusterings:
        _, index = np.unique(labels, return_inverse=True)
        count = int(index.max()) + 1
        gains = torch.zeros(len(rungs), count, dtype=torch.float64).index_add_(1, torch.from_numpy(index), shares)
        without = height[(gains.sum(1, keepdim=True) - gains).argmax(0)]
        largest = max(largest, float(((count - 1) * without.var(correction=0)).sqrt()))
    return largest


def _plausible(e: Evidence, state: Search) -> bool:
    effect, _ = start(e, state.data)
    return effect.plausible(effect.values, state.data)


def _smooth(state: Search, evidence: Sequence[Evidence]) -> bool:
    """Whether the DEM is, or may be, smoother than every DEM."""
    cls = get_effect("dem_smoothing")
    for e in evidence:
        if e.effect == cls.name:
            ((name, reference),) = e.candidate.trial.columns[0].items()
            return float(e.amount[0]) * reference > 0.5 * cls.tolerance[name]
    return state.deepest < FREE_SLOPES


def quiet(seen: Round, named: str) -> dict[str, Evidence]:
    """Effects of lit ground with nothing left to say once the named one is fitted along, by the products of a look."""
    known = seen.best.get(named)
    if seen.statistics is None or known is None or all(c.effect != named for c in seen.statistics.candidates):
        return {}
    left = best_guises(weigh(given(seen.statistics, known.candidate)))
    return {n: e for n, e in left.items() if e.gain < QUIET_GAIN and e.fid < QUIET_FID}


def misfit(state: Search, works: Sequence[Remains], edges: bool = False) -> float:
    """Weighted sum of squares that all free parameters together leave, with the weights of an earlier look.

    edges : the weights count shadow edges too; what relief does to them is then fitted along
    """
    weights = {id(w.site): w.weight for w in works}

    def of(chain: Chain) -> float:
        extra = relief_blur(chain)[1] if edges else []
        return left_over(chain, weights[id(chain.site)] * chain.site.valid, state.dn, extra)

    return sum(state.each(of))


def narrowed(seen: Round, later: Round, silent: dict[str, Evidence]) -> Round:
    """A later look at fewer effects; those that it left out keep what little the named cause left them, or the earlier evidence."""
    best, images = {**seen.best, **silent, **later.best}, {**seen.images, **later.images}
    return dataclasses.replace(later, best=best, images=images)


__all__ = ["Round", "look", "narrowed"]
