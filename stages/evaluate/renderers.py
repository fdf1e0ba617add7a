"""The compared models: each renders a batch of crops, brought to the images' scale in the same way."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from schemas.errors import ArtefactError
from stages.physics.formation.chain import Extension, Observation, State, expose, form, illuminate
from stages.physics.formation.radiometry import match_crops
from stages.physics.photometry import ReflectanceModel, get_model, masked_radiance_factor
from stages.physics.photometry.deviation import radiance_deviation


class Reader(Protocol):
    """What evaluate needs of a pairs file (``stages.pairs.reader.PairReader``)."""

    split: np.ndarray
    tile: np.ndarray
    site: np.ndarray
    frame: np.ndarray

    def observation(self, indices: np.ndarray) -> Observation:
        """Everything about these pairs but their images."""

    def image(self, indices: np.ndarray) -> Tensor:
        """(B, H, W) measured."""

    def valid(self, indices: np.ndarray) -> Tensor:
        """(B, H, W) bool."""


class Predictor(Protocol):
    """What evaluate needs of a checkpoint (``stages.network.predictor``)."""

    model: ReflectanceModel

    def coefficients(self, elevation: Tensor) -> Tensor:
        """(B, H, W) m -> (B, C, H, W)."""

    def coefficients_and_deviations(self, elevation: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """(B, H, W) m -> (B, C, H, W), and standard deviations (B, H, W) by name."""

    def parameters(self) -> Iterator[Tensor]:
        """Its weights; they tell the device."""


@dataclass
class Batch:
    """A batch of crops as measured.

    state : geometry and illumination, which all models without extensions share
    image : (B, H, W) float32, I/F or share of the full DN range; usable : (B, H, W) bool; frame : (B,)
    """

    observation: Observation
    state: State
    image: Tensor
    usable: Tensor
    frame: np.ndarray
    memo: dict[str, Any] = field(default_factory=dict)


def read_batch(reader: Reader, indices: np.ndarray, scale: float) -> Batch:
    """Crops ``indices`` in ascending order; a pixel is usable where image and photometric geometry are known."""
    observation = reader.observation(indices)
    image = torch.as_tensor(reader.image(indices)).to(torch.float32) / scale
    state = illuminate(observation)
    angles = state.angles
    known = torch.isfinite(image) & torch.isfinite(angles.cos_incidence) & torch.isfinite(angles.cos_emission)
    usable = torch.as_tensor(reader.valid(indices)).bool() & known
    return Batch(observation, state, image, usable, np.asarray(reader.frame)[np.asarray(indices)])


def batches(indices: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """The indices (n,) in parts of at most ``size``."""
    for start in range(0, len(indices), size):
        yield indices[start : start + size]


@dataclass
class Renderer:
    """One compared model, with gain and offset per frame (1 and 0 for calibrated images).

    coefficients : batch -> tensor that broadcasts to (B, C, H, W), in the order of ``model.parameters``
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

    def image(self, batch: Batch, how: str | None = None) -> Tensor:
        """The rendered crops on the scale of the images, matched per crop where ``how`` names a matching."""
        rendered = self.radiance_factor(batch)
        gain, offset = self._per_crop(self.gain, batch, 1.0), self._per_crop(self.offset, batch, 0.0)
        rendered = rendered * gain
        if how == "gain":  # a gain of the light: the sensor's offset stays out of it
            return match_crops(rendered, batch.image - offset, batch.usable, how) + offset
        rendered = rendered + offset
        return rendered if how is None else match_crops(rendered, batch.image, batch.usable, how)

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


def learned(predictor: Predictor) -> tuple[Callable[[Batch], Tensor], Callable[[Batch], Tensor] | None]:
    """The network's coefficients from the crop's elevation, and the spread of photographs that it predicts (``Renderer``).

    Computed once per batch; a checkpoint without deviations has no spread.
    """
    device = next((p.device for p in predictor.parameters()), torch.device("cpu"))
    noise = float(getattr(predictor, "image_noise", math.nan))
    key = f"coefficients of {id(predictor)}"

    def look(batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        if key not in batch.memo:
            elevation = batch.observation.elevation.to(device)
            with torch.no_grad():
                if math.isnan(noise):
                    coefficients, deviations = predictor.coefficients(elevation), dict[str, Tensor]()
                else:
                    coefficients, deviations = predictor.coefficients_and_deviations(elevation)
            batch.memo[key] = coefficients.float().cpu(), {k: v.float().cpu() for k, v in deviations.items()}
        return batch.memo[key]

    def spread(batch: Batch) -> Tensor:
        coefficients, deviations = look(batch)
        values = predictor.model.unpack(coefficients, dim=1)
        found = radiance_deviation(predictor.model, values, deviations, batch.state.angles)
        if batch.state.sun_visibility is not None:
            found = found * batch.state.sun_visibility
        return found.square().add(noise**2).sqrt()

    return lambda batch: look(batch)[0], None if math.isnan(noise) else spread


def published(name: str) -> tuple[ReflectanceModel, np.ndarray]:
    """A registered model and its default parameters."""
    model = get_model(name)
    return model, np.array([p.default for p in model.parameters])
