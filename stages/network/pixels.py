"""Single pixels of many images, and the one set of parameters of a reflectance model that fits them best."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.common.threads import one_thread
from stages.network.losses import Radiometry
from stages.pairs.reader import Batch, PairReader
from stages.physics.formation.chain import illuminate
from stages.physics.formation.geometry import Angles
from stages.physics.formation.radiometry import line_of_sums
from stages.physics.photometry import ReflectanceModel, masked_radiance_factor

MAXIMUM_PAIRS = 512  # enough for a handful of numbers
MAXIMUM_PIXELS = 30_000
BATCH = 32  # pairs
STEP = 1e-5  # of central differences, which in double precision are then exact to about 1e-9


def sample_batches(reader: PairReader, indices: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Batch]]:
    """(pairs, their batch) of evenly chosen pairs, at most about MAXIMUM_PAIRS of them.

    indices : (n,), of pairs
    """
    step = max(1, len(indices) // MAXIMUM_PAIRS)
    chosen = indices[::step]
    for first in range(0, len(chosen), BATCH):
        yield chosen[first : first + BATCH], reader.batch(chosen[first : first + BATCH])


@dataclass(frozen=True)
class Pixels:
    """Valid pixels of many images, (N,) float64 each: cosines, the share of the Sun that lights them, and I/F.

    extra : (N, ...) float64, further fields of the caller's; pair, frame : (N,) int64, of which pair and image
    """

    angles: Angles
    light: Tensor
    image: Tensor
    extra: tuple[Tensor, ...] = ()
    pair: Tensor | None = None
    frame: Tensor | None = None


def sample_pixels(
    reader: PairReader,
    indices: NDArray[np.int64],
    radiometry: Radiometry,
    extra: Callable[[Batch], Sequence[Tensor]] = lambda batch: (),
) -> Pixels:
    """Valid pixels on a regular lattice over every crop, about MAXIMUM_PIXELS, with images in I/F by their radiometry.

    extra : gives further fields of a batch, (B, ..., H, W) each
    """
    crops = min(len(indices), MAXIMUM_PAIRS)
    step = max(1, math.ceil(math.sqrt(crops * reader.size[0] * reader.size[1] / MAXIMUM_PIXELS)))
    part = np.s_[..., step // 2 :: step, step // 2 :: step]
    gain, offset = (value().detach().cpu() for value in (radiometry.gain, radiometry.offset))
    found: list[list[Tensor]] = []
    for pairs, batch in sample_batches(reader, indices):
        frame, state = batch.observation.frame, illuminate(batch.observation)
        assert frame is not None
        angles, image = state.angles, (batch.image - offset[frame, None, None]) / gain[frame, None, None]
        light = torch.ones_like(image) if state.sun_visibility is None else state.sun_visibility
        pair = torch.from_numpy(pairs)[:, None, None].expand(image.shape)
        fields = (pair, angles.cos_incidence, angles.cos_emission, angles.cos_phase, light, image, *extra(batch))
        valid = batch.valid[part]
        found.append([field[part].movedim((-2, -1), (1, 2))[valid].double() for field in fields])
    pair, mu0, mu, phase, light, image, *rest = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Pixels(Angles(mu0, mu, phase), light, image, tuple(rest), pair.long())


@one_thread()  # thousands of small operations, whose sums must not depend on the number of threads
def fit_pixels(
    model: ReflectanceModel,
    pixels: Pixels,
    free: Sequence[str] = (),
    calibrated: bool = True,
    rounds: int = 40,
) -> Tensor:
    """One set of parameters (C,) within the model's bounds, by Levenberg-Marquardt from its defaults.

    A parameter that the pixels do not determine stays at its default: to leave it costs a millionth of the images'
    power per unit of the unbounded parameter. That also holds the fit where the misfit is flat, and rounding would
    choose the place.

    free : the parameters that may leave their defaults; all where empty
    calibrated : False where images have unknown gains and offsets: the best of each of ``pixels.frame`` are taken in
        every round
    """
    frame = None if calibrated else pixels.frame
    names = [p.name for p in model.parameters]
    free = free or names
    default = {p.name: torch.tensor(p.default, dtype=torch.float64) for p in model.parameters}

    def values(raw: Tensor) -> dict[str, Tensor]:
        return default | dict(zip(free, model.constrain(raw, 0, free), strict=True))

    def render(raw: Tensor) -> Tensor:
        return masked_radiance_factor(model, values(raw), pixels.angles) * pixels.light

    home = model.unconstrain(torch.stack([default[name] for name in free]), 0, free).clamp(-8, 8)
    tie = 1e-6 * pixels.image.square().sum()
    raw, damping = home, 1e-3
    gain, error = _residual(render(raw), pixels.image, frame)
    loss = error.square().sum()
    for _ in range(rounds):
        # products and sums instead of BLAS, whose sums depend on where arrays lie in memory
        columns = _slopes(render, raw) * gain
        normal = torch.stack([(columns * c).sum(dim=1) for c in columns]) + tie * torch.eye(len(raw))
        slope = (columns * error).sum(dim=1) - tie * (raw - home)
        gained = 0.0
        for _ in range(8):
            step = torch.linalg.solve(normal + damping * torch.diag(normal.diagonal()), slope)
            moved = (raw + step).clamp(-12, 12)
            gain_there, error_there = _residual(render(moved), pixels.image, frame)
            loss_there = error_there.square().sum() + tie * (moved - home).square().sum()
            if loss_there < loss:
                gained = float((loss - loss_there) / loss)
                raw, gain, error, loss, damping = moved, gain_there, error_there, loss_there, damping / 5
                break
            damping *= 5
        if gained < 1e-7:
            break
    return torch.stack([values(raw)[name] for name in names]).float()


def design_columns(model: ReflectanceModel, pixels: Pixels) -> Tensor:
    """(C, N) float64: what each coefficient of a linear model gives where it is 1 and the others 0."""
    units = torch.eye(len(model.parameters), dtype=torch.float64)
    return torch.stack(
        [masked_radiance_factor(model, model.unpack(unit, 0), pixels.angles) * pixels.light for unit in units]
    )


def _residual(rendered: Tensor, image: Tensor, frame: Tensor | None) -> tuple[Tensor, Tensor]:
    """(the gain of each pixel's image, or 1; what is left), with the best gain and offset of each image where unknown."""
    if frame is None:
        return torch.ones(()), image - rendered
    sums = (torch.bincount(frame, of) for of in (rendered, image, rendered * rendered, rendered * image))
    gain, offset = (of_frame[frame] for of_frame in line_of_sums(torch.bincount(frame).double(), *sums))
    return gain, image - gain * rendered - offset


def _slopes(render: Callable[[Tensor], Tensor], raw: Tensor) -> Tensor:
    """(C, N) by central differences."""
    shifts = STEP * torch.eye(len(raw), dtype=raw.dtype)
    return torch.stack([(render(raw + shift) - render(raw - shift)) / (2 * STEP) for shift in shifts])
