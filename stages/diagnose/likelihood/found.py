"""What was found of one effect: its amounts, how surprising they are, and what they gain on held-out ground."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stages.common.intervals import effective_units, student_quantile
from stages.diagnose.likelihood.products import Array
from stages.diagnose.likelihood.typical import typical_bounds
from stages.diagnose.rows.columns import Guise
from stages.diagnose.settings import SURE
from stages.effects import get_effect


@dataclass
class Found:
    """An effect in its best guise. amount, error : in multiples of the guise's columns (per frame: of ``strong``)

    surprise : -log10 of the chance of so much likelihood, calibrated on shams; p : family-wise
    gains : (units,) nats on held-out ground; spread : standard deviation over the frames, of an effect per frame
    """

    effect: str
    guise: Guise
    amount: Array
    error: Array
    surprise: float
    p: float = 1.0
    gains: Array = field(default_factory=lambda: np.zeros(0))
    sizes: Array = field(default_factory=lambda: np.ones(1))  # squares of the residual on these units
    spread: float = 0.0
    beside: float = 0.0  # scatter of the gains per frame beside it, where that is less than without
    instead: bool = False  # whether it stands for gains per frame: beside it they are no larger than all data have
    odds: float = math.inf  # nats by which it is likelier than gains per frame that it stands for

    @property
    def gain(self) -> float:
        """Held-out gain over all pieces of ground, nats."""
        return float(self.gains.sum())

    def gain_interval(self) -> tuple[float, float]:
        """95 % interval of the held-out gain, nats, by the scatter over pieces of ground."""
        return interval(self.gains, self.sizes)

    def more_than(self, other: Found) -> tuple[float, float]:
        """The same of what it gains more than another effect."""
        return interval(self.gains - other.gains, self.sizes)


def interval(gains: Array, sizes: Array | None = None) -> tuple[float, float]:
    """95 % interval of a sum of gains over independent pieces of ground, by their typical values, or Student's t where they are few.

    sizes : of the pieces, to which gains are in proportion but for chance (a ratio estimate: Cochran 1977, ch. 6); alike where None
    """
    if sizes is None or len(sizes) != len(gains):
        sizes = np.ones(len(gains))
    share = sizes / max(float(sizes.sum()), 1e-30)
    if bounds := typical_bounds(gains, share):
        return bounds
    units = effective_units(share) if share.any() else 0.0
    if units < 2 or len(gains) < 3:
        return -math.inf, math.inf
    total = float(gains.sum())
    chance = gains - total * share
    half = student_quantile(units - 1) * math.sqrt(units / (units - 1) * float(chance @ chance))
    return total - half, total + half


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


__all__ = ["Found", "beyond_bounds", "interval"]
