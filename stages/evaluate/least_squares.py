"""What is fitted on the train split, alike for every compared model: global coefficients, and gain and offset per image.

With features phi (the images of the unit coefficients, or one rendering) the model of an image in DN is
``y = gain[frame] (c . phi) + offset[frame]``; calibrated images have gain 1 and offset 0. All sums over pixels stay in
one small Gram matrix per frame, so that the fit streams and is exact.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stages.network.pixels import Pixels, design_columns, fit_pixels
from stages.physics.formation.radiometry import line_of_sums
from stages.physics.photometry import ReflectanceModel

ROUNDS = 100  # of a fit that is not linear: a baseline is to be as good as its law allows


class FrameGram:
    """Sums of products of (features, 1, image) over valid pixels, per frame: (F, K + 2, K + 2) float64."""

    def __init__(self, features: int, frames: int) -> None:
        self.gram = np.zeros((frames, features + 2, features + 2))

    def add(self, features: Tensor, image: Tensor, valid: Tensor, frame: np.ndarray) -> None:
        """features : (B, K, H, W); image, valid : (B, H, W); frame : (B,)"""
        batch, count = features.shape[:2]
        rows = torch.cat([features, torch.ones_like(image)[:, None], image[:, None]], dim=1).to(torch.float64)
        rows = torch.where(valid[:, None], rows, 0).reshape(batch, count + 2, -1)
        np.add.at(self.gram, frame, (rows @ rows.transpose(1, 2)).cpu().numpy())

    @property
    def pixels(self) -> np.ndarray:
        """Valid pixels of every frame, (F,)."""
        return self.gram[:, -2, -2]


def solve_coefficients(gram: np.ndarray) -> np.ndarray:
    """Least-squares coefficients of calibrated images, (K,), from Gram matrices (F, K + 2, K + 2)."""
    total = gram.sum(axis=0)
    return np.linalg.lstsq(total[:-2, :-2], total[:-2, -1], rcond=1e-12)[0]


def solve_gain_offset(gram: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares gain and offset of every frame, each (F,), for features combined with ``coefficients``.

    Frames without pixels keep gain 1 and offset 0; a constant rendering leaves the mean in the offset.
    """
    n, of_y = gram[:, -2, -2], gram[:, -2, -1]
    of_r, of_ry = gram[:, :-2, -2] @ coefficients, gram[:, :-2, -1] @ coefficients
    of_rr = np.einsum("fkl,k,l->f", gram[:, :-2, :-2], coefficients, coefficients)
    gain, offset = line_of_sums(n, of_r, of_y, of_rr, of_ry)
    return np.where(n > 0, gain, 1.0), offset


def solve_uncalibrated(gram: np.ndarray, start: np.ndarray, rounds: int = 500) -> np.ndarray:
    """Coefficients shared by frames of unknown gain and offset, by alternating exact least squares.

    Their common scale is free (the gains carry it), so it is kept at that of ``start``.
    """
    norm = np.linalg.norm(start)
    coefficients = start.astype(float)
    for _ in range(rounds):
        gain, offset = solve_gain_offset(gram, coefficients)
        left = np.einsum("f,fkl->kl", gain**2, gram[:, :-2, :-2])
        right = np.einsum("f,fk->k", gain, gram[:, :-2, -1] - offset[:, None] * gram[:, :-2, -2])
        update = np.linalg.lstsq(left, right, rcond=1e-12)[0]
        scale = np.linalg.norm(update)
        if scale == 0:
            break
        update *= norm / scale
        if np.abs(update - coefficients).max() <= 1e-10 * norm:
            return update
        coefficients = update
    return coefficients


def sample_gram(model: ReflectanceModel, pixels: Pixels, frames: int) -> np.ndarray:
    """The Gram matrices of a linear model over sampled pixels, (F, K + 2, K + 2)."""
    assert pixels.frame is not None
    columns = design_columns(model, pixels)
    gram = FrameGram(len(columns), frames)
    for f in torch.unique(pixels.frame).tolist():
        mine = pixels.frame == f
        image = pixels.image[mine][None, None]
        gram.add(columns[None, :, None, mine], image, torch.ones_like(image, dtype=torch.bool), np.array([f]))
    return gram.gram


def fit_nonlinear(model: ReflectanceModel, pixels: Pixels, calibrated: bool, free: Sequence[str] = ()) -> np.ndarray:
    """One parameter set for all pixels, within the model's bounds, (C,): see :func:`fit_pixels`."""
    return fit_pixels(model, pixels, free, calibrated, ROUNDS).double().numpy()
