"""Matching consistency: pictures that agree pixel for pixel should match at equal places."""

from __future__ import annotations

import numpy as np

from stages.match.base import Matches

THRESHOLDS = (1, 3, 5)  # px at 512 x 384
DRAWS = 1000
NEAR = 20  # px: farther matches are wrong altogether


def summarise(found: list[Matches], seed: int = 0) -> dict[str, float | int | None]:
    """Pooled over the matches of all crops: shares within 1, 3 and 5 px in percent, mean and median error in px.

    The median shift (rendered - measured) is that of the matches within 20 px: far from 0, the images are misregistered
    and no reflectance can help. 95 % intervals resample crops; None where there is nothing to say.
    """
    errors = [m.errors for m in found]
    counts = np.array([len(e) for e in errors], float)
    pooled = np.concatenate(errors) if errors else np.empty(0)
    result: dict[str, float | int | None] = {"crops": len(errors), "matches": int(counts.sum())}
    rng = np.random.default_rng(seed)
    draws = rng.multinomial(max(1, len(errors)), np.full(max(1, len(errors)), 1 / max(1, len(errors))), size=DRAWS)
    for threshold in THRESHOLDS:
        within = np.array([(e <= threshold).sum() for e in errors], float)
        key = f"within_{threshold}_px_percent"
        result[key] = 100 * float(within.sum() / counts.sum()) if len(pooled) else None
        result[f"{key}_low"], result[f"{key}_high"] = None, None
        if len(errors) > 1 and len(pooled):
            with np.errstate(invalid="ignore", divide="ignore"):
                shares = 100 * (draws @ within) / (draws @ counts)
            low, high = np.nanquantile(shares, (0.025, 0.975))
            result[f"{key}_low"], result[f"{key}_high"] = float(low), float(high)
    result["mean_error_px"] = float(pooled.mean()) if len(pooled) else None
    result["median_error_px"] = float(np.median(pooled)) if len(pooled) else None
    near = [(m.rendered - m.measured)[m.errors <= NEAR] for m in found]
    shifts = np.concatenate(near) if near else np.empty((0, 2))
    for axis, name in enumerate(("right", "down")):
        result[f"median_shift_{name}_px"] = float(np.median(shifts[:, axis])) if len(shifts) else None
    return result
