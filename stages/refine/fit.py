"""One window's posterior, with slopes and shadows taken anew where it leads."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from stages.common.arrays import Floats32
from stages.physics.images.spectrum import collect, smoothed
from stages.refine.patch import Evidence, Noise, Patch
from stages.refine.solve import Posterior, Priors, unresolved

ROUNDS = 3


def fit(
    patch: Patch, start: Floats32, priors: Priors, noise: Noise, only: Collection[int] | None = None,
) -> tuple[Floats32, Posterior, Evidence]:  # fmt: skip
    """(2, H, W) posterior mean of heights and log albedo, from ``start`` on: see ``Patch.start``. only : images that count, None for all

    Heights without variance stay, and with them slopes and shadows: one round, with the weights of its start.
    """
    fields = start
    for number in range(ROUNDS if priors.heights.variance.any() else 1):
        evidence = patch.evidence(fields, start, noise, only, relinearise=number == 1)
        posterior = Posterior(evidence.products, patch.px, priors)
        fields = posterior.mean(evidence.gradient, fields, number > 0)
        if number == 0:
            patch.refresh(fields[0])
    return fields, posterior, evidence


def variances(priors: Priors, draws: Iterable[Floats32], doubt: Floats32) -> Floats32:
    """(2, H, W) of heights, m2, and of log albedo for an image under other angles.

    draws : waves (2, H, W) of draws of the posterior; doubt : see ``Evidence``
    """
    squares, count, wider = np.zeros((2, *doubt.shape), np.float32), 0, np.sqrt(priors.widening.of(doubt.shape))
    for draw in draws:
        squares += collect(wider * draw) ** 2
        count += 1
    found = np.stack([smoothed(s) for s in squares]) / np.float32(count)
    found += np.array(unresolved(priors), np.float32)[:, None, None]
    found[1] += doubt
    return found
