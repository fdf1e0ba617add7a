"""How often the predicted standard deviations hold: the share of pixels within the 68 and 95 % intervals, by incidence."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

LEVELS = (68, 95)  # percent, of a normal distribution
BANDS_DEG = (0.0, 30.0, 45.0, 60.0, 75.0, 90.0)  # incidence on the terrain


def coverage(
    measured: NDArray, predicted: NDArray, std: NDArray, incidence: NDArray, bands_deg: Sequence[float] = BANDS_DEG
) -> dict[str, Any]:
    """Shares of pixels, in percent, whose measured value lies within the predicted intervals, in all and by incidence.

    measured, predicted, std : I/F (or shares of the DN range), any one shape; std of what is predicted, noise included
    incidence : rad, the same shape. Pixels that are not finite in all four do not count; a band without pixels has None.
    """
    known = np.isfinite(measured) & np.isfinite(predicted) & np.isfinite(std) & np.isfinite(incidence)
    misses, width, angle = np.abs(measured - predicted)[known], std[known], np.degrees(incidence[known])
    inside = {level: misses <= norm.ppf(0.5 + level / 200) * width for level in LEVELS}

    def shares(chosen: NDArray[np.bool_]) -> dict[str, Any]:
        count = int(chosen.sum())
        return {"pixels": count} | {
            f"within_{level}_percent": 100 * float(held[chosen].mean()) if count else None
            for level, held in inside.items()
        }

    by_incidence = []
    for low, high in itertools.pairwise(bands_deg):
        last = high == bands_deg[-1]
        band = (angle >= low) & ((angle <= high) if last else (angle < high))
        by_incidence.append({"incidence_low_deg": low, "incidence_high_deg": high} | shares(band))
    return shares(np.ones(len(angle), bool)) | {"by_incidence": by_incidence}
