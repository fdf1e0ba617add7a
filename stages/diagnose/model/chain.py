"""The forward model of one site, rendered again and again with small changes: what does not change is kept."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from torch import Tensor

from stages.diagnose.data.sites import Site
from stages.diagnose.model.laws import Departures
from stages.diagnose.model.relief import ShareOfRelief, SharpSlopes
from stages.diagnose.settings import BROAD
from stages.effects import Effect
from stages.effects.filters import fine, gradients
from stages.physics.formation import chain as formation
from stages.physics.formation import geometry
from stages.physics.formation.chain import State
from stages.physics.photometry import ReflectanceModel, lambert_albedo, masked_radiance_factor

STEP = 0.02  # of a slope, as tangent
SCATTER = 0.14  # 8 deg: rms slope of relief below a typical DEM's resolution


class Chain:
    """Renders a site with the effects named so far (``base``) plus one more.

    coefficients : broadcastable to (n, C, H, W); free : those that may move, None for all
    laws, amounts : directions in which the law may be another one, and how much of each is rendered, (K,)
    known : a chain of this site, whose angles and reflectance are taken over where they are the same
    """

    def __init__(
        self,
        site: Site,
        model: ReflectanceModel,
        coefficients: Tensor,
        base: Sequence[Effect],
        free: Tensor | None = None,
        laws: Departures | None = None,
        amounts: Tensor | None = None,
        known: Chain | None = None,
    ) -> None:
        self.site, self.model, self.coefficients, self.base = site, model, coefficients, list(base)
        self.free, self.laws = free, laws
        self.amounts = amounts if laws is not None and amounts is not None and bool(amounts.any()) else None
        sharp = known._sharp if known else SharpSlopes(site.observation.gsd, site.observation.body_radius)
        self._sharp: SharpSlopes = sharp
        self._state: State = self._illuminate(self.base, known._state if known else None)
        self._tilted: dict[tuple[float, float], Tensor] = {}  # (n, H, W) reflectance at other slopes, by how much
        self._parts: Tensor | None = None  # of the laws' directions at these angles
        here = known is not None and self._state.angles is known._state.angles
        alike = known is not None and known.model is model and torch.equal(known.coefficients, coefficients)
        if known is not None and here and known.laws is laws:
            self._parts = known._parts
            alike &= (known.amounts is None) == (self.amounts is None)
            if alike and known.amounts is not None and self.amounts is not None:
                alike = torch.equal(known.amounts, self.amounts)
        else:
            alike = False
        if known is not None and alike:
            self._state.reflectance, self._tilted = known._state.reflectance, known._tilted
        else:
            self._state.reflectance = self._surface(self._state)
        self.rendered = self.render()

    @property
    def state(self) -> State:
        """Angles and visibility under the base effects; not to be changed."""
        return self._state

    def _illuminate(self, effects: Sequence[formation.Extension], known: State | None = None) -> State:
        return formation.illuminate(self.site.observation, [self._sharp, *effects], known)

    def _surface(self, state: State, coefficients: Tensor | None = None) -> Tensor:
        """(n, H, W) I/F of the law, without what else lights the ground."""
        c = self.coefficients if coefficients is None else coefficients
        out = masked_radiance_factor(self.model, self.model.unpack(c, dim=1), state.angles)
        if self.laws is None or self.amounts is None:
            return out
        if state is self._state and self._parts is not None:
            return out + torch.tensordot(self.amounts, self._parts, 1)
        return out + self.laws.added(self.amounts, state.angles)

    def _expose(
        self, state: State, reflectance: Tensor, effects: Sequence[formation.Extension], measured: bool = True
    ) -> Tensor:
        state = copy.copy(state)
        state.further_light = list(state.further_light)
        state.reflectance, state.albedo = reflectance, lambda: self._albedo
        state.measured = (lambda: self._measured) if measured else None
        state.law_fitted = True
        return formation.expose(state, effects)

    @cached_property
    def _albedo(self) -> Tensor:
        return lambert_albedo(self.model, self.model.unpack(self.coefficients, dim=1))

    def predict(self) -> Tensor:
        """(n, H, W) I/F, of which nothing is taken from the image; not to be changed."""
        return self._predicted

    @cached_property
    def _predicted(self) -> Tensor:
        return self._expose(self._state, self._state.reflectance, self.base, measured=False)

    @cached_property
    def _measured(self) -> Tensor:
        """(n, H, W) the image, NaN where invalid, without what is broad and not rendered: albedo is like itself some way off, as an echo is."""
        site, predicted = self.site, self.predict()
        return torch.where(
            site.valid, predicted + fine(site.image - predicted, site.valid.float(), 2 * BROAD), torch.nan
        )

    def render(self, extra: formation.Extension | None = None) -> Tensor:
        """(n, H, W) I/F with one more effect, which may know the image."""
        if extra is None:
            return self._expose(self._state, self._state.reflectance, self.base)
        effects: list[formation.Extension] = [*self.base, extra]
        if extra.slot in ("geometry", "illumination"):
            state = self._illuminate(effects, self._state)
            same = state.angles.cos_incidence is self._state.angles.cos_incidence
            return self._expose(state, self._state.reflectance if same else self._surface(state), effects)
        return self._expose(self._state, self._state.reflectance, effects)

    def replace(self, k: int, effect: Effect) -> Tensor:
        """As ``render`` with base effect ``k`` exchanged."""
        effects = [effect if j == k else e for j, e in enumerate(self.base)]
        if effect.slot in ("geometry", "illumination"):
            state = self._illuminate(effects)
            return self._expose(state, self._surface(state), effects)
        return self._expose(self._state, self._state.reflectance, effects)

    def displaced(self, effect: Effect) -> Tensor:
        """What a small displacement adds, (n, H, W): it times the image's gradients, on lit ground.

        A finite one would bring in the image's curvature as well, and be taken for its sharpness.
        """
        state = dataclasses.replace(self._state, displacement=None)
        effect.apply(state)
        if state.displacement is None:
            return torch.zeros_like(self.rendered)
        (east, south), (far, down) = self._gradients, state.displacement
        return (east * far + south * down) * self.lit()

    @cached_property
    def _gradients(self) -> tuple[Tensor, Tensor]:
        return gradients(self.rendered)

    def surface_tangents(self) -> list[Tensor]:
        """d image / d coefficient, one (n, H, W) per free coefficient: the nominal model's own freedom."""
        columns: list[Tensor] = []
        for k in range(self.coefficients.shape[1]):
            if self.free is not None and not bool(self.free[k]):
                continue
            step = 0.05 * float(self.coefficients[:, k].abs().mean()) + 1e-4
            c = self.coefficients.clone()
            c[:, k] += step
            moved = self._surface(self._state, c)
            columns.append((self._expose(self._state, moved, self.base) - self.rendered) / step)
        return columns

    def form_tangents(self) -> list[Tensor]:
        """What another law of the ground adds, (n, H, W) for an amount of 1 in each direction in which measured laws differ."""
        if self.laws is None:
            return []
        if self._parts is None:
            self._parts = self.laws.parts(self._state.angles)
        plain = self._state.reflectance
        return [self._expose(self._state, plain + part, self.base) - self.rendered for part in self._parts]

    @cached_property
    def slope_tangents(self) -> tuple[Tensor, Tensor]:
        """d image / d slope to the east and to the north: how an error of the DEM shows in every image."""
        east, north = (self._with_slopes(*by) for by in ((STEP, 0.0), (0.0, STEP)))
        return (east - self.rendered) / STEP, (north - self.rendered) / STEP

    def _with_slopes(self, more_east: float, more_north: float) -> Tensor:
        """(n, H, W) I/F with all slopes changed by so much."""
        by = more_east, more_north
        east, north = self._state.slopes
        state = copy.copy(self._state)
        state.angles = geometry.photometric_angles(
            east + more_east, north + more_north, state.sun_direction, state.view
        )
        if by not in self._tilted:
            self._tilted[by] = self._surface(state)
        return self._expose(state, self._tilted[by], self.base)

    def sunlight(self, effects: Sequence[Effect]) -> tuple[Tensor, Tensor | None, Tensor]:
        """Elevation of the Sun (n,), terrain horizon (n, H, W) and radius of the disc, rad, with these effects of the illumination beside the base."""
        state = copy.copy(self._state)
        for effect in effects:
            effect.apply(state)
        sun = torch.asin(state.sun_direction[:, 2].clamp(-1, 1)).to(state.elevation.dtype)
        return sun, state.sun_horizon, torch.as_tensor(state.sun_radius, dtype=sun.dtype)

    def unresolved_slopes(self) -> Tensor:
        """What a scatter of slopes within a pixel, or of the DEM's own slopes, does to the mean: its second order."""
        ways = (SCATTER, 0.0), (-SCATTER, 0.0), (0.0, SCATTER), (0.0, -SCATTER)
        return 0.25 * sum((self._with_slopes(*by) for by in ways), start=-4 * self.rendered)

    def without_dem_errors(self, kept: Callable[[Tensor], Tensor]) -> list[Tensor]:
        """What the rendering changes by if of the DEM's waves only a share is relief, three (n, H, W): of all alike, and more of
        those that run to the east, or the southeast, than of those across. ``kept``: of wave numbers, rad/px
        """
        ways = (
            lambda east, south: east**2 + south**2,
            lambda east, south: east**2 - south**2,
            lambda east, south: 2 * east * south,
        )
        return [self.render(ShareOfRelief(kept, way)) - self.rendered for way in ways]

    def brighter(self) -> list[Tensor]:
        """Two (n, H, W): what albedo adds that grows over the crop to the east, and to the south.

        Of single waves, which the covariance knows, it has all at once, and in one phase.
        """
        height, width = self.rendered.shape[-2:]
        east, south = torch.linspace(-1, 1, width), torch.linspace(-1, 1, height)
        return [self.rendered * east, self.rendered * south[:, None]]

    def lit(self) -> Tensor:
        """(n, H, W) bool: ground that the Sun's centre shines on."""
        above, facing = self.height_above_horizon(), self._state.angles.cos_incidence > 0
        return facing if above is None else facing & (above > 0)

    def height_above_horizon(self) -> Tensor | None:
        """rad, (n, H, W): the Sun's centre above the terrain horizon."""
        state = self._state
        if state.sun_horizon is None:
            return None
        sun = torch.asin(state.sun_direction[:, 2].clamp(-1, 1))
        return sun[:, None, None] - state.sun_horizon
