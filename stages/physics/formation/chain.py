"""Image formation: the ordered chain geometry -> illumination -> reflectance -> radiance -> sensor.

Every step is differentiable in the coefficients and, where the chain is smooth, in elevation, Sun and camera.
Extensions (``stages/effects``) act at the slot that they name; the order of the slots fixes their composition.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from stages.physics.formation import geometry
from stages.physics.formation.geometry import Angles
from stages.physics.formation.resampling import displace
from stages.physics.light.sun_disc import SUN_RADIUS, sun_visibility
from stages.physics.photometry import ReflectanceModel, lambert_albedo, masked_radiance_factor

SLOTS = ("geometry", "illumination", "reflectance", "radiance", "sensor")


@dataclass
class Observation:
    """A batch of crops: all that rendering needs besides the reflectance.

    elevation : (B, H, W) float32, m
    sun_direction : (B, 3), unit, ENU along the crop's axes
    camera_position : (B, 3), m from the crop's centre
    sun_horizon : (B, H, W), rad, or None where nothing casts shadows
    detector_sample, detector_line : (B, H, W), px, or None
    frame : (B,) int64, index of the source image, or None
    site : (B,) int64, number of the ground site, or None
    """

    elevation: Tensor
    sun_direction: Tensor
    camera_position: Tensor
    gsd: float
    body_radius: float
    sun_horizon: Tensor | None = None
    detector_sample: Tensor | None = None
    detector_line: Tensor | None = None
    frame: Tensor | None = None
    site: Tensor | None = None


@dataclass
class State:
    """Intermediate results of the chain. What an extension sees, and what it may change, depends on its slot:

    geometry      sees and may change: elevation, sun_horizon, camera_position, displacement (of the map projection: how far
                  away it took each pixel from, columns to the east and rows to the south, px, broadcastable to the image)
    illumination  sees also slopes, view; may change: sun_direction, sun_horizon, sun_radius, further_light (functions
                  of the state, run once the directly lit radiance is known; each adds to it)
    reflectance   sees also angles, sun_visibility; may change: reflectance (I/F of a lit facet)
    further_light sees also albedo(), that of a diffuse facet of this ground, broadcastable to the image: light that
                  comes from all sides does not ask where the camera stands
    radiance      may change: radiance (I/F that reaches the camera)
    sensor        may change: image; sees measured(), the image to be explained, (B, H, W) with NaN where invalid, as
                  further_light does, or None: an echo repeats the light that truly came in, with shadows in their true places;
                  law_fitted, whether the law is fitted to lit ground: light that falls there alike is a term of it
    """

    observation: Observation
    elevation: Tensor
    sun_direction: Tensor
    camera_position: Tensor
    sun_horizon: Tensor | None
    sun_radius: float | Tensor = SUN_RADIUS
    displacement: tuple[Tensor, Tensor] | None = None
    further_light: list[Callable[[State], None]] = field(default_factory=list)
    slopes: tuple[Tensor, Tensor] = field(default=None)  # type: ignore[assignment]
    view: tuple[Tensor, Tensor, Tensor] = field(default=None)  # type: ignore[assignment]
    angles: Angles = field(default=None)  # type: ignore[assignment]
    sun_visibility: Tensor | None = None
    reflectance: Tensor = field(default=None)  # type: ignore[assignment]
    albedo: Callable[[], Tensor] = field(default=None)  # type: ignore[assignment]
    radiance: Tensor = field(default=None)  # type: ignore[assignment]
    image: Tensor = field(default=None)  # type: ignore[assignment]
    measured: Callable[[], Tensor] | None = None
    law_fitted: bool = False


class Extension(Protocol):
    """A physical effect that extends the chain (``stages/effects``)."""

    @property
    def slot(self) -> str:
        """One of SLOTS."""

    def apply(self, state: State) -> None:
        """Change what the slot may change."""


def form(
    observation: Observation,
    model: ReflectanceModel,
    coefficients: Tensor | Mapping[str, Tensor],
    extensions: Sequence[Extension] = (),
) -> Tensor:
    """The image, in I/F, of a batch of crops.

    coefficients : (B, C, H, W) or anything that broadcasts to it, in the order of ``model.parameters``; or by name, each
        broadcasting to (B, H, W)
    returns (B, H, W)
    """
    state = illuminate(observation, extensions)
    parameters = model.unpack(coefficients, dim=1)
    state.reflectance = masked_radiance_factor(model, parameters, state.angles)
    state.albedo = lambda: lambert_albedo(model, parameters)
    return expose(state, extensions)


def illuminate(observation: Observation, extensions: Sequence[Extension] = (), known: State | None = None) -> State:
    """The first half of the chain, which no coefficient enters: slopes, angles and the visible share of the Sun.

    known : a state of the same observation, whose slopes and angles are reused where the extensions do not change them
    """
    state = State(
        observation,
        observation.elevation,
        observation.sun_direction,
        observation.camera_position,
        observation.sun_horizon,
    )
    _apply(state, extensions, "geometry")
    gsd, radius = observation.gsd, observation.body_radius
    ground = known
    if known is not None and state.elevation is known.elevation and state.camera_position is known.camera_position:
        state.slopes, state.view = known.slopes, known.view
    else:
        ground = None
        state.slopes = geometry.curvature_slopes(*geometry.slopes(state.elevation, gsd), gsd, radius)
        state.view = geometry.view_vectors(state.elevation, state.camera_position, gsd)
    _apply(state, extensions, "illumination")
    if ground is not None and state.sun_direction is ground.sun_direction:
        state.angles = ground.angles
    else:
        state.angles = geometry.photometric_angles(*state.slopes, state.sun_direction, state.view)
    if state.sun_horizon is not None:
        sun_elevation = torch.asin(state.sun_direction[:, 2].clamp(-1, 1)).to(state.elevation.dtype)
        state.sun_visibility = sun_visibility(sun_elevation[:, None, None], state.sun_horizon, state.sun_radius)
    return state


def expose(state: State, extensions: Sequence[Extension] = ()) -> Tensor:
    """The second half of the chain: from the I/F of lit facets to the image."""
    _apply(state, extensions, "reflectance")
    lit = state.sun_visibility
    state.radiance = state.reflectance if lit is None else state.reflectance * lit
    for add_light in state.further_light:
        add_light(state)
    _apply(state, extensions, "radiance")
    state.image = state.radiance if state.displacement is None else displace(state.radiance, *state.displacement)
    _apply(state, extensions, "sensor")
    return state.image


def _apply(state: State, extensions: Sequence[Extension], slot: str) -> None:
    for extension in extensions:
        if extension.slot == slot:
            extension.apply(state)
