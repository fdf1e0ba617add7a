"""Standard deviations of coefficient maps, from the residuals of the images.

A residual is taken for the sum of independent errors: of each map, by its effect on the pixel, and of the image itself,

    var(measured - rendered) = sum over maps of (dI/dc sigma_c)^2 + noise^2,

where ln sigma_c is linear in the trained network's last features (Gaussian likelihood, the maps held fixed: a last layer
fitted afterwards costs the maps nothing). Most of these errors come from what terrain does not show, which neighbouring
pixels share: the deviations are those of single pixels, and means over many pixels are hardly better known. One factor
for all is then chosen on validation ground, which the maps never saw, such that 95 % of the pixels of a ground tile lie
within 1.96 standard deviations when the factor is chosen on the other tiles.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.common.intervals import unseen_quantile
from stages.network.normalisation import scale_elevation
from stages.network.pixels import Pixels, sample_pixels
from stages.network.predictor import Predictor
from stages.pairs.reader import Batch
from stages.physics.formation.chain import form
from stages.physics.photometry.deviation import sensitivity
from stages.train.training import Training

STEP = 1e-4  # of a parameter's range, for its effect on the image
RIDGE = 1e-3  # on the features' weights: deviations of ground unlike any other stay near the mean
WIDTH_95 = 1.959964  # standard deviations within which a Gaussian has 95 %
ROUNDS = 60


def fit_deviations(training: Training, train: NDArray[np.int64], validation: NDArray[np.int64]) -> None:
    """Write the last layer of the deviations, and ``image_noise``, into the trained predictor.

    train, validation : (n,), indices of pairs
    """
    predictor = training.predictor.eval()
    residual, effects, features, tile = _residuals(training, train)
    middle, spread = features.mean(dim=0), features.std(dim=0).clamp(min=1e-6)
    weights, constants, noise = _likelihood(residual, effects, (features - middle) / spread)
    if len(validation):
        residual, effects, features, tile = _residuals(training, validation)
    deviation = _variance(effects, (features - middle) / spread, weights, constants, noise).sqrt()
    factor = unseen_quantile((residual / deviation).abs().numpy(), tile, 0.95) / WIDTH_95
    maps, head = predictor.maps, predictor.net.head
    count = len(maps.maps)
    with torch.no_grad():
        assert head.bias is not None
        head.weight[count:, :, 0, 0] = (weights / spread / maps.output_scale).to(head.weight)
        head.bias[count:] = 0
        shift = constants - (weights * middle / spread).sum(dim=1) + math.log(factor)
        maps.start[count:] = shift.to(maps.start)
    predictor.image_noise = float(noise.exp() * factor)


@torch.no_grad()
def _residuals(training: Training, indices: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor, NDArray[np.int64]]:
    """Of some pixels: residuals (N,), I/F; effects of the maps on them (N, M), I/F per unit; the last features (N, F);
    ground tiles (N,).
    """
    predictor, maps, model = training.predictor, training.predictor.maps, training.predictor.model
    device = maps.start.device

    def predict(batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        x = scale_elevation(batch.observation.elevation.to(device), predictor.elevation_scale)
        features = predictor.net.features(x)
        coefficients = maps.stack(maps.unbounded(predictor.net.head(features)), dim=1).cpu()
        return features.float().cpu(), coefficients, form(batch.observation, model, coefficients, training.extensions)

    pixels = sample_pixels(training.reader, indices, training.radiometry, predict)
    features, coefficients, rendered = pixels.extra
    assert pixels.pair is not None
    tile = training.reader.tile[pixels.pair.numpy()]
    return pixels.image - rendered, _effects(predictor, pixels, coefficients), features, tile


def _effects(predictor: Predictor, pixels: Pixels, coefficients: Tensor) -> Tensor:
    """dI/dc of the maps, (N, M), by central differences within their bounds. coefficients : (N, C)"""
    model = predictor.model
    values = model.unpack(coefficients, dim=1)
    sizes = {p.name: STEP * (p.upper - p.lower) for p in model.parameters}
    found = [sensitivity(model, values, name, sizes[name], pixels.angles) for name in predictor.maps.maps]
    return torch.stack(found, dim=1) * pixels.light[:, None]


def _variance(effects: Tensor, features: Tensor, weights: Tensor, constants: Tensor, noise: Tensor) -> Tensor:
    # products and sums instead of BLAS, whose sums depend on where arrays lie in memory
    logarithm = (features[:, None] * weights).sum(dim=2) + constants
    return (effects * logarithm.exp()).square().sum(dim=1) + (2 * noise).exp()


def _likelihood(residual: Tensor, effects: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (M, F), constants (M,) and ln noise () of the largest likelihood."""
    rms = residual.square().mean().sqrt().clamp(min=1e-9)
    share = effects.square().mean(dim=0).sqrt().clamp(min=1e-9)
    weights = torch.zeros(effects.shape[1], features.shape[1], dtype=torch.float64, requires_grad=True)
    # At first every map explains as much.
    constants = (rms / share / effects.shape[1] ** 0.5).log().requires_grad_()
    noise = (0.3 * rms).log().requires_grad_()
    found = [weights, constants, noise]
    optimizer = torch.optim.LBFGS(found, max_iter=ROUNDS, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        variance = _variance(effects, features, *found)
        value = (variance.log() + residual.square() / variance).mean() / 2
        value = value + RIDGE * (weights.square().sum() + (constants - start).square().sum() * 0.1)
        value.backward()
        return value

    start = constants.detach().clone()
    optimizer.step(loss)  # type: ignore[arg-type]
    return weights.detach(), constants.detach(), noise.detach()
