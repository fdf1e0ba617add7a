"""From a first linear estimate to the values that fit best, with all named causes together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.diagnose.columns import derivative_step, relief_blur
from stages.diagnose.evidence import Evidence
from stages.diagnose.images import (
    OVERSHOOT,
    SMALL,
    ImageEvidence,
    ImageProducts,
    as_effect,
    gather_images,
    weigh_images,
)
from stages.diagnose.preparing import ready
from stages.diagnose.relief import Relief, named_relief, weigh_relief
from stages.diagnose.state import Cause, Search
from stages.diagnose.statistics import Statistics, gather_site, join
from stages.effects import Effect, Survey, get_effect

WORTH_MOVING = 12.0  # nats
SETTLED = 0.002  # of a cause's gain: what gains less only drifts along what the nominal model can imitate
# far from linear: the trial that fitted best is a better start than what a line through it says
KEEP_TRIAL = ("distant_shadow", "saturation")
SHAPES = ("h", "lag_px", "theta_bar_deg", "height_m")  # not more than half of themselves at a time
STILL = ("axis", "side", "distance_px", "lag_px", "disc_deg2", "relief_deg")  # found by the search alone


def start(evidence: Evidence, data: Survey) -> tuple[Effect, dict[str, float]]:
    """The effect at its linear estimate, within bounds, and its errors; other guises' coordinates stay at null."""
    cls = get_effect(evidence.effect)
    null = cls.null()
    values: dict[str, float] = {**null, **evidence.candidate.trial.fixed}
    touched = set(evidence.candidate.trial.fixed)
    errors: dict[str, float] = {}
    for k, (amount, column) in enumerate(zip(evidence.amount.tolist(), evidence.candidate.trial.columns, strict=True)):
        for name, reference in column.items():
            low, high = cls.bounds(name)
            share = 1.0 if cls.name in KEEP_TRIAL else amount
            values[name] = min(max(values[name] + share * (reference - null[name]), low), high)
            touched.add(name)
            errors[name] = abs(reference - null[name]) * float(evidence.covariance[k, k].clamp(min=0)) ** 0.5
    effect = cls(values, data)
    effect.held = tuple(p.name for p in cls.fitted() if p.name not in touched or p.name in STILL)
    return effect, errors


def refine(state: Search, steps: int = 2, known: bool = True) -> None:
    """Gauss-Newton on all named scene-wide coordinates together; values per image are estimated anew.

    known : a linear effect that is alone has the value that fits best already
    """
    beside = any(c.effect.scope == "scene" for c in state.causes[-1:])
    gains = [c for c in state.causes if c.effect.name == "image_gain" and beside]
    for step in range(steps):
        state.fit(again=step > 0)
        every = state.each(lambda chain: _gather(state, chain))
        joined = join([lit for lit, _, _ in every])
        if joined.count > 0:
            delta, error = solve_nuisance(joined)
            for cause in state.causes:
                _move(cause, joined.names, delta, error, alone=known and len(state.causes) == 1)
        for collected in zip(*(relief for _, relief, _ in every), strict=True):
            for evidence in weigh_relief(collected):
                _move_relief(state, evidence)
        named = {c.effect.name: c for c in state.causes if c.effect.scope == "image"}
        found = weigh_images([images for _, _, images in every], state.frames, SMALL)
        for name, cause in named.items():
            if cause not in gains and name in found and found[name].gain > max(WORTH_MOVING, SETTLED * cause.gain):
                share = OVERSHOOT if cause.effect.displaces else 1.0
                cause.effect = as_effect(found[name], cause.effect, state.data, share)
        for cause in gains:
            _follow(state, cause)
    state.fit()


def _follow(state: Search, gains: Cause) -> None:
    """Gains beside scene-wide causes as these are now: they stood for all that acts by image, and may have far to go.

    Together with a cause that they can nearly stand for they have no evidence of their own, and a prior would hold them.
    """
    state.fit(again=True)
    found = _given_the_rest(state, gains.effect.name)
    if found is not None:
        gains.effect = as_effect(found, gains.effect, state.data)


def gains_left(state: Search, name: str) -> Tensor:
    """(frames,) the gains that the images still need beside the causes as they are; 0 where nothing is known."""
    found = _given_the_rest(state, name)
    return torch.zeros(state.frames) if found is None else found.values[:, 0]


