"""The compared models: each renders a batch of crops, brought to the images' scale in the same way."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from schemas.errors import ArtefactError
from stages.network.predictor import Predictor
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Extension, Observation, State, expose, form, illuminate
from stages.physics.formation.radiometry import match_crops
from stages.physics.photometry import ReflectanceModel, masked_radiance_factor
from stages.physics.photometry.deviation import radiance_deviation


@dataclass
class Batch:
    """A batch of crops as measured.

    state : geometry and illumination, which all models without extensions share
    image : (B, H, W) float32, I/F or share of the full DN range; usable : (B, H, W) bool
    frame : (B,) index of the image that each crop is cut from; memo : results that several rows of the table share
    """

    observation: Observation
    state: State
    image: Tensor
    usable: Tensor
    frame: np.ndarray
    memo: dict[str, Any] = field(default_factory=dict)


def read_batch(reader: PairReader, indices: np.ndarray, scale: float) -> Batch:
    """Crops ``indices`` in ascending order; a pixel is usable where image and photometric geometry are known."""
    observation = reader.observation(indices)
    image = reader.image(indices).to(torch.float32) / scale
    state = illuminate(observation)
    angles = state.angles
    known = torch.isfinite(image) & torch.isfinite(angles.cos_incidence) & torch.isfinite(angles.cos_emission)
    return Batch(observation, state, image, reader.valid(indices) & known, reader.frame[indices])


def batches(indices: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """The indices (n,) in parts of at most ``size``."""
    for start in range(0, len(indices), size):
        yield indices[start : start + size]


@dataclass
class Renderer:
    """One compared model.

    coefficients : batch -> tensor that broadcasts to (B, C, H, W), in the order of ``model.parameters``
    scale : factor on the I/F, 1 where no albedo is fitted
    gain, offset : (F,) of every image in DN; None: 1 and 0
    spread : batch -> standard deviation of a photograph's pixel about the rendering, (B, H, W) I/F; None where not known
    """

    name: str
    model: ReflectanceModel
    coefficients: Callable[[Batch], Tensor]
    extensions: tuple[Extension, ...] = ()
    scale: float = 1.0
    gain: np.ndarray | None = None
    offset: np.ndarray | None = None
    spread: Callable[[Batch], Tensor] | None = None

    def deviation(self, batch: Batch) -> Tensor | None:
        """``spread`` on the scale of the images; None where not known."""
        if self.spread is None:
            return None
        return self.spread(batch) * self.scale * self._per_crop(self.gain, batch, 1.0).abs()

    def radiance_factor(self, batch: Batch) -> Tensor:
        """I/F, (B, H, W), 0 on pixels that are not usable."""
        if self.name in batch.memo:
            return batch.memo[self.name]
        coefficients = self.coefficients(batch)
        if self.extensions:
            rendered = form(batch.observation, self.model, coefficients, self.extensions)
        else:
            rendered = shade(batch.state, self.model, coefficients)
        rendered = rendered * self.scale
        rendered = torch.where(batch.usable, rendered, torch.zeros((), dtype=rendered.dtype))
        if not torch.isfinite(rendered).all():
            raise ArtefactError(
                f"model '{self.name}': expected finite I/F on every valid pixel, found NaN or infinity; "
                "the coefficients of the checkpoint are damaged, train again."
            )
        batch.memo[self.name] = rendered
        return rendered

    def image(self, batch: Batch, matching: str | None = None) -> Tensor:
        """The rendered crops (B, H, W) on the scale of the images, each brought near the measured one by ``matching``.

        matching : 'gain', 'gain_offset' or 'minmax' as in ``match_crops``; None: as rendered
        """
        rendered = self.radiance_factor(batch)
        gain, offset = self._per_crop(self.gain, batch, 1.0), self._per_crop(self.offset, batch, 0.0)
        rendered = rendered * gain
        if matching == "gain":  # a gain of the light: the sensor's offset stays out of it
            return match_crops(rendered, batch.image - offset, batch.usable, matching) + offset
        rendered = rendered + offset
        return rendered if matching is None else match_crops(rendered, batch.image, batch.usable, matching)

    @staticmethod
    def _per_crop(values: np.ndarray | None, batch: Batch, default: float) -> Tensor:
        if values is None:
            return torch.full((len(batch.frame), 1, 1), default)
        return torch.as_tensor(values[batch.frame], dtype=torch.float32)[:, None, None]


def shade(state: State, model: ReflectanceModel, coefficients: Tensor) -> Tensor:
    """What ``formation.form`` gives without extensions, from geometry that is known already."""
    reflectance = masked_radiance_factor(model, model.unpack(coefficients, dim=1), state.angles)
    return expose(replace(state, reflectance=reflectance))


def unit_images(model: ReflectanceModel, batch: Batch) -> Tensor:
    """The image of every unit coefficient of a linear model, (B, C, H, W): their weighted sum is the rendering."""
    images = []
    for k in range(len(model.parameters)):
        unit = torch.zeros(1, len(model.parameters), 1, 1)
        unit[0, k] = 1
        images.append(torch.where(batch.usable, shade(batch.state, model, unit), torch.zeros(())))
    return torch.stack(images, dim=1)


@dataclass(frozen=True)
class Constant:
    """The same coefficients (C,) everywhere."""

    values: np.ndarray

    def __call__(self, batch: Batch) -> Tensor:
        """The values, for every pixel alike."""
        return torch.as_tensor(self.values, dtype=torch.float32)[None, :, None, None]


def predict(predictor: Predictor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """The network's coefficients (B, C, H, W) from the crops' elevation, and their standard deviations (B, H, W) by name.

    Computed once per batch; a checkpoint without deviations gives none.
    """
    key = f"coefficients of {id(predictor)}"
    if key not in batch.memo:
        device = next((p.device for p in predictor.parameters()), torch.device("cpu"))
        elevation = batch.observation.elevation.to(device)
        deviations: dict[str, Tensor] = {}
        with torch.no_grad():
            if math.isnan(predictor.image_noise):
                coefficients = predictor.coefficients(elevation)
            else:
                coefficients, deviations = predictor.coefficients_and_deviations(elevation)
        batch.memo[key] = coefficients.float().cpu(), {k: v.float().cpu() for k, v in deviations.items()}
    return batch.memo[key]


def predict_spread(predictor: Predictor, batch: Batch) -> Tensor:
    """Standard deviation of photographs about the rendering, (B, H, W) I/F: ``Renderer.spread``."""
    coefficients, deviations = predict(predictor, batch)
    values = predictor.model.unpack(coefficients, dim=1)
    std = radiance_deviation(predictor.model, values, deviations, batch.state.angles)
    if batch.state.sun_visibility is not None:
        std = std * batch.state.sun_visibility
    return std.square().add(predictor.image_noise**2).sqrt()
