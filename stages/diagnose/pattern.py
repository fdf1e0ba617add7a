"""Evidence for a broad albedo pattern: long waves of the ground's albedo that its own spectrum does not foretell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.images import FEWEST
from stages.diagnose.numbers import f_tail
from stages.diagnose.preparing import Remains
from stages.effects.albedo_map import ORDERS
from stages.effects.fields import cosine_field

LONGEST, SHORTEST = 6, 16  # half waves per crop between which the texture's own spectrum is taken
LOG_OF_MEAN = 1.27  # of a chi-square of one degree, above the mean of its log
LOG_SCATTER = 2.22  # rms of that log
STEEPEST = -3.0  # of power against wave number: redder than any texture


@dataclass
class PatternEvidence:
    """values : (sites, orders) cosine coefficients; rms : of the pattern beyond the texture; p : F test of the powers."""

    values: Tensor
    numbers: list[int]
    rms: float
    rms_error: float
    texture: float  # rms that the red spectrum of the texture foretells
    gain: float
    gain_error: float
    p: float


def weigh_pattern(works: Sequence[Remains]) -> PatternEvidence | None:
    """From sites with enough images to know their albedo; None where there are none."""
    values, numbers, powers = [], [], []
    for work in works:
        if work.site.count < FEWEST:
            continue
        albedo = work.albedo - work.albedo.mean()
        height, width = albedo.shape
        orders = [(m, n) for m in range(SHORTEST + 1) for n in range(SHORTEST + 1) if m + n > 0]
        amount = {o: float((albedo * cosine_field(o, height, width)).mean()) for o in orders}
        values.append(torch.tensor([amount[o] for o in ORDERS]))
        numbers.append(work.site.number)
        powers.append({o: v * v for o, v in amount.items()})
    if not values:
        return None
    found = torch.stack(values).double().square()
    # order by order: in sums over orders the longest waves, of which least is known, would be all
    ratio = float((found / _foretold(powers)).mean())
    count = found.numel()
    # modes beyond the texture's share: log-likelihood of two variances
    gain = 0.5 * count * (ratio - 1 - math.log(max(ratio, 1e-9))) if ratio > 1 else 0.0
    rms = math.sqrt(float(found.sum(1).mean()))
    texture = rms / math.sqrt(max(ratio, 1.0))
    return PatternEvidence(
        torch.stack(values), numbers, math.sqrt(rms * rms - texture * texture), rms / math.sqrt(2 * count), texture, gain,
        math.sqrt(2 * gain + count), f_tail(ratio, count / 3, 20.0 * len(values)),
    )  # fmt: skip


def _foretold(powers: Sequence[dict[tuple[int, int], float]]) -> Tensor:
    """Power of each order of the pattern at each site, (sites, orders), from a power law through the next shorter waves.

    One exponent for all sites, steeper than the fitted one by its standard error: a site's own is known to 0.6, which over
    the step to the long waves is a factor of three.
    """
    waves = [o for o in powers[0] if o not in ORDERS and LONGEST <= math.hypot(*o) <= SHORTEST]
    a = torch.tensor([math.log(math.hypot(*o)) for o in waves], dtype=torch.float64)
    middle = a.mean()
    a = a - middle
    b = torch.tensor([[math.log(max(p[o], 1e-16)) for o in waves] for p in powers], dtype=torch.float64)
    slope = float((a * b.mean(0)).sum() / a.square().sum())
    slope -= LOG_SCATTER / math.sqrt(len(powers) * float(a.square().sum()))
    slope = min(max(slope, STEEPEST), 0.0)
    longer = torch.tensor([math.log(math.hypot(*o)) for o in ORDERS], dtype=torch.float64) - middle
    return torch.exp(b.mean(1)[:, None] + LOG_OF_MEAN + slope * longer)
