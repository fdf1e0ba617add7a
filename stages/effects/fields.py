"""Terrain fields that albedo may follow, and low-order cosine fields, which are read off what images show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from stages.effects.filters import filtered, gaussian, laplacian
from stages.physics.formation import geometry
from stages.physics.formation.chain import Observation

CURVATURE_SIGMA2 = 4.0  # px^2: curvature of the raw DEM is mostly its noise
# px, wavelengths between which waves of the DEM count more and more: of finer ones few are those of the ground
FINEST = 7.0, 10.0
BROAD_ORDERS = tuple((m, n) for m in range(4) for n in range(4) if 0 < m + n <= 4)
# orders both ways of ordinary texture: a broad field that does not end as cosines do leaks along the axes only
FINE = 4, 16
STEEPEST = 3.0  # spectra of ground fall as k^-3 where units of it meet at sharp borders (Porod 1951), and less steeply elsewhere


def slope(elevation: Tensor, gsd: float) -> Tensor:
    """Tangent of the slope; elevation : (B, H, W), m."""
    east, north = geometry.slopes(elevation, gsd)
    return torch.sqrt(east * east + north * north + 1e-12)


def curvature(elevation: Tensor, gsd: float) -> Tensor:
    """Laplacian of the height after a blur of 2 px, 1/m.

    elevation : (B, H, W), m; returns (B, H, W)
    """
    level = elevation - elevation.mean(dim=(-2, -1), keepdim=True)
    return laplacian(gaussian(level, CURVATURE_SIGMA2), gsd)


def broad(field: Tensor) -> Tensor:
    """A field (B, H, W) that follows from the DEM, without the waves that few DEMs resolve."""
    last, first = (2 * math.pi / wavelength for wavelength in FINEST)
    return filtered(field, lambda waves: ((last - waves) / (last - first)).clamp(0, 1), slopes=True)


def cosine_field(order: tuple[int, int], height: int, width: int) -> Tensor:
    """cos(pi m y) cos(pi n x) over the crop with unit rms; order = (m, n)."""
    y = (torch.arange(height, dtype=torch.float32) + 0.5) / height
    x = (torch.arange(width, dtype=torch.float32) + 0.5) / width
    norm = math.sqrt(2.0) ** ((order[0] > 0) + (order[1] > 0))
    return norm * torch.cos(math.pi * order[0] * y)[:, None] * torch.cos(math.pi * order[1] * x)


def broad_field(amounts: Sequence[Tensor], height: int, width: int) -> Tensor:
    """The sum of the broad cosines with these amounts, in the order of ``BROAD_ORDERS``, each broadcasting to the crop."""
    return sum(
        (a * cosine_field(o, height, width) for a, o in zip(amounts, BROAD_ORDERS, strict=True)), torch.zeros(())
    )


def read_cosines(field: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Broad cosines in fields, (B, orders), by least squares beside a level; their sum of squares, and what a spectrum as steep as that of ground

    would have of them, going by finer ones, both (B,). field, seen : (B, H, W) values, and 1 where they are known
    """
    low, fine, window, ordinary = _broad_and_fine(*field.shape[-2:])
    known = seen.double().flatten(1)
    x = field.double().flatten(1) * known
    gram = torch.einsum("kp,bp,lp->bkl", low, known, low) + 1e-6 * torch.eye(len(low)) * len(low.T)
    amounts = torch.linalg.solve(gram, x @ low.T)  # (B, 1 + orders): the level is each field's own
    # through a window, or the ends of a broad wave would have finer ones
    rest = (x - amounts @ low * known) * window @ fine.T / len(low.T)
    share = (known * window.square()).mean(1).clamp(min=1e-9)
    return amounts[:, 1:], amounts[:, 1:].square().sum(1), ordinary * (rest.square() / share[:, None]).sum(1)


@lru_cache(maxsize=4)
def _broad_and_fine(height: int, width: int) -> tuple[Tensor, Tensor, Tensor, float]:
    """(1 + orders, H W) level and broad cosines; (F, H W) fine ones, each over its own power in a spectrum of the steepest slope; (H W) the window

    that these are read through; and by which their sum of squares is multiplied to give the broad ones'.
    """
    fine = [(m, n) for m in range(*FINE) for n in range(*FINE) if m < height // 2 and n < width // 2]

    def stacked(orders: list[tuple[int, int]]) -> Tensor:
        return torch.stack([cosine_field(o, height, width) for o in orders]).double().flatten(1)

    steep = torch.tensor([math.hypot(*o) ** (STEEPEST / 2) for o in fine], dtype=torch.float64)
    broad = sum(math.hypot(*o) ** -STEEPEST for o in BROAD_ORDERS)
    down, across = (torch.hann_window(n, periodic=False, dtype=torch.float64) for n in (height, width))
    window = (down[:, None] * across).flatten()
    return stacked([(0, 0), *BROAD_ORDERS]), stacked(fine) * steep[:, None], window, broad / max(len(fine), 1)


def detector_axes(sample: Tensor | None, line: Tensor | None, batch: int) -> tuple[Tensor, Tensor]:
    """Crop pixels (columns, rows) per detector sample and per detector line, each (B, 2); the crop's own without them."""
    identity = torch.eye(2)
    if sample is None or line is None:
        return identity[0].expand(batch, 2), identity[1].expand(batch, 2)
    # d(sample, line) / d(column, row)
    steps = [torch.stack([_mean_step(x, -1), _mean_step(x, -2)], -1) for x in (sample, line)]
    jacobian = torch.stack(steps, -2)
    determinant = torch.linalg.det(jacobian)
    safe = torch.where((determinant.abs() > 1e-6)[:, None, None], jacobian, identity.to(jacobian))
    inverse = torch.linalg.inv(safe)
    return inverse[:, :, 0], inverse[:, :, 1]


def kept_axes(observation: Observation, batch: int) -> tuple[Tensor, Tensor]:
    """:func:`detector_axes` of an observation, kept: the same one is asked again for every trial."""
    sample = observation.detector_sample
    if sample is None:
        return detector_axes(None, None, batch)
    if sample not in _known:
        _known[sample] = detector_axes(sample, observation.detector_line, batch)
    return _known[sample]


_known = WeakTensorKeyDictionary()


def _mean_step(field: Tensor, dim: int) -> Tensor:
    step = torch.diff(field, dim=dim)
    good = torch.isfinite(step)
    return torch.where(good, step, 0.0).sum((-2, -1)) / good.sum((-2, -1)).clamp(min=1)
