"""What a diagnosis knows so far: the data, the nominal model, the causes named."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.diagnose.data import Site
from stages.diagnose.images import FEWEST, ImageEvidence
from stages.diagnose.nominal import ROUNDS, Nominal, fit, lit_mask
from stages.diagnose.parallel import per_site
from stages.effects import Effect, Survey, effect_names, get_effect
from stages.physics.formation import chain as formation

# With gains free the level of an image says nothing of the phase function, nor the contrast of slopes of their height.
LEVEL_AGAINST_CONTRAST = {"dem_scale"}

RICH = "kernels"  # any smooth reflectance, to a few thousandths ...
# ... with what it takes for its own: whatever makes brightness go with the angles, or with the image, since each has its own
OF_THE_FORM = frozenset(
    {
        "image_gain",
        "limb_darkening",
        "macroscopic_roughness",
        "nonlinearity",
        "opposition_surge",
        "phase_slope",
    }
)

R = TypeVar("R")


@dataclass
class Cause:
    """A named cause; ``fid`` and ``gain`` as when it was named, ``rivals`` what it won against then."""

    effect: Effect
    p: float
    gain: float
    gain_error: float
    fid: float
    group: list[str]
    errors: dict[str, float] = field(default_factory=dict)
    along: dict[str, float] = field(default_factory=dict)  # further errors, along coordinates that are held
    lowered: dict[str, float] = field(default_factory=dict)  # parts of the errors that can only have made it too small
    image_evidence: ImageEvidence | None = None
    promised: float | None = None  # nats of the gain in the images' own rows, where that is not all of it
    rms_before: float = math.nan
    rms_after: float = math.nan
    rivals: list[Cause] = field(default_factory=list)
    for_gains: bool = False  # named in the place of gains, which could stand for it again


@dataclass(frozen=True)
class Saved:
    """A state to come back to."""

    vector: Tensor
    causes: list[tuple[Cause, Effect, dict[str, float], dict[str, float]]]
    sites: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


@dataclass
class Search:
    """State of a diagnosis. measured, valid : the images as read and their masks, (n, H, W) per site"""

    nominal: Nominal
    sites: list[Site]
    data: Survey
    frames: int
    units: str
    has: frozenset[str]
    progress: Callable[[int, int, str], None]
    causes: list[Cause] = field(default_factory=list)
    measured: list[Tensor] = field(default_factory=list)
    valid: list[Tensor] = field(default_factory=list)
    aligned: Effect | None = None  # shifts of the images, estimated before anything else
    reference: Nominal | None = None  # the nominal model before any cause was named
    refused: set[str] = field(default_factory=set)  # looked good to the linear model, and made things worse
    unsure: set[str] = field(default_factory=set)  # were named, and came out within their errors of doing nothing
    replaced: bool = False  # whether the nominal model is another than was asked for
    form: str | None = None  # the model that should be the nominal one instead

    @property
    def base(self) -> list[Effect]:
        return [c.effect for c in self.causes]

    @property
    def dn(self) -> bool:
        return self.units == "dn"

    @property
    def deepest(self) -> int:
        """Images of the site that has most."""
        return max((s.count for s in self.sites), default=0)

    def each(self, function: Callable[[Chain], R], done: Callable[[int], None] = lambda count: None) -> list[R]:
        """What ``function`` makes of the model of every site, in their order."""
        still, moved = self.still, self.moved
        return per_site(lambda site: function(self.nominal.chain(site, still, moved)), self.sites, done)

    @property
    def moved(self) -> list[Effect]:
        """What is taken out of the images: named displacements, or the shifts that every data set has a little of."""
        named = [e for e in self.base if e.displaces]
        if self.aligned is not None and all(e.name != self.aligned.name for e in named):
            named.append(self.aligned)
        return named

    @property
    def still(self) -> list[Effect]:
        """The named effects that do not move images: the others are taken out of the images themselves."""
        return [e for e in self.base if not e.displaces]

    def fit(self, again: bool = False, start: bool = False) -> None:
        """Align the images by what is known of their displacement, and fit the nominal model to them.

        Where images are moved against each other no column per ground pixel is the same in all of them: the model
        stays where it is, and the measurement moves. ``again``: nearly the same was fitted a moment ago; ``start``: nothing
        is known of the coefficients.
        """
        moved = self.moved
        level = float(torch.stack([s.texture.mean() for s in self.sites]).mean())
        for site in self.sites:  # the mean albedo is the nominal model's to know, or unseen ground comes out too bright
            site.texture = site.texture / level
        images = []
        for site, image, valid in zip(self.sites, self.measured, self.valid, strict=True):
            east, south = displacement(site, moved)
            aligned = formation.displace(image, -east, -south) if moved else image
            whole = formation.displace(valid.float(), -east, -south) > 0.99 if moved else valid
            site.valid = valid & whole
            images.append(aligned)
            if not self.dn:
                site.image = aligned
        known = self.nominal.model.linear and not self.dn
        rounds = (1 if known else 2) if again else (ROUNDS if known else 4)
        fit(self.nominal, self.sites, self.still, self.units, images, rounds, start)

    def save(self) -> Saved:
        """Everything that naming a cause changes."""
        return Saved(
            self.nominal.vector,
            [(c, c.effect, dict(c.errors), dict(c.lowered)) for c in self.causes],
            [(s.image, s.valid, s.gain, s.offset, s.texture) for s in self.sites],
        )

    def load(self, saved: Saved) -> None:
        """Back to what was saved."""
        self.nominal.vector = saved.vector
        self.causes[:] = [c for c, *_ in saved.causes]
        for cause, effect, errors, lowered in saved.causes:
            cause.effect, cause.errors, cause.lowered = effect, dict(errors), dict(lowered)
        for site, (image, valid, gain, offset, texture) in zip(self.sites, saved.sites, strict=True):
            site.image, site.valid, site.gain, site.offset, site.texture = image, valid, gain, offset, texture

    def restore(self) -> None:
        """The images as they were read (in I/F), for whoever compares them with the whole model."""
        for site, image, valid in zip(self.sites, self.measured, self.valid, strict=True):
            site.valid = valid
            site.image = (image - site.offset[:, None, None]) / site.gain[:, None, None] if self.dn else image

    def residual_rms(self) -> float:
        """rms of measured minus predicted over fully lit pixels, I/F."""

        def of(chain: Chain) -> tuple[float, int]:
            residual = (chain.site.image - chain.predict())[lit_mask(chain)]
            return float(residual.double().square().sum()), len(residual)

        squares, counts = zip(*self.each(of), strict=True)
        return math.sqrt(sum(squares) / max(sum(counts), 1))

    def open_names(self) -> list[str]:
        """Effects that are neither named nor excluded by the kind of data."""
        closed = {c.effect.name for c in self.causes} | self.refused | {"misregistration"}  # judged by ``align``
        if self.dn:
            closed.add("image_gain")
        if any(c.effect.name == "image_gain" for c in self.causes):
            closed |= LEVEL_AGAINST_CONTRAST
        if self.nominal.model.name == RICH or (self.replaced and not self.nominal.model.linear):
            closed |= OF_THE_FORM
        if self.deepest < FEWEST:  # one look at the ground: albedo and shading are the same thing
            closed |= {n for n in effect_names() if get_effect(n).channel in ("albedo", "relief")}
        return [n for n in effect_names() if n not in closed and get_effect(n).visible(self.data, self.has)]


def displacement(site: Site, effects: Sequence[Effect]) -> tuple[Tensor, Tensor]:
    """Where the effects look for a site's pixels, columns to the east and rows to the south, broadcastable to its images."""
    seen = site.observation
    state = formation.State(seen, seen.elevation, seen.sun_direction, seen.camera_position, None)
    for effect in effects:
        effect.apply(state)
    if state.displacement is None:
        return torch.zeros(()), torch.zeros(())
    east, south = state.displacement
    return torch.as_tensor(east), torch.as_tensor(south)
