"""How often predicted intervals hold: the share of pixels within those of 68 and 95 %, in all and by incidence."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

LEVELS = (68, 95)  # percent
BANDS_DEG = (0.0, 30.0, 45.0, 60.0, 75.0, 90.0)  # incidence on the terrain


def gaussian_widths(std: NDArray) -> list[NDArray]:
    """Half-widths of the intervals of LEVELS of a normal distribution."""
    return [float(ndtri(0.5 + level / 200)) * std for level in LEVELS]


def count_within(away: NDArray, widths: Sequence[NDArray], incidence: NDArray) -> NDArray[np.int64]:
    """(3, bands): pixels by incidence, and of these the ones within each interval.

    away : |measured - predicted|; widths : half-widths of the intervals of LEVELS; incidence : rad; any one shape.
    Pixels that are not finite in all of these do not count.
    """
    known = np.isfinite(away) & np.isfinite(incidence) & np.isfinite(widths[0]) & np.isfinite(widths[1])
    bands = np.digitize(np.degrees(incidence[known]), BANDS_DEG[1:-1])
    inside = [np.ones(len(bands), bool), *((away <= width)[known] for width in widths)]
    return np.stack([np.bincount(bands[held], minlength=len(BANDS_DEG) - 1) for held in inside])


def shares(counts: NDArray) -> dict[str, Any]:
    """Percent of pixels within the intervals, in all and by incidence; None where there are no pixels. counts : (3, bands)"""

    def share(counted: NDArray) -> dict[str, Any]:
        total = int(counted[0])
        return {"pixels": total} | {
            str(level): 100 * float(held / total) if total else None
            for level, held in zip(LEVELS, counted[1:], strict=True)
        }

    bands = [
        {"incidence_low_deg": low, "incidence_high_deg": high} | share(counts[:, k])
        for k, (low, high) in enumerate(itertools.pairwise(BANDS_DEG))
    ]
    return share(counts.sum(axis=1)) | {"by_incidence": bands}


def coverage_lines(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table of :func:`shares`."""
    rows = [(f"{b['incidence_low_deg']:.0f} to {b['incidence_high_deg']:.0f} deg", b) for b in found["by_incidence"]]
    cells = [
        [name, str(row["pixels"]), f"{row['68']:.1f}", f"{row['95']:.1f}"]
        for name, row in [*rows, ("all", found)]
        if row["pixels"]
    ]
    return ["incidence", "pixels", "within 68 %", "within 95 %"], cells
