"""Gains of images can stand for whatever acts by image: whether scene-wide causes, a few numbers for all, do as well."""

from __future__ import annotations

import dataclasses

from torch import Tensor

from stages.diagnose.columns import free_coordinates
from stages.diagnose.contest import contest, reconsider
from stages.diagnose.looking import Round, look, misfit
from stages.diagnose.naming import GATE, choose
from stages.diagnose.numbers import f_tail
from stages.diagnose.refining import gains_left
from stages.diagnose.state import Saved, Search
from stages.effects import get_effect

TESTS = 2  # of whether scene-wide causes do as well as gains
PAIR = 2  # scene-wide causes that are tried together in the place of gains ...
HALF = 0.4  # ... if the first explains so much of what gains do: two must explain nearly all to be believed
LEVEL_STAYS = ("echo", "psf_blur")  # they move light about within an image


def instead_of_gains(state: Search, before: Saved, seen: Round, nothing: float) -> bool:
    """Whether scene-wide causes, up to two, do as well as the gains named last: F tests over the images.

    One is of what the gains gain, one of the gains that are left beside the causes, where each image counts alike: known to
    a thousandth, a dark image's gain says as much as a bright one's. The state holds the scene-wide causes afterwards if so
    (true gains may then come on top), and the gains if not.
    """
    gains, with_gains, rms = state.causes[-1], state.save(), state.residual_rms()
    scatter, count = _scatter(gains.effect.values["gain"])
    possible = nothing - misfit(state, seen.works)
    images = _effective_images(seen)
    state.load(before)
    names = [n for n in state.open_names() if get_effect(n).scope == "scene" and get_effect(n).channel == "lit"]
    names = [n for n in names if n not in LEVEL_STAYS]
    freedom, choices = 0, 1
    now = dataclasses.replace(seen, best={n: e for n, e in seen.best.items() if n in names}, images={}, pattern=None)
    for turn in range(PAIR):
        rivals = choose(state, look(state, names) if turn else now)
        if not rivals:
            break
        known = state.save()
        cause = contest(state, rivals, seen)
        cause.rms_before, cause.rms_after = gains.rms_before, rms
        reconsider(state, cause, known, seen, kept=True)
        choices *= len(names)
        names.remove(cause.effect.name)
        freedom += len(free_coordinates(cause.effect))
        share = (nothing - misfit(state, seen.works)) / possible
        taken = 1 - _scatter(gains_left(state, gains.effect.name))[0] / max(scatter, 1e-30)
        if share < HALF:  # gains that are left say nothing beside a model that does not fit
            break
        least = GATE / (TESTS * choices)
        if share >= 1 or min(_explained(share, freedom, images), _explained(taken, freedom, count)) < least:
            for cause in state.causes[len(before.causes) :]:
                cause.for_gains = True
            return True
    state.load(with_gains)
    return False


def _scatter(gains: Tensor) -> tuple[float, int]:
    """(mean square of the known gains about their mean, how many there are)"""
    known = gains[gains != 0]
    return float(known.var(correction=0)) if len(known) > 1 else 0.0, len(known)


def _explained(share: float, freedom: int, images: float) -> float:
    """Chance that ``freedom`` coordinates explain this share of the variance of as many images' values."""
    rest = images - 1 - freedom
    if rest <= 0 or share <= 0:
        return 1.0
    return f_tail(share / max(1 - share, 1e-9) * rest / freedom, freedom, rest)


def _effective_images(seen: Round) -> float:
    """How many images carry the evidence for gains: (sum of energies)^2 over the sum of their squares."""
    energy: dict[int, float] = {}
    for work in seen.works:
        per_image = (work.site.image * work.weight).double().square().sum((-2, -1)).tolist()
        for frame, amount in zip(work.site.frames.tolist(), per_image, strict=True):
            energy[frame] = energy.get(frame, 0.0) + amount
    return sum(energy.values()) ** 2 / max(sum(e * e for e in energy.values()), 1e-30)


__all__ = ["instead_of_gains"]
