"""What is fitted on the train split, alike for every compared model: global coefficients, and gain and offset per image.

With features phi (the images of the unit coefficients, or one rendering) the model of an image in DN is
``y = gain[frame] (c . phi) + offset[frame]``; calibrated images have gain 1 and offset 0. All sums over pixels stay in
one small Gram matrix per frame, so that the fit streams and is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.network.pixels import Pixels, fit_pixels
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import ReflectanceModel, masked_radiance_factor

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
    frames = len(gram)
    gain, offset = np.ones(frames), np.zeros(frames)
    for f in range(frames):
        n = gram[f, -2, -2]
        if n == 0:
            continue
        mean_r, mean_y = coefficients @ gram[f, :-2, -2] / n, gram[f, -2, -1] / n
        variance = coefficients @ gram[f, :-2, :-2] @ coefficients / n - mean_r**2
        covariance = coefficients @ gram[f, :-2, -1] / n - mean_r * mean_y
        gain[f] = covariance / variance if variance > 1e-12 * max(mean_r**2, 1e-300) else 0.0
        offset[f] = mean_y - gain[f] * mean_r
    return gain, offset


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


@dataclass
class PixelSample:
    """A random sample of train pixels, for models that are not linear in their parameters. All (N,)."""

    cos_incidence: Tensor
    cos_emission: Tensor
    cos_phase: Tensor
    visibility: Tensor
    image: Tensor
    frame: Tensor

    @property
    def angles(self) -> Angles:
        """(N,) float64."""
        return Angles(*(c.double() for c in (self.cos_incidence, self.cos_emission, self.cos_phase)))

    def thin(self, most: int) -> PixelSample:
        """At most ``most`` pixels, evenly taken."""
        step = max(1, -(-len(self.image) // most))
        return PixelSample(**{name: getattr(self, name)[::step] for name in self.__dataclass_fields__})


def sample_gram(model: ReflectanceModel, sample: PixelSample, frames: int) -> np.ndarray:
    """The Gram matrices of a linear model over sampled pixels, (F, K + 2, K + 2)."""
    angles, count = sample.angles, len(model.parameters)
    units = torch.eye(count, dtype=torch.float64)
    images = [masked_radiance_factor(model, model.unpack(unit, 0), angles) for unit in units]
    gram = FrameGram(count, frames)
    for f in torch.unique(sample.frame).tolist():
        mine = sample.frame == f
        features = torch.stack([(image * sample.visibility)[mine] for image in images])[None, :, None]
        image = sample.image[mine][None, None].double()
        gram.add(features, image, torch.ones_like(image, dtype=torch.bool), np.array([f]))
    return gram.gram


def fit_nonlinear(
    model: ReflectanceModel, sample: PixelSample, calibrated: bool, free: Sequence[str] = ()
) -> np.ndarray:
    """One parameter set for all pixels, within the model's bounds, (C,): see :func:`fit_pixels`."""
    pixels = Pixels(sample.angles, sample.visibility.double(), sample.image.double())
    return fit_pixels(model, pixels, free, None if calibrated else sample.frame, ROUNDS).double().numpy()
