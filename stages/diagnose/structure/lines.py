"""A single wave that stands out in the spectrum of a frame: of its brightness, or of where it shows the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import median_filter
from scipy.special import gammaincinv
from torch import Tensor

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.products import Rows, whitened_residual
from stages.diagnose.likelihood.tails import surprise
from stages.diagnose.model.sites import Site
from stages.diagnose.rows.patches import Grid
from stages.diagnose.settings import FAR, NEAR, PEAK
from stages.diagnose.structure.innovations import Innovation

SHORTEST = 0.55  # cycles per pixel of the detector: it has none beyond 0.5, and a wave is that much wide
STEEPEST = 3.0  # standard deviations: an edge is no line


def line_of_brightness(
    rows: Sequence[Rows], model: Covariance, grid: Grid, frames: int, without: Tensor | None = None
) -> tuple[float, float, float]:
    """-log10 of the chance of the strongest single wave of any frame among all of them, its share of that frame's squares, and
    its rms relative to brightness.

    without : (frames, K) bool, waves that are not looked at
    """
    spectra = []
    for row in rows:
        z, _, _ = whitened_residual(row, model, grid)
        size = (row.patch.weight.square().mean((-2, -1)) * model.size.get(row.patch.number, 1.0)).clamp(min=1e-6)
        spectra.append((row.patch.frames, z / size.sqrt()[:, None]))
    chance, share, frame, waves = _strongest(spectra, grid, frames, without)
    power, pixels = torch.zeros(len(grid.keep), dtype=torch.float64), 0.0
    for row in rows:
        here = row.patch.frames == frame
        power += row.shared[0][here].abs().square().double().sum(0)
        pixels += float(row.patch.weight[here].square().sum())
    squares = float((power - _about(power, grid)).clamp(min=0)[waves].sum())  # the ground has its part of every wave
    return chance, share, math.sqrt(squares / max(pixels, 1.0))


def across_columns(sites: Sequence[Site], grid: Grid, frames: int) -> Tensor:
    """(frames, K) bool: waves that lie across the columns of a frame's detector within the width of one wave, as a flat field's errors do; all waves
    of a frame whose detector is not known.
    """
    out = torch.ones(frames, len(grid.keep), dtype=torch.bool)
    length = min(grid.height, grid.width)
    # waves shorter than two pixels of the map pass for longer ones
    whole = torch.cartesian_prod(*[torch.arange(-1.0, 2.0)] * 2)
    waves = torch.stack(grid.waves, 1)[:, None] + whole
    for site in sites:
        if site.observation.detector_line is None:
            continue
        down, across = (d.flatten(2).nanmedian(2).values for d in torch.gradient(site.on_detector(), dim=(-2, -1)))
        for frame, jacobian in zip(site.frames.tolist(), torch.stack([down, across], 1).to(waves), strict=True):
            if bool(torch.linalg.det(jacobian).abs() > 1e-6):
                per_line, per_sample = (waves @ torch.linalg.inv(jacobian).T).unbind(-1)  # cycles on the detector
                out[frame] = (((per_line * length).abs() < 1) & (per_sample.abs() < SHORTEST)).any(1)
    return out


def line_of_displacement(every: Sequence[Innovation], grid: Grid, frames: int) -> tuple[float, float]:
    """The same of what is left times the slope of the rendered brightness, along columns or rows: a displacement that comes
    back at equal distances, as the nearest pixel of a detector leaves it. It goes with the image's slopes, whose own spectrum hides it.
    """
    best = 0.0, 0.0
    for axis in (-1, -2):
        spectra = []
        for one in every:
            patch = one.patch
            bright = patch.scale / patch.scale.mean((-2, -1), keepdim=True)
            slope = torch.gradient(bright, dim=axis)[0]
            slope = slope / slope.square().mean().sqrt().clamp(min=1e-9)
            moved = one.limited * slope.clamp(-STEEPEST, STEEPEST) * patch.weight
            z = torch.fft.rfft2(moved).flatten(-2)[:, grid.keep]
            size = (z.abs().square().mean(1)).clamp(min=1e-9).sqrt()
            spectra.append((patch.frames, z / size[:, None]))
        best = max(best, _strongest(spectra, grid, frames)[:2])
    return best


def _strongest(
    spectra: Sequence[tuple[Tensor, Tensor]], grid: Grid, frames: int, without: Tensor | None = None
) -> tuple[float, float, int, Tensor]:
    """-log10 of its chance, its share of the squares, its frame (-1: none), and which waves it is, (K,) bool.

    spectra : frames (n,) and coefficients (n, K) of every piece of ground; without : (frames, K) bool, waves that are not looked at
    """
    power = torch.zeros(frames, len(grid.keep), dtype=torch.float64)
    count = torch.zeros(frames, dtype=torch.float64)
    for of, z in spectra:
        power.index_add_(0, of, z.abs().square().double())
        count.index_add_(0, of, torch.ones(len(of), dtype=torch.float64))
    seen = torch.nonzero(count)[:, 0]
    best, largest, frame, waves = 0.0, 0.0, -1, torch.zeros(len(grid.keep), dtype=torch.bool)
    # broad waves are ground and film; of those in the corners, shorter than two pixels, images that were resampled have next to nothing
    fine = (grid.annulus >= 2) & (torch.hypot(*grid.waves) <= 0.5)
    for number, p, n in zip(seen.tolist(), power[seen], count[seen], strict=True):
        level = torch.zeros(grid.annuli, dtype=torch.float64)
        for a in range(grid.annuli):
            level[a] = p[grid.annulus == a].median()
        ratio = p / level[grid.annulus].clamp(min=1e-30)
        sought = fine if without is None else fine & ~without[number]
        ratio = torch.where(sought, ratio / _about(ratio, grid).clamp(min=1), 0.0)
        top = float(ratio.max())
        shape = max(float(n), 1.0)
        middle = float(gammaincinv(shape, 0.5))
        chance = float(surprise(np.array([2 * top * middle]), 2 * shape)[0]) - math.log10(int(fine.sum()) * len(seen))
        # neighbours share a wave through the window: what stands out by a little is no line
        if top > PEAK and chance > best:
            best, frame, waves = chance, number, ratio > PEAK
            largest = float(p[waves].sum() / p.sum())
    return best, largest, frame, waves


def _about(power: Tensor, grid: Grid) -> Tensor:
    """(K,) median power of the waves some way off each one: slanting light and optics make power go with direction, in no line."""
    columns = grid.width // 2 + 1
    row, column = grid.keep // columns, grid.keep % columns
    plane = np.full((grid.height, grid.width), float(power.median()))
    plane[row, column] = power
    plane[-row % grid.height, -column % grid.width] = power
    y, x = np.ogrid[-FAR : FAR + 1, -FAR : FAR + 1]
    ring = (np.hypot(y, x) <= FAR) & (np.hypot(y, x) > NEAR)
    return torch.from_numpy(median_filter(plane, footprint=ring, mode="wrap")[row, column])


__all__ = ["across_columns", "line_of_brightness", "line_of_displacement"]
