"""Where training starts: the best uniform surface, and each uncalibrated image's gain and offset against it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.network.dataset import Batch, PairReader
from stages.network.losses import Radiometry
from stages.physics import facets
from stages.physics.formation import form
from stages.physics.geometry import Angles
from stages.physics.photometry import ReflectanceModel, get_model, masked_radiance_factor

REFERENCE = "lunar_lambert"  # the published surface against which unknown gains and offsets are first fitted
MAXIMUM_PAIRS = 512  # enough for a handful of numbers
MAXIMUM_PIXELS = 30_000


def _batches(reader: PairReader, indices: NDArray[np.int64], size: int = 32) -> Iterator[Batch]:
    step = max(1, len(indices) // MAXIMUM_PAIRS)
    chosen = indices[::step]
    for first in range(0, len(chosen), size):
        yield reader.batch(chosen[first : first + size])


def _uniform(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1)


def fit_start(
    reader: PairReader, indices: NDArray[np.int64], model: ReflectanceModel, positive: bool = False
) -> tuple[Tensor, Radiometry]:
    """Uniform coefficients (C,) and the radiometry that go with them.

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
    reader: PairReader,
    indices: NDArray[np.int64],
    model: ReflectanceModel,
    radiometry: Radiometry,
    positive: bool = False,
) -> Tensor:
    """The uniform coefficients (C,) that fit best over ``indices``, within the model's bounds or, if wanted, positive."""
    pixels = _sample(reader, indices, radiometry)
    if not model.linear:
        return fit_pixels(model, pixels)
    gram, right = _normal_equations(model, pixels)
    return _solve_positive(gram, right) if positive else _solve(gram, right).float()


def _targets(batch: Batch, radiometry: Radiometry) -> Tensor:
    """The images (B, H, W) in I/F."""
    frame = batch.observation.frame
    assert frame is not None
    gain, offset = radiometry.gain().detach(), radiometry.offset().detach()
    return (batch.image - offset[frame, None, None]) / gain[frame, None, None]


def _normal_equations(model: ReflectanceModel, pixels: Pixels) -> tuple[Tensor, Tensor]:
    """(C, C) and (C,) float64 of a linear model."""
    names = [p.name for p in model.parameters]
    units = [dict(zip(names, unit, strict=True)) for unit in torch.eye(len(names), dtype=torch.float64)]
    columns = torch.stack([masked_radiance_factor(model, unit, pixels.angles) * pixels.light for unit in units])
    # products and sums instead of BLAS, whose sums hang on where arrays lie in memory
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


@dataclass(frozen=True)
class Pixels:
    """Valid pixels of many images, (N,) float64 each: cosines, the share of the Sun that lights them, and I/F."""

    angles: Angles
    light: Tensor
    image: Tensor


def _sample(reader: PairReader, indices: NDArray[np.int64], radiometry: Radiometry) -> Pixels:
    """Valid pixels on a regular lattice over every crop, at most about MAXIMUM_PIXELS."""
    crops = min(len(indices), MAXIMUM_PAIRS)
    step = max(1, math.ceil(math.sqrt(crops * reader.size[0] * reader.size[1] / MAXIMUM_PIXELS)))
    found: list[list[Tensor]] = []
    for batch in _batches(reader, indices):
        o = batch.observation
        known = facets.look(o.elevation, o.sun_direction, o.camera_position, o.sun_horizon, o.gsd, o.body_radius)
        assert known is not None  # on the CPU, without gradients
        angles, light = known
        fields = (angles.cos_incidence, angles.cos_emission, angles.cos_phase, light, _targets(batch, radiometry))
        part = np.s_[:, step // 2 :: step, step // 2 :: step]
        valid = batch.valid[part]
        found.append([field.expand_as(batch.image)[part][valid].double() for field in fields])
    mu0, mu, phase, light, image = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Pixels(Angles(mu0, mu, phase), light, image)


def fit_pixels(model: ReflectanceModel, pixels: Pixels, rounds: int = 40) -> Tensor:
    """One set of parameters (C,) within the model's bounds, by Levenberg-Marquardt from its defaults.

    What the pixels do not tell stays at its default: leaving it costs a millionth of the images' power per unit of the
    unbounded parameter. That also keeps the fit from wandering along valleys, in which rounding would choose the place.
    """
    names = [p.name for p in model.parameters]

    def render(raw: Tensor) -> Tensor:
        values = dict(zip(names, model.constrain(raw, 0), strict=True))
        return masked_radiance_factor(model, values, pixels.angles) * pixels.light

    home = model.unconstrain(torch.tensor([p.default for p in model.parameters], dtype=torch.float64), 0).clamp(-8, 8)
    tie = 1e-6 * pixels.image.square().sum()
    raw, damping = home, 1e-3
    error = pixels.image - render(raw)
    loss = error.square().sum()
    for _ in range(rounds):
        columns = _slopes(render, raw)
        normal = torch.stack([(columns * c).sum(dim=1) for c in columns]) + tie * torch.eye(len(raw))
        slope = (columns * error).sum(dim=1) - tie * (raw - home)
        gained = 0.0
        for _ in range(8):
            step = torch.linalg.solve(normal + damping * torch.diag(normal.diagonal()), slope)
            moved = (raw + step).clamp(-12, 12)
            error_there = pixels.image - render(moved)
            loss_there = error_there.square().sum() + tie * (moved - home).square().sum()
            if loss_there < loss:
                gained = float((loss - loss_there) / loss)
                raw, error, loss, damping = moved, error_there, loss_there, damping / 5
                break
            damping *= 5
        if gained < 1e-7:
            break
    return model.constrain(raw, 0).float()


def _slopes(render: Callable[[Tensor], Tensor], raw: Tensor, step: float = 1e-5) -> Tensor:
    """(C, N) by central differences: in double precision exact to about 1e-9."""
    shifts = step * torch.eye(len(raw), dtype=raw.dtype)
    return torch.stack([(render(raw + shift) - render(raw - shift)) / (2 * step) for shift in shifts])


def elevation_scale(reader: PairReader, indices: NDArray[np.int64]) -> float:
    """Std of the crop-centred elevations over ``indices``, m."""
    total, count = 0.0, 0
    for first in range(0, len(indices), 256):
        z = reader.elevation(indices[first : first + 256]).double()
        z = z - z.mean(dim=(1, 2), keepdim=True)
        total, count = total + float((z * z).sum()), count + z.numel()
    return max((total / max(count, 1)) ** 0.5, 1e-3)
