"""What a source of evidence claims, and what is decided on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

from stages.common.arrays import Floats
from stages.diagnose.likelihood.intervals import interval, together
from stages.diagnose.settings import DISCOVERY, SIMPLER, SURE
from stages.effects import Effect


class Reason(Enum):
    """Why a claim gets no name."""

    IMPOSSIBLE = "the values that fit best are impossible"
    NO_EVIDENCE = "sham residuals do as well"
    NO_GAIN = "no sure gain on ground that it was not fitted to"
    RIVAL = "another effect explains it as well"
    ANOTHER_LAW = "another law of the ground explains more"
    FEW_IMAGES = "it depends on a few images"
    UNSURE = "its size is less than four standard errors"
    ORDINARY = "no more than is ordinary"
    REPLACED = "not needed beside a cause that was found later"


@dataclass(frozen=True)
class Refusal:
    """Why a claim has no name: the reason, its details in words, and the gain that it would have had, nats."""

    reason: Reason
    details: str = ""
    gain: float = math.nan

    def __str__(self) -> str:
        return f"{self.reason.value} ({self.details})" if self.details else self.reason.value


@dataclass(frozen=True)
class Rival:
    """Another explanation of the same squares. gains : (U,) on the same pieces of ground; values : how many numbers it takes to say"""

    name: str
    gains: Floats
    values: int = 1


@dataclass
class Claim:
    """An effect that some evidence speaks for.

    sizes : reported parameter -> (distance from nothing, standard error), where the effect's ``tolerance`` has it
    gains, units : (U,) what it gains on each piece of ground that it was not fitted to, and squares there
    away : standard errors from nothing of ``amounts`` values together; p : family-wise chance
    images : standard errors from nothing over images, infinite where these say nothing
    odd : what is impossible about the values; values : how many numbers it takes to say
    power : 2 where not the size but its square was measured, whose error stays the same
    """

    effect: Effect
    sizes: dict[str, tuple[float, float]]
    gains: Floats
    units: Floats
    away: float
    amounts: int = 1
    p: float = 0.0
    images: float = math.inf
    odd: str = ""
    values: int = 1
    power: int = 1
    rivals: Sequence[Rival] = field(default_factory=tuple)

    @property
    def gain(self) -> float:
        """Gain over all pieces of ground."""
        return float(self.gains.sum())


def of_size(effect: Effect, name: str, size: float, error: float, before: Floats, after: Floats, **more) -> Claim:
    """The claim of a source that measures one size. before, after : (U,) squares without and with the effect on ground that it was not fitted to"""
    shown = before > 0
    gains, units = (before - after)[shown], before[shown]
    return Claim(effect, {name: (size, error)}, gains, units, **{"away": size / max(error, 1e-30), **more})


def decide(claim: Claim) -> Refusal | None:
    """Why the claim gets no name, or None. A claim that is refused as ordinary passed all other rules."""
    cls = type(claim.effect)
    if claim.odd:
        return Refusal(Reason.IMPOSSIBLE, claim.odd, claim.gain)
    if claim.p > DISCOVERY:
        return Refusal(Reason.NO_EVIDENCE, f"p = {claim.p:.2f}", claim.gain)
    low, high = interval(claim.gains, claim.units)
    if not low > 0:
        share = 100 / max(float(claim.units.sum()), 1e-30)
        bounds = (
            f"95 %: {share * low:.2g} .. {share * high:.2g} %" if math.isfinite(low) else "too few pieces of ground"
        )
        return Refusal(Reason.NO_GAIN, f"{share * claim.gain:.2g} % of the squares; {bounds}", claim.gain)
    for rival in claim.rivals:
        if explains_as_well(rival, claim):
            reason = Reason.RIVAL if rival.name else Reason.ANOTHER_LAW
            return Refusal(reason, rival.name, claim.gain)
    if claim.away < together(SURE, claim.amounts):
        return Refusal(Reason.UNSURE, f"{claim.away:.1f} standard errors", claim.gain)
    if claim.images < 1:
        return Refusal(Reason.FEW_IMAGES, "", claim.gain)
    for name, least in cls.tolerance.items():
        size, error = claim.sizes.get(name, (math.inf, 0.0))
        if not more_than_ordinary(size, error, least):
            return Refusal(
                Reason.ORDINARY, f"{name} = {size:.2g} +- {error:.1g}, any data may have {least:.2g}", claim.gain
            )
    return None


def more_than_ordinary(size: float, error: float, ordinary: float) -> bool:
    """Whether a size is surely (two standard errors) more than what any data set has, an independent part of the same square."""
    return size > math.hypot(ordinary, 2 * error)


def explains_as_well(rival: Rival, claim: Claim) -> bool:
    """Whether a rival surely gains more, or has fewer values and gains no less for sure; what has more values has to gain a fifth more."""
    ours = claim.gains * (SIMPLER if rival.values < claim.values else 1.0)
    theirs = rival.gains * (SIMPLER if rival.values > claim.values else 1.0)
    low, high = interval(ours - theirs, claim.units)
    return high < 0 or (rival.values < claim.values and not low > 0)


def injected(claim: Claim, size: float) -> Claim:
    """The claim if its one size were another one, known with the same error, and surely gained."""
    ((name, (was, error)),) = claim.sizes.items()
    away = claim.away * (size / max(was, 1e-30)) ** claim.power
    return replace(claim, sizes={name: (size, error)}, away=away, gains=claim.units)


__all__ = [
    "Claim",
    "Reason",
    "Refusal",
    "Rival",
    "decide",
    "explains_as_well",
    "injected",
    "more_than_ordinary",
    "of_size",
]
