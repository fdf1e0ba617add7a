"""Intervals by resampling ground tiles: crops of one tile share terrain and images, so they are not independent."""

from __future__ import annotations

import numpy as np


class TileBootstrap:
    """Resamples of the ground tiles, shared by every statistic so that differences are paired.

    tile : (N,) tile of every crop
    Weighted means over crops become ratios of tile sums; intervals are the 2.5 and 97.5 % quantiles.
    """

    def __init__(self, tile: np.ndarray, resamples: int, seed: int) -> None:
        names, self.index = np.unique(tile, return_inverse=True)
        self.tiles = len(names)
        rng = np.random.default_rng(seed)
        self.weights = rng.multinomial(self.tiles, np.full(self.tiles, 1 / self.tiles), size=resamples).astype(float)

    @property
    def enough(self) -> bool:
        """One tile has no spread to resample."""
        return self.tiles > 1 and len(self.weights) > 0

    def draws(self, total: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """The resampled sum(total) / sum(weight), (resamples,); crops with NaN in total do not count."""
        known = np.isfinite(total)
        sums = np.bincount(self.index[known], total[known], minlength=self.tiles)
        counts = np.bincount(self.index[known], weight[known], minlength=self.tiles)
        with np.errstate(invalid="ignore", divide="ignore"):
            return (self.weights @ sums) / (self.weights @ counts)

    def interval(self, draws: np.ndarray) -> tuple[float, float]:
        """95 % interval of resampled values; NaN where there is nothing to resample."""
        draws = draws[np.isfinite(draws)]
        if not self.enough or not len(draws):
            return float("nan"), float("nan")
        low, high = np.quantile(draws, (0.025, 0.975))
        return float(low), float(high)
