"""Where training starts: the best uniform surface, and each uncalibrated image's gain and offset against it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.network.losses import Radiometry
from stages.network.pixels import Pixels, fit_pixels, sample_batches, sample_pixels
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.photometry import ReflectanceModel, get_model, masked_radiance_factor

REFERENCE = "lunar_lambert"  # the published surface against which unknown gains and offsets are first fitted


def _uniform(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1)


def fit_start(
    reader: PairReader, indices: NDArray[np.int64], model: ReflectanceModel, positive: bool = False
) -> tuple[Tensor, Radiometry]:
    """Uniform coefficients (C,), and the radiometry that goes with them. indices : (n,), of pairs

    Gains are first fitted against the reference surface, then in turn with the coefficients: a surface of another
    shape would give images of steep and of flat ground gains that do not belong together.
    """
    radiometry = fit_radiometry(reader, indices)
    start = fit_uniform(reader, indices, model, radiometry, positive)
    if reader.units == "dn":
        for _ in range(4):
            radiometry = fit_radiometry(reader, indices, model, start)
            start = fit_uniform(reader, indices, model, radiometry, positive)
    return start, radiometry


def fit_radiometry(
    reader: PairReader, indices: NDArray[np.int64], model: ReflectanceModel | None = None, uniform: Tensor | None = None
) -> Radiometry:
    """Gain and offset of each image against a uniform surface (default: the reference), by least squares over ``indices``.

    Images without pairs there take the mean gain and offset; calibrated images keep 1 and 0.

    indices : (n,), of pairs; uniform : (C,) coefficients of ``model``
    """
    frames = len(reader.image_ids)
    if reader.units == "iof":
        return Radiometry(torch.ones(frames), torch.zeros(frames), calibrated=True)
    if model is None or uniform is None:
        model = get_model(REFERENCE)
        uniform = torch.tensor([p.default for p in model.parameters])
    defaults = _uniform(uniform)
    moments = torch.zeros(frames, 5, dtype=torch.float64)  # n, sum x, sum y, sum xx, sum xy
    for _, batch in sample_batches(reader, indices):
        x = form(batch.observation, model, defaults).double() * batch.valid
        y = batch.image.double() * batch.valid
        terms = torch.stack([batch.valid.double(), x, y, x * x, x * y], dim=1).sum(dim=(2, 3))
        assert batch.observation.frame is not None
        moments.index_add_(0, batch.observation.frame, terms)
    n, sx, sy, sxx, sxy = moments.unbind(1)
    mean_x, mean_y = sx / n.clamp(min=1), sy / n.clamp(min=1)
    variance = sxx / n.clamp(min=1) - mean_x**2
    gain = (sxy / n.clamp(min=1) - mean_x * mean_y) / variance.clamp(min=1e-12)
    # A gain below a fifth of brightness over I/F: the image shows texture more than shading, and the ratio is taken.
    ratio = mean_y / mean_x.clamp(min=1e-6)
    gain = torch.where(gain > 0.2 * ratio, gain, ratio)
    offset = mean_y - gain * mean_x
    seen = n > 0
    if not seen.any():
        return Radiometry(torch.ones(frames), torch.zeros(frames), calibrated=False)
    gain = torch.where(seen, gain, gain[seen].log().mean().exp())
    offset = torch.where(seen, offset, offset[seen].mean())
    return Radiometry(gain.float(), offset.float(), calibrated=False)


def fit_uniform(
    reader: PairReader,
    indices: NDArray[np.int64],
    model: ReflectanceModel,
    radiometry: Radiometry,
    positive: bool = False,
) -> Tensor:
    """The uniform coefficients (C,) that fit best over ``indices``, within the model's bounds or, if wanted, positive."""
    pixels = sample_pixels(reader, indices, radiometry)
    if not model.linear:
        return fit_pixels(model, pixels)
    gram, right = _normal_equations(model, pixels)
    return _solve_positive(gram, right) if positive else _solve(gram, right).float()


def _normal_equations(model: ReflectanceModel, pixels: Pixels) -> tuple[Tensor, Tensor]:
    """(C, C) and (C,) float64 of a linear model."""
    names = [p.name for p in model.parameters]
    units = [dict(zip(names, unit, strict=True)) for unit in torch.eye(len(names), dtype=torch.float64)]
    columns = torch.stack([masked_radiance_factor(model, unit, pixels.angles) * pixels.light for unit in units])
    # products and sums instead of BLAS, whose sums depend on where arrays lie in memory
    gram = torch.stack([(columns * column).sum(dim=1) for column in columns])
    return gram, (columns * pixels.image).sum(dim=1)


def _solve(gram: Tensor, right: Tensor) -> Tensor:
    ridge = 1e-6 * gram.diagonal().mean() * torch.eye(len(gram), dtype=torch.float64)
    return torch.linalg.solve(gram + ridge, right)


def _solve_positive(gram: Tensor, right: Tensor) -> Tensor:
    """Coefficients that come out negative are dropped to a small positive value and the rest solved again."""
    keep = list(range(len(right)))
    solution = torch.zeros(len(right), dtype=torch.float64)
    while keep:
        part = _solve(gram[keep][:, keep], right[keep])
        if (part > 0).all():
            solution[keep] = part
            break
        keep.pop(int(part.argmin()))
    floor = 0.05 * solution.abs().max().clamp(min=1e-3)
    return torch.maximum(solution, floor).float()


def elevation_scale(reader: PairReader, indices: NDArray[np.int64]) -> float:
    """Std of the crop-centred elevations over ``indices``, m.

    indices : (n,), of pairs
    """
    total, count = 0.0, 0
    for first in range(0, len(indices), 256):
        z = reader.elevation(indices[first : first + 256]).double()
        z = z - z.mean(dim=(1, 2), keepdim=True)
        total, count = total + float((z * z).sum()), count + z.numel()
    return max((total / max(count, 1)) ** 0.5, 1e-3)
