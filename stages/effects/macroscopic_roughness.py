"""Slopes below the resolution of the DEM."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter
from stages.physics.photometry.roughness import roughness_factor


@register
class MacroscopicRoughness(Effect):
    name = "macroscopic_roughness"
    slot = "reflectance"
    of_law = True
    title = "roughness below the DEM's resolution"
    mechanism = (
        "Unresolved slopes shadow and tilt: at low Sun the surface is darker than a smooth one. Hapke's shadowing function and "
        "effective cosines for a mean slope theta-bar, relative to a smooth Lommel-Seeliger surface."
    )
    reference = "Hapke (1984), Icarus 59, 41; lunar values: Sato et al. (2014), JGR 119, 1775"
    confused_with = ("limb_darkening", "phase_slope", "sun_elevation")
    separate = "images of the same ground at incidence 30 and 80 deg, one of them oblique"
    parameters = (Parameter("theta_bar_deg", "degree", 0.0, 45.0, 0.0, "mean slope angle"),)
    strong: ClassVar = {"theta_bar_deg": 20.0}
    tolerance: ClassVar = {"theta_bar_deg": 4.0}  # relief of a degree or two lies below any DEM

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"theta_bar_deg": t},)) for t in (5.0, 9.0, 13.0, 17.0, 22.0, 28.0)]

    def __init__(self, values: Mapping[str, Any] | None = None, survey: Survey | None = None) -> None:
        super().__init__(values, survey)
        self._known: dict[int, tuple[Any, Any]] = {}  # by thread: angles, and what they gave

    def apply(self, state: State) -> None:
        if torch.is_grad_enabled():
            ratio = self._ratio(state)
        else:  # `diagnose` renders the same angles many times over, and this is the dearest part of it
            angles, ratio = self._known.get(threading.get_ident(), (None, None))
            if angles is not state.angles:
                ratio = self._ratio(state)
                self._known[threading.get_ident()] = (state.angles, ratio)
        state.reflectance = state.reflectance * ratio

    def _ratio(self, state: State) -> Tensor:
        """Rough over smooth reflectance, (B, H, W); 1 where the Sun or the camera is below the facet."""
        return roughness_factor(state.angles, torch.deg2rad(self.value("theta_bar_deg", state)))
