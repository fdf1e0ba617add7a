"""Where training starts: the best uniform surface, and each uncalibrated image's gain and offset against it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from torch import Tensor

from stages.network.losses import Radiometry
from stages.network.pixels import design_columns, fit_pixels, sample_batches, sample_pixels
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.formation.radiometry import line_of_sums
from stages.physics.photometry import ReflectanceModel, get_model

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
    n, sx, sy = moments[:, :3].unbind(1)
    gain, _ = line_of_sums(*moments.unbind(1))
    # A gain below a fifth of brightness over I/F: the image shows texture more than shading, and the ratio is taken.
    ratio = sy / sx.clamp(min=1e-6)
    gain = torch.where(gain > 0.2 * ratio, gain, ratio)
    offset = (sy - gain * sx) / n.clamp(min=1)
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
    columns = design_columns(model, pixels)
    # products and sums instead of BLAS, whose sums depend on where arrays lie in memory
    gram = torch.stack([(columns * column).sum(dim=1) for column in columns])
    gram += 1e-6 * gram.diagonal().mean() * torch.eye(len(gram))
    right = (columns * pixels.image).sum(dim=1)
    if not positive:
        return torch.linalg.solve(gram, right).float()
    root = torch.linalg.cholesky(gram)
    within = torch.linalg.solve_triangular(root, right[:, None], upper=False)[:, 0]
    solution, _ = nnls(root.T.numpy(), within.numpy())
    return torch.from_numpy(np.maximum(solution, 0.05 * max(solution.max(), 1e-3))).float()


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
