"""What is fitted on the train split, alike for every compared model: global coefficients, and gain and offset per image.

With features phi (the images of the unit coefficients, or one rendering) the model of an image in DN is
``y = gain[frame] (c . phi) + offset[frame]``; calibrated images have gain 1 and offset 0. All sums over pixels stay in
one small Gram matrix per frame, so that the fit streams and is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.physics.formation.geometry import Angles
from stages.physics.photometry import ReflectanceModel, masked_radiance_factor


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


def fit_nonlinear(
    model: ReflectanceModel, sample: PixelSample, frames: int, calibrated: bool, rounds: int = 60
) -> np.ndarray:
    """One parameter set for all pixels by Levenberg-Marquardt, within the model's bounds; (C,).

    Starts at the model's defaults. Uncalibrated frames get their best gain and offset in every round.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # thousands of small operations: handing them to threads costs more than it saves
    try:
        return _levenberg_marquardt(model, sample, frames, calibrated, rounds)
    finally:
        torch.set_num_threads(threads)


def _levenberg_marquardt(
    model: ReflectanceModel, sample: PixelSample, frames: int, calibrated: bool, rounds: int
) -> np.ndarray:
    angles = Angles(
        sample.cos_incidence.double()[None], sample.cos_emission.double()[None], sample.cos_phase.double()[None]
    )
    visibility, image = sample.visibility.double(), sample.image.double()

    def render(raw: Tensor) -> Tensor:
        parameters = model.unpack(model.constrain(raw[None, :, None], 1), 1)
        return masked_radiance_factor(model, parameters, angles)[0] * visibility

    def residual(raw: Tensor) -> tuple[Tensor, Tensor]:
        rendered = render(raw)
        gain = torch.ones(frames, dtype=torch.float64)
        offset = torch.zeros(frames, dtype=torch.float64)
        if not calibrated:
            gram = FrameGram(1, frames)
            for f in range(frames):
                mine = sample.frame == f
                if mine.any():
                    r, y = rendered[mine][None, None, None], image[mine][None, None]
                    gram.add(r, y, torch.ones_like(y, dtype=torch.bool), np.array([f]))
            gain, offset = (torch.from_numpy(v) for v in solve_gain_offset(gram.gram, np.ones(1)))
        pixel_gain = gain[sample.frame]
        return image - pixel_gain * rendered - offset[sample.frame], pixel_gain

    default = torch.tensor([[p.default for p in model.parameters]], dtype=torch.float64)
    raw = model.unconstrain(default, 1)[0].clamp(-8, 8)
    damping = 1e-3
    error, pixel_gain = residual(raw)
    loss = float(error @ error)
    for _ in range(rounds):
        columns = _jacobian(render, raw) * pixel_gain[:, None]
        normal, slope = columns.T @ columns, columns.T @ error
        improved = False
        for _ in range(8):
            lift = torch.diag(damping * normal.diagonal().clamp(min=1e-12 * float(normal.diagonal().max() + 1e-300)))
            candidate = (raw + torch.linalg.lstsq(normal + lift, slope[:, None]).solution[:, 0]).clamp(-12, 12)
            error_new, gain_new = residual(candidate)
            loss_new = float(error_new @ error_new)
            if loss_new < loss:
                gained = (loss - loss_new) / max(loss, 1e-300)
                raw, error, pixel_gain, loss = candidate, error_new, gain_new, loss_new
                damping, improved = max(damping / 5, 1e-12), True
                break
            damping *= 5
        if not improved or gained < 1e-7:
            break
    return model.constrain(raw[None], 1)[0].numpy()


def _jacobian(render: Callable[[Tensor], Tensor], raw: Tensor, step: float = 1e-5) -> Tensor:
    """Central differences in double precision, (N, C): a few parameters only, and exact to about 1e-9."""
    columns = []
    for k in range(len(raw)):
        shift = torch.zeros_like(raw)
        shift[k] = step
        columns.append((render(raw + shift) - render(raw - shift)) / (2 * step))
    return torch.stack(columns, dim=1)