def _given_the_rest(state: Search, name: str) -> ImageEvidence | None:
    """Evidence for further values per image of an effect, all scene-wide causes held as they are."""
    every = state.each(lambda chain: gather_images(ready(chain, state.dn), [name], state.dn, state.data, held=True))
    return weigh_images(every, state.frames).get(name)


def _gather(state: Search, chain: Chain) -> tuple[Statistics, list[Relief], ImageProducts | None]:
    """Products of further steps of all named effects at one site: scene-wide ones, the DEM's, those per image."""
    wide = any(c.effect.channel == "edge" for c in state.causes)
    work = ready(chain, state.dn, wide)
    relief = []
    for place, effect in enumerate(chain.base):
        if effect.channel == "relief":
            (coordinate,) = (p.name for p in effect.fitted())
            step = derivative_step(type(effect), coordinate, state.data)
            relief.append(named_relief(work, place, step, state.data))
    single = [e.name for e in state.base if e.scope == "image"]
    lit = gather_site(work, [], state.data, [relief_blur(chain)] if wide else [])
    return lit, relief, gather_images(work, single, state.dn, state.data)


def _move_relief(state: Search, evidence: Evidence) -> None:
    cause = next(c for c in state.causes if c.effect.name == evidence.effect)
    cls = type(cause.effect)
    ((coordinate, reference),) = evidence.candidate.trial.columns[0].items()
    step = reference - cls.null()[coordinate]
    low, high = cls.bounds(coordinate)
    value = float(cause.effect.values[coordinate]) + float(evidence.amount[0]) * step
    cause.errors[coordinate] = abs(step) * float(evidence.covariance[0, 0].clamp(min=0)) ** 0.5
    cause.lowered[coordinate] = abs(step) * evidence.lowered
    moved = cls({coordinate: min(max(value, low), high)}, cause.effect.survey)
    moved.held = cause.effect.held
    cause.effect = moved


def solve_nuisance(data: Statistics) -> tuple[Tensor, Tensor]:
    """Estimates and cluster-robust standard errors of all nuisance columns together."""
    m = data.count
    sums = data.products.sum(0)
    gram = sums[:m, :m] + torch.diag(data.bound**-2)
    scale = gram.diagonal().clamp(min=1e-30).rsqrt()
    normal = gram * scale[:, None] * scale + 1e-6 * torch.eye(m, dtype=torch.float64)
    inverse = torch.linalg.inv(normal) * scale[:, None] * scale
    delta = inverse @ sums[:m, m]
    score = data.products[:, :m, m] - torch.einsum("cml,l->cm", data.products[:, :m, :m], delta)
    variance = torch.zeros(m, dtype=torch.float64)
    for labels in (data.image, data.place):
        _, index = np.unique(labels, return_inverse=True)
        count = int(index.max()) + 1
        summed = torch.zeros(count, m, dtype=torch.float64).index_add_(0, torch.from_numpy(index), score)
        robust = inverse @ (summed.T @ summed) @ inverse * count / max(count - 1, 1)
        variance = torch.maximum(variance, robust.diagonal())
    return delta, variance.clamp(min=0).sqrt()


def _move(cause: Cause, names: Sequence[str], delta: Tensor, error: Tensor, alone: bool) -> None:
    cls = type(cause.effect)
    if cls.scope != "scene":
        return
    values = dict(cause.effect.values)
    for k, name in enumerate(names):
        owner, _, coordinate = name.partition(".")
        if owner != cls.name or not coordinate:
            continue
        cause.errors[coordinate] = float(error[k])
        step = float(delta[k])
        if (cls.linear and alone) or not math.isfinite(step):  # known, as long as nothing else moves
            continue
        low, high = cls.bounds(coordinate)
        if coordinate in SHAPES:
            size = abs(values[coordinate]) + 1e-9
            step = min(max(step, -0.5 * size), 0.5 * size)
        values[coordinate] = min(max(values[coordinate] + step, low), high)
    moved = cls(values, cause.effect.survey)
    moved.held = cause.effect.held
    cause.effect = moved


__all__ = ["gains_left", "refine", "solve_nuisance", "start"]
