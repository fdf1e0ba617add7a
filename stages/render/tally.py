"""What was rendered, gathered for the line at the end."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from stages.common.arrays import Floats32
from stages.render.config import Summary


class Tally:
    """Shares and means of an image, gathered from its bands of rows."""

    def __init__(self, image_units: str) -> None:
        self.image_units = image_units
        self.pixels = self.known = self.clipped = 0
        self.total = self.dark = 0.0
        self.low, self.high = math.inf, -math.inf

    def add(self, band: Mapping[str, Floats32]) -> None:
        """Count one band: ``image``, ``shadow``, ``incidence_deg`` and ``clipped``, (h, w) each."""
        image, known = band["image"], np.isfinite(band["image"])
        self.pixels += image.size
        self.known += int(known.sum())
        self.clipped += int((band["clipped"][known] > 0).sum())
        self.total += float(image[known].sum(dtype=np.float64))
        self.dark += float(np.nansum(np.where(known, band["shadow"], np.nan), dtype=np.float64))
        incidence = band["incidence_deg"][np.isfinite(band["incidence_deg"])]
        if incidence.size:
            self.low, self.high = min(self.low, float(incidence.min())), max(self.high, float(incidence.max()))

    def summary(self, view_id: str, files: Sequence[Path], size: tuple[int, int], samples: int) -> Summary:
        """The counts as a summary; size : samples and lines."""
        n = max(self.known, 1)
        return Summary(
            view_id,
            tuple(files),
            size,
            self.known / max(self.pixels, 1),
            self.total / n,
            self.dark / n,
            (self.low, self.high),
            samples,
            clipped=self.clipped,
            image_units=self.image_units,
        )
