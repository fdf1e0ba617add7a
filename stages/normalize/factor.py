"""What an image shows of a window, brought to the standard geometry pixel by pixel, and what must be left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from stages.common.arrays import Floats32, Mask
from stages.normalize.config import Config
from stages.physics.formation.geometry import Angles
from stages.physics.images.angles import PLANES
from stages.physics.images.references import Seen
from stages.physics.maps.window import Box
from stages.physics.photometry import masked_radiance_factor
from stages.physics.photometry.deviation import radiance_deviation
from stages.physics.photometry.standard import NormalisingFactor, standard_angles
from stages.physics.terrain.surface import Surface

UNSEEN, GOOD, SHADOW, GRAZING = range(4)


@dataclass(frozen=True)
class Normaliser:
    """surface : terrain with its reflectance, on whose grid the images lie

    by_image : (C,) coefficients of each image's own wavelength; empty where the surface's hold for all
    """

    surface: Surface
    config: Config
    by_image: Sequence[NDArray[np.float32]] = ()

    @cached_property
    def _model(self) -> NormalisingFactor:
        return NormalisingFactor(self.surface.model, standard_angles(*self.config.standard_deg))

    def angles(self, seen: Seen) -> dict[str, Floats32]:
        """(h, w) degrees of incidence, emission and phase, by plane: the terrain's or the file's."""
        return seen.given if self.config.angles == "file" else {plane: seen.planes[plane] for plane in PLANES}

    def _radians(self, seen: Seen) -> Angles:
        given = self.angles(seen)
        return Angles.from_angles(*(torch.from_numpy(np.radians(given[plane])) for plane in PLANES))

    def _values(self, image: int, seen: Seen) -> dict[str, torch.Tensor]:
        own = self.by_image[image][:, None, None] if self.by_image else self.surface.read_coefficients(*seen.box)
        return self.surface.model.unpack(torch.from_numpy(np.ascontiguousarray(own)), dim=0)

    def predicted(self, image: int, seen: Seen) -> Floats32:
        """(h, w) I/F of the model in full sunlight, for the image of this number."""
        return masked_radiance_factor(self.surface.model, self._values(image, seen), self._radians(seen)).numpy()

    def mask(self, seen: Seen) -> NDArray[np.uint8]:
        """(h, w) UNSEEN, GOOD, SHADOW (or within two pixels of one) or GRAZING."""
        incidence, emission, phase = (self.angles(seen)[plane] for plane in PLANES)
        far = (incidence > self.config.max_incidence_deg) | (emission > self.config.max_emission_deg)
        found = np.full(seen.measured.shape, SHADOW, np.uint8)
        found[seen.usable] = GOOD
        found[far & (seen.planes["shadow"] == 0)] = GRAZING
        found[np.isnan(seen.measured) | np.isnan(incidence + emission + phase)] = UNSEEN
        return found

    def factor(self, image: int, seen: Seen, good: Mask) -> tuple[Floats32, Floats32]:
        """(h, w) factor to the standard geometry, NaN where not ``good``, and its relative standard deviation.

        The latter is that of the map's coefficients, 0 where none is known.
        """
        values, angles = self._values(image, seen), self._radians(seen)
        factor = masked_radiance_factor(self._model, values, angles).numpy()
        deviations = {k: torch.from_numpy(v) for k, v in self.surface.read_deviations(*seen.box).items()}
        spread = radiance_deviation(self._model, values, deviations, angles).numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            known = good & (factor > 0)
            return np.where(known, factor, np.nan), np.where(known, spread / factor, np.nan)


def placed(values: NDArray, own: Box, box: Box, around: float = np.nan) -> NDArray:
    """``values`` of the part ``own`` of a window, on the whole window, with ``around`` elsewhere. (..., h, w)"""
    whole = np.full((*values.shape[:-2], *box[2:]), around, values.dtype)
    top, left = own[0] - box[0], own[1] - box[1]
    whole[..., top : top + own[2], left : left + own[3]] = values
    return whole
