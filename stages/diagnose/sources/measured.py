"""Claims of sources that compare squares on ground without and with an effect, and how they are reported."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from stages.common.arrays import Floats
from stages.diagnose.judge.claim import Claim, Refusal, decide, injected, of_size
from stages.diagnose.likelihood.intervals import chance, gain_interval, interval, nats
from stages.diagnose.result.answer import Named
from stages.diagnose.settings import CORRELATED
from stages.effects import Effect


@dataclass
class Measured:
    """A claim, and the cause as it is reported if it gets a name."""

    claim: Claim
    named: Named

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.named.effect.name

    def decide(self) -> Refusal | None:
        """Why it gets no name, or None."""
        return decide(self.claim)

    def would_show(self) -> bool:
        """Whether the effect would get a name at a size worth knowing, if it is known with the same error."""
        cls = type(self.named.effect)
        return decide(injected(self.claim, cls.size(cls.strong))) is None


def measured(
    effect: Effect,
    size: tuple[str, float, float],
    parameters: Mapping[str, tuple[float, float]],
    before: Floats,
    after: Floats,
    pixels: float,
    **more,
) -> Measured:
    """size : reported parameter, distance from nothing and standard error; parameters : reported values and errors

    before, after : (U,) squares on pieces of ground without and with the effect, of so many ``pixels``; more : of the claim
    """
    claim = of_size(effect, *size, before, after, **more)
    total, left = float(before.sum()), float(after.sum())
    percent = gain_interval(claim.units, claim.units - claim.gains)
    gain = nats(total, left, pixels, CORRELATED)
    spread = abs(gain) * (percent[2] - percent[1]) / (4 * max(abs(percent[0]), 1e-9))
    units = {p.name: p.unit for p in effect.parameters}
    reported = {k: (v, e, units[k]) for k, (v, e) in parameters.items()}
    first = effect.parameters[0].name
    if first == size[0] and first in type(effect).tolerance:
        value, error, unit = reported[first]
        reported[first] = value, with_ordinary(value, error, type(effect)), unit
    rms = (math.sqrt(total / max(pixels, 1.0)), math.sqrt(max(left, 0.0) / max(pixels, 1.0)))
    group = [effect.name, *(r.name for r in claim.rivals if not interval(claim.gains - r.gains, claim.units)[0] > 0)]
    return Measured(
        claim, Named(effect, reported, chance(claim.gains, claim.units), gain, spread, *rms, percent, group)
    )


def with_ordinary(size: float, error: float, cls: type[Effect]) -> float:
    """Error of a size; what any data have of it is part of what was found, in quadrature."""
    without = math.sqrt(max(size**2 - max(cls.tolerance.values(), default=0.0) ** 2, 0.0))
    return math.hypot(error, size - without)


__all__ = ["Measured", "measured", "with_ordinary"]
