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
    values, numbers, expected = [], [], []
    for work in works:
        if work.site.count < FEWEST:
            continue
        albedo = work.albedo - work.albedo.mean()
        height, width = albedo.shape
        orders = [(m, n) for m in range(SHORTEST + 1) for n in range(SHORTEST + 1) if m + n > 0]
        power = {o: float((albedo * cosine_field(o, height, width)).mean()) for o in orders}
        values.append(torch.tensor([power[o] for o in ORDERS]))
        numbers.append(work.site.number)
        expected.append(_foretold({o: v * v for o, v in power.items()}))
    if not values:
        return None
    found = torch.stack(values).double().square()
    ratio = float((found / torch.stack(expected)).mean())
    count = found.numel()
    # modes beyond the texture's share: log-likelihood of two variances
    gain = 0.5 * count * (ratio - 1 - math.log(max(ratio, 1e-9))) if ratio > 1 else 0.0
    texture = math.sqrt(float(torch.stack(expected).sum(1).mean()))
    rms = math.sqrt(float(found.sum(1).mean()))
    beyond = math.sqrt(max(rms * rms - texture * texture, 0.0))
    return PatternEvidence(
        torch.stack(values), numbers, beyond, rms / math.sqrt(2 * count), texture, gain,
        math.sqrt(2 * gain + count), f_tail(ratio, count / 3, 20.0 * len(values)),
    )  # fmt: skip


def _foretold(power: dict[tuple[int, int], float]) -> Tensor:
    """Power of each order of the pattern, from a power law through the next shorter waves."""
    x, y = [], []
    for (m, n), p in power.items():
        if (m, n) not in ORDERS and LONGEST <= math.hypot(m, n) <= SHORTEST:
            x.append(math.log(math.hypot(m, n)))
            y.append(math.log(max(p, 1e-16)))
    a, b = torch.tensor(x), torch.tensor(y)
    slope = float(((a - a.mean()) * (b - b.mean())).sum() / (a - a.mean()).square().sum())
    slope = min(max(slope, STEEPEST), 0.0)
    level = float(b.mean()) + 1.27  # the mean of a log chi-square of one degree lies that far below the log of its mean
    return torch.tensor(
        [math.exp(level + slope * (math.log(math.hypot(*o)) - float(a.mean()))) for o in ORDERS], dtype=torch.float64
    )
