"""Where training starts: the best uniform surface, and each uncalibrated image's gain and offset against it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.network.losses import Radiometry
from stages.pairs.reader import Batch, PairReader
from stages.physics.formation.chain import form
from stages.physics.photometry import ReflectanceModel, get_model

REFERENCE = "lunar_lambert"  # the published surface against which unknown gains and offsets are first fitted
MAXIMUM_PAIRS = 512  # enough for a handful of numbers


def _batches(reader: PairReader, indices: NDArray[np.int64], size: int = 32) -> Iterator[Batch]:
    step = max(1, len(indices) // MAXIMUM_PAIRS)
    chosen = indices[::step]
    for first in range(0, len(chosen), size):
        yield reader.batch(chosen[first : first + size])


def _uniform(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1)


def fit_start(reader: PairReader, indices: NDArray[np.int64], model: ReflectanceModel) -> tuple[Tensor, Radiometry]:
    """Uniform coefficients (C,) and the radiometry that go with them.

    Gains are first fitted against the reference surface, then in turn with the coefficients: a surface of another
    shape would give images of steep and of flat ground gains that do not belong together.
    """
    radiometry = fit_radiometry(reader, indices)
    start = fit_uniform(reader, indices, model, radiometry)
    if reader.units == "dn" and model.linear:
        for _ in range(4):
            radiometry = fit_radiometry(reader, indices, model, start)
            start = fit_uniform(reader, indices, model, radiometry)
    return start, radiometry


def fit_radiometry(
    reader: PairReader, indices: NDArray[np.int64], model: ReflectanceModel | None = None, uniform: Tensor | None = None
) -> Radiometry:
    """Gain and offset of each image against a uniform surface (default: the reference), by least squares over ``indices``.

    Images without pairs there take the mean gain and offset; calibrated images keep 1 and 0.
    """
    frames = len(reader.image_ids)
    if reader.units == "iof":
        return Radiometry(torch.ones(frames), torch.zeros(frames), calibrated=True)
    if model is None or uniform is None:
        model = get_model(REFERENCE)
        uniform = torch.tensor([p.default for p in model.parameters])
    defaults = _uniform(uniform)
    moments = torch.zeros(frames, 5, dtype=torch.float64)  # n, sum x, sum y, sum xx, sum xy
    for batch in _batches(reader, indices):
        x = form(batch.observation, model, defaults).double() * batch.valid
        y = batch.image.double() * batch.valid
        terms = torch.stack([batch.valid.double(), x, y, x * x, x * y], dim=1).sum(dim=(2, 3))
        assert batch.observation.frame is not None
        moments.index_add_(0, batch.observation.frame, terms)
    n, sx, sy, sxx, sxy = moments.unbind(1)
    mean_x, mean_y = sx / n.clamp(min=1), sy / n.clamp(min=1)
    variance = sxx / n.clamp(min=1) - mean_x**2
    gain = (sxy / n.clamp(min=1) - mean_x * mean_y) / variance.clamp(min=1e-12)
    # A gain below a fifth of brightness over I/F means that texture, not shading, rules the image: start from the ratio.
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
    reader: PairReader, indices: NDArray[np.int64], model: ReflectanceModel, radiometry: Radiometry
) -> Tensor:
    """The uniform coefficients (C,) that fit best over ``indices``; the model's defaults where it is not linear.

    Linear models: normal equations over valid pixels, cast shadow included. Coefficients that come out negative are
    dropped to a small positive value and the rest solved again, since the network keeps them nearly positive.
    """
    names = [p.name for p in model.parameters]
    if not model.linear:
        return torch.tensor([p.default for p in model.parameters])
    gram = torch.zeros(len(names), len(names), dtype=torch.float64)
    right = torch.zeros(len(names), dtype=torch.float64)
    gain, offset = radiometry.gain().detach(), radiometry.offset().detach()
    for batch in _batches(reader, indices):
        o = batch.observation
        assert o.frame is not None
        target = (batch.image - offset[o.frame, None, None]) / gain[o.frame, None, None]
        columns = torch.stack([form(o, model, _uniform(torch.eye(len(names))[k])) for k in range(len(names))])
        z = (columns * batch.valid).flatten(1).double()
        gram += z @ z.T
        right += z @ (target * batch.valid).flatten().double()
    keep = list(range(len(names)))
    solution = torch.zeros(len(names), dtype=torch.float64)
    while keep:
        sub = gram[keep][:, keep]
        ridge = 1e-6 * sub.diagonal().mean() * torch.eye(len(keep), dtype=torch.float64)
        part = torch.linalg.solve(sub + ridge, right[keep])
        if (part > 0).all():
            solution[keep] = part
            break
        keep.pop(int(part.argmin()))
    floor = 0.05 * solution.abs().max().clamp(min=1e-3)
    return torch.maximum(solution, floor).float()


def elevation_scale(reader: PairReader, indices: NDArray[np.int64]) -> float:
    """Std of the crop-centred elevations over ``indices``, m."""
    total, count = 0.0, 0
    for first in range(0, len(indices), 256):
        z = reader.elevation(indices[first : first + 256]).double()
        z = z - z.mean(dim=(1, 2), keepdim=True)
        total, count = total + float((z * z).sum()), count + z.numel()
    return max((total / max(count, 1)) ** 0.5, 1e-3)
