"""Terrain outside the DEM casts its shadow into it."""

from __future__ import annotations

import functools
from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.formation.geometry import crop_axes
from stages.physics.photometry import Parameter

SIDES = ("any", "north", "east", "south", "west")

TANGENTS = (0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2)
USUAL = 0.5  # crops from the border: where a wall is sought first,
NEAR, LOW = 0.1, (0.03, 0.045, 0.07)  # and near by; low ones, whose shadow does not reach far into the crop, only there
FINER = tuple(2.0 ** (k / 8) for k in range(-8, 9))  # times the height that was found first
# crops: beyond the last a ridge hides the Sun everywhere alike
DISTANCES = (NEAR, 0.17, 0.25, 0.35, USUAL, 0.7, 1.0, 1.4, 2.0, 2.8)
BEYOND = 1e9  # m: no ridge


@register
class DistantShadow(Effect):
    name = "distant_shadow"
    slot = "illumination"
    title = "shadow of terrain outside the DEM"
    mechanism = (
        "The horizon is computed from the DEM; a mountain beyond its edge still hides the Sun. Modelled as a straight ridge "
        "along a side of the crop (or along all sides), a given distance outside its border."
    )
    reference = "Mazarico et al. (2011), Icarus 211, 1066 (horizons of the lunar poles need far terrain)"
    confused_with = ("penumbra", "saturation")
    raises_horizon = True
    separate = "an image with the Sun below 10 deg of elevation on the same side"
    parameters = (Parameter("height_m", "m", 0.0, 20000.0, 0.0, "height of the ridge above the crop's mean height"),)
    coordinates = (
        *parameters,
        Parameter("distance_px", "px", 0.0, 4000.0, 1.0, "distance of the ridge from the crop's border"),
        Parameter("side", "1", 0.0, 4.0, 0.0, "0 any side, 1 north, 2 east, 3 south, 4 west"),
    )
    strong: ClassVar = {"height_m": 0.0}  # set by the trials: it depends on the Sun's elevation

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [cls.trial(survey, tangent, USUAL, side) for side in range(len(SIDES)) for tangent in TANGENTS]

    @classmethod
    def trial(cls, survey: Survey, tangent: float, distance: float, side: int) -> Trial:
        """A wall ``distance`` crops away that stands at this tangent of elevation above the crop's centre."""
        height = tangent * (distance + 0.5) * survey.crop_px * survey.gsd
        return Trial(({"height_m": height},), {"distance_px": distance * survey.crop_px, "side": float(side)})

    @classmethod
    def shadow_trials(cls, survey: Survey) -> list[Trial]:
        near = [
            cls.trial(survey, tangent, NEAR, side) for side in range(1, len(SIDES)) for tangent in (*LOW, *TANGENTS)
        ]
        return [*cls.trials(survey), *near]

    def shadow_neighbours(self, survey: Survey) -> list[Trial]:
        """A low wall that is near ends its shadow on the crop where a high one that is far does, but not under a Sun of another elevation."""
        side, far = int(self.values["side"]), float(self.values["distance_px"]) / survey.crop_px
        tangent = float(self.values["height_m"]) / ((far + 0.5) * survey.crop_px * survey.gsd)
        return [self.trial(survey, tangent * step, distance, side) for distance in DISTANCES for step in FINER]

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return "sun_horizon" in has

    def apply(self, state: State) -> None:
        if state.sun_horizon is None:
            return
        height = self.value("height_m", state)
        if not height > 0:
            return
        sun = state.sun_direction.to(state.elevation.dtype)
        level = torch.sqrt(sun[:, 0] ** 2 + sun[:, 1] ** 2).clamp(min=1e-6)
        distance = self._distance(sun[:, 0] / level, sun[:, 1] / level, state)
        behind = torch.nonzero(distance.flatten(1).amin(1) < BEYOND)[:, 0]  # images whose Sun stands over the ridge
        above = state.elevation - state.elevation.mean(dim=(-2, -1), keepdim=True)
        ridge = torch.atan2(height - above.expand(len(sun), -1, -1)[behind], distance[behind])
        horizon = state.sun_horizon.clone()
        horizon[behind] = torch.maximum(horizon[behind], ridge)
        state.sun_horizon = horizon

    def _distance(self, east: Tensor, north: Tensor, state: State) -> Tensor:
        """(n, H or 1, W or 1) m to the ridge in the direction of each image's Sun, `BEYOND` where it does not stand there. east, north : (n,)"""
        gsd, side = state.observation.gsd, int(self.values["side"])
        rows, columns = state.elevation.shape[-2:]
        x, y = crop_axes(rows, columns, gsd)
        far = self.value("distance_px", state) * gsd
        from_east, from_north = columns * gsd / 2 + far, rows * gsd / 2 + far
        axes = {
            "north": (north, from_north - y[:, None]),
            "east": (east, from_east - x),
            "south": (-north, from_north + y[:, None]),
            "west": (-east, from_east + x),
        }
        every = [
            torch.where(s[:, None, None] > 1e-3, away / s[:, None, None].clamp(min=1e-3), BEYOND)
            for name, (s, away) in axes.items()
            if SIDES[side] in ("any", name)
        ]
        return functools.reduce(torch.minimum, every)
