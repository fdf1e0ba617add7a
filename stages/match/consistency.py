"""Matching consistency: pictures that agree pixel for pixel should match at equal places."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stages.common.intervals import LOGIT, ratio_interval
from stages.match.base import Matches

THRESHOLDS = (1, 3, 5)  # px at 512 x 384
NEAR = 20  # px: farther matches are wrong altogether


def summarise(found: list[Matches], ground: Sequence[int]) -> dict[str, float | int | None]:
    """Pooled over the matches of all crops: shares within 1, 3 and 5 px in percent, mean and median error in px.

    ground : the piece of ground that each crop shows; 95 % intervals take these for independent, not the crops
    The median shift (rendered - measured) is that of the matches within 20 px: far from 0, the images are misregistered
    and no reflectance can help. None where there is nothing to say.
    """
    errors = [m.errors for m in found]
    counts = np.array([len(e) for e in errors], float)
    pooled = np.concatenate(errors) if errors else np.empty(0)
    result: dict[str, float | int | None] = {"crops": len(errors), "matches": int(counts.sum())}
    result["tiles"] = len(set(ground))
    for threshold in THRESHOLDS:
        within = np.array([(e <= threshold).sum() for e in errors], float)
        key = f"within_{threshold}_px_percent"
        share = ratio_interval(within, counts, np.asarray(ground), LOGIT)
        result[key] = 100 * share.value if len(pooled) else None
        known = len(pooled) and math.isfinite(share.low)
        result[f"{key}_low"] = max(0.0, 100 * share.low) if known else None
        result[f"{key}_high"] = min(100.0, 100 * share.high) if known else None
    result["mean_error_px"] = float(pooled.mean()) if len(pooled) else None
    result["median_error_px"] = float(np.median(pooled)) if len(pooled) else None
    near = [(m.rendered - m.measured)[m.errors <= NEAR] for m in found]
    shifts = np.concatenate(near) if near else np.empty((0, 2))
    for axis, name in enumerate(("right", "down")):
        result[f"median_shift_{name}_px"] = float(np.median(shifts[:, axis])) if len(shifts) else None
    return result
