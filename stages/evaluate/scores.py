"""The scores: every row of the table rendered, matched and compared with the measured crops, batch by batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.evaluate.coverage import BANDS_DEG, count_within, gaussian_widths
from stages.evaluate.metrics import psnr, squared_error, ssim
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.renderers import Batch, batches, read_batch
from stages.evaluate.rows import Row
from stages.pairs.reader import PairReader
from stages.physics.formation.radiometry import crop_range

PER_ROW = ("squared_error", "ssim", "ssim_range_1", "lpips")


@dataclass
class Scores:
    """Per row (M) and crop (N); errors in I/F or in shares of the full DN range. Training runs are rows of one name.

    squared_error : (M, N) sums over valid pixels; ssim (crop range), ssim_range_1, lpips : (M, N)
    pixels, data_range : (N,)
    within : (3, bands, N) of the row 'learned', summed over training runs: pixels by incidence, and those within the 68 and
    95 % intervals that the networks predict (``coverage.count_within``)
    """

    names: list[str]
    squared_error: np.ndarray
    ssim: np.ndarray
    ssim_range_1: np.ndarray
    lpips: np.ndarray
    pixels: np.ndarray
    data_range: np.ndarray
    within: np.ndarray

    @property
    def mse(self) -> np.ndarray:
        """(M, N); NaN for crops without a valid pixel."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.squared_error / self.pixels

    @property
    def psnr_crop_range(self) -> np.ndarray:
        """(M, N), dB, with the range of each measured crop."""
        return np.asarray(psnr(self.mse, np.where(self.data_range > 0, self.data_range, np.nan)))

    def runs(self, name: str, field: str = "squared_error") -> np.ndarray:
        """What every training run of a row has, (runs, N); one run for rows without a network."""
        return getattr(self, field)[[k for k, n in enumerate(self.names) if n == name]]

    def mean_over_runs(self) -> Scores:
        """The scores with one row for each name."""
        names = list(dict.fromkeys(self.names))
        fields = {f: np.stack([self.runs(n, f).mean(axis=0) for n in names]) for f in PER_ROW}
        return Scores(names=names, **fields, pixels=self.pixels, data_range=self.data_range, within=self.within)


def score(
    reader: PairReader,
    rows: Sequence[Row],
    indices: np.ndarray,
    scale: float,
    size: int,
    keep: Callable[[int, np.ndarray, list[np.ndarray]], Any] | None = None,
    tick: Callable[[int], None] = lambda count: None,
) -> Scores:
    """Score every row on the crops ``indices`` (n,), ``size`` at a time.

    scale : full range of DN, 1 for calibrated images
    keep : called with (position, measured (B, H, W), rendered of every row), NaN where not usable
    tick : called with the number of crops of every batch that is done
    """
    perceptual = Perceptual()
    m, n = len(rows), len(indices)
    scores = Scores(
        names=[r.name for r in rows],
        squared_error=np.full((m, n), np.nan),
        ssim=np.full((m, n), np.nan),
        ssim_range_1=np.full((m, n), np.nan),
        lpips=np.full((m, n), np.nan),
        pixels=np.zeros(n, np.int64),
        data_range=np.zeros(n),
        within=np.zeros((3, len(BANDS_DEG) - 1, n), np.int64),
    )
    done = 0
    for chosen in batches(indices, size):
        batch = read_batch(reader, chosen, scale)
        where = slice(done, done + len(chosen))
        usable, measured = batch.usable.numpy(), batch.image.numpy()
        scores.pixels[where] = usable.sum(axis=(1, 2))
        ranges = crop_range(batch.image, batch.usable).numpy()
        scores.data_range[where] = ranges
        images = []
        for k, row in enumerate(rows):
            rendered = row.renderer.image(batch, row.matching).numpy()
            images.append(rendered)
            if row.name == "learned":
                _count_within(scores.within[:, :, where], row, batch, rendered)
            scores.squared_error[k, where] = squared_error(measured, rendered, usable)
            for b in range(len(chosen)):
                crop = (measured[b], rendered[b], usable[b])
                scores.ssim[k, done + b] = ssim(*crop, data_range=ranges[b])
                scores.ssim_range_1[k, done + b] = ssim(*crop, data_range=1.0)
                if perceptual.available:
                    scores.lpips[k, done + b] = perceptual.distance(*crop)
        if keep is not None:
            keep(done, np.where(usable, measured, np.nan), [np.where(usable, image, np.nan) for image in images])
        done += len(chosen)
        tick(len(chosen))
    return scores


def _count_within(counts: np.ndarray, row: Row, batch: Batch, rendered: np.ndarray) -> None:
    """Add one training run's pixels to ``counts`` (3, bands, B), where its network predicts deviations.

    rendered : (B, H, W)
    """
    std = row.renderer.deviation(batch)
    if std is None:
        return
    away = np.where(batch.usable.numpy(), np.abs(rendered - batch.image.numpy()), np.nan)
    incidence = np.arccos(np.clip(batch.state.angles.cos_incidence.numpy(), -1.0, 1.0))
    for b in range(len(away)):
        counts[:, :, b] += count_within(away[b], gaussian_widths(std[b].numpy()), incidence[b])
