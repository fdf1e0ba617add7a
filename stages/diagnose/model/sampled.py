"""A curved model's coefficients from a sample of lit pixels: from there few rounds over whole images are left to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from stages.diagnose.model.chain import Chain
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import ReflectanceModel

SAMPLES = 8_000
MOST_SAMPLES, FEWEST_SAMPLES = 400, 30  # of an image
SOFT = 0.05  # relative residual, beyond which a pixel counts less at first
OUTLIER = 5.0  # robust deviations of an image's residuals
EVALUATIONS = 40


def sampled_fit(
    model: ReflectanceModel,
    vector: Tensor,
    free: Tensor,
    chains: Sequence[Chain],
    masks: Sequence[Tensor],
    images: Sequence[Tensor],
    scaled: bool,
    pull: float,
) -> Tensor:
    """The (C,) coefficients with the least squared relative residual, by a trust region within their bounds (Branch et al. 1999).

    What effects make of the reflectance is taken as the factor that it is at ``vector``.

    images : (n, H, W) per site, as measured; scaled : each has a gain and an offset of its own
    pull : weight of the published coefficients, as a share of the cost at a quarter of their range from them
    """
    cosines, factor, measured = draw(chains, masks, images)
    if not len(measured):
        return vector
    level = measured.std(1, keepdims=True) if scaled else measured.mean(1, keepdims=True)
    level = np.maximum(np.abs(level), 1e-9)
    angles = Angles(*cosines.unbind(0))
    places = torch.nonzero(free)[:, 0].numpy()
    every = [model.parameters[k] for k in places]
    low, high = np.array([p.lower for p in every]), np.array([p.upper for p in every])
    width, published = (high - low) / 4, np.array([p.default for p in every])
    base = vector.double().numpy().copy()

    def residual(x: NDArray[Any]) -> NDArray[Any]:
        whole = base.copy()
        whole[places] = x
        coefficients = torch.from_numpy(whole)[None, :, None]
        predicted = (model.radiance_factor(model.unpack(coefficients, dim=1), angles) * factor).numpy()
        if scaled:
            predicted = _stretched(predicted, measured)
        return (measured - predicted) / level

    start = np.clip(base[places], low + 1e-3 * (high - low), high - 1e-3 * (high - low))
    options: dict[str, Any] = {"bounds": (low, high), "x_scale": width, "max_nfev": EVALUATIONS}
    first = least_squares(lambda x: residual(x).ravel(), start, loss="soft_l1", f_scale=SOFT, ftol=1e-2, **options)
    left = residual(first.x)
    middle = np.median(left, 1, keepdims=True)
    near = np.abs(left - middle) < OUTLIER * 1.4826 * np.median(np.abs(left - middle), 1, keepdims=True) + 1e-9

    def pulled(x: NDArray[Any]) -> NDArray[Any]:
        r = residual(x)[near]
        away = (x - published) / width
        return np.concatenate([r, away * np.sqrt(pull * np.mean(r * r) * r.size / len(x))])

    inside = np.clip(first.x, low + 1e-3 * (high - low), high - 1e-3 * (high - low))
    base[places] = least_squares(pulled, inside, ftol=1e-4, **options).x
    return torch.from_numpy(base).float()


def draw(
    chains: Sequence[Chain], masks: Sequence[Tensor], images: Sequence[Tensor]
) -> tuple[Tensor, Tensor, NDArray[np.float64]]:
    """Of every image as many lit pixels, evenly spread: cosines (3, I, S), factor and measured value (I, S)."""
    total = sum(len(m) for m in masks)
    count = min(max(SAMPLES // max(total, 1), FEWEST_SAMPLES), MOST_SAMPLES)
    cosines, factors, values = [], [], []
    for chain, mask, image in zip(chains, masks, images, strict=True):
        angles, surface = chain.state.angles, chain.state.reflectance
        for k, used in enumerate(mask & (surface > 0) & (chain.rendered > 0)):
            lit = torch.nonzero(used.flatten())[:, 0]
            if len(lit) < FEWEST_SAMPLES:
                continue
            pick = lit[torch.linspace(0, len(lit) - 1, count).long()]
            cosines.append(
                torch.stack(
                    [c[k].flatten()[pick] for c in (angles.cos_incidence, angles.cos_emission, angles.cos_phase)]
                )
            )
            factors.append(chain.rendered[k].flatten()[pick] / surface[k].flatten()[pick])
            values.append(image[k].flatten()[pick])
    if not values:
        return torch.zeros(3, 0, 1), torch.zeros(0, 1), np.zeros((0, 1))
    return torch.stack(cosines, 1).double(), torch.stack(factors).double(), torch.stack(values).double().numpy()


def _stretched(predicted: NDArray[Any], measured: NDArray[Any]) -> NDArray[Any]:
    """The prediction under each image's best gain and offset."""
    mean, level = predicted.mean(1, keepdims=True), measured.mean(1, keepdims=True)
    varied = predicted - mean
    gain = (varied * (measured - level)).sum(1, keepdims=True) / np.maximum((varied**2).sum(1, keepdims=True), 1e-20)
    return gain * varied + level


__all__ = ["draw", "sampled_fit"]
