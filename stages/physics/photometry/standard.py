"""Photometric normalisation: the factor that brings I/F from the angles of a pixel to one standard geometry.

factor = I/F of the model at the standard geometry / I/F of the model at the pixel's angles, as ISIS photomet, lronacpho and
lrowacphomap apply it. A factor of the model's I/F, such as an albedo, cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from schemas.errors import ConfigError
from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ReflectanceModel, masked_radiance_factor

SLACK = 1e-6  # deg


def standard_angles(incidence_deg: float, emission_deg: float, phase_deg: float) -> Angles:
    """The angles of a standard geometry. Raises ConfigError where no surface shows these three together."""
    if not (0 <= incidence_deg < 90 and 0 <= emission_deg < 90):
        raise ConfigError(
            f"`standard_deg`: expected incidence and emission in 0 .. 90 deg, found {incidence_deg:g} and {emission_deg:g}."
        )
    least, most = abs(incidence_deg - emission_deg), incidence_deg + emission_deg
    if not least - SLACK <= phase_deg <= most + SLACK:
        raise ConfigError(
            f"`standard_deg`: expected a phase of {least:g} .. {most:g} deg with incidence {incidence_deg:g} and emission "
            f"{emission_deg:g}, found {phase_deg:g}."
        )
    angles = (math.radians(v) for v in (incidence_deg, emission_deg, phase_deg))
    return Angles.from_angles(*(torch.tensor(v, dtype=torch.float64) for v in angles))


class NormalisingFactor(ReflectanceModel):
    """I/F of ``model`` at the standard angles over its I/F at the angles given; 0 where the latter is not above 0.

    It has the model's parameters, so that their errors pass through it as through a model. It is not registered.
    """

    def __init__(self, model: ReflectanceModel, standard: Angles) -> None:
        self.model, self.standard = model, standard
        self.name, self.parameters = f"normalising factor of {model.name}", model.parameters  # type: ignore[misc]

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        """The factor. parameters : by name, broadcasting with the angles (...,); returns (...,)"""
        here = self.model.radiance_factor(parameters, angles)
        there = masked_radiance_factor(self.model, parameters, self.standard).to(here.dtype)
        return torch.where(here > 0, there / here.clamp(min=1e-30), torch.zeros((), dtype=here.dtype))
