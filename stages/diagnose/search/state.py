"""What a diagnosis knows so far: the data, the nominal model, where the images lie, the causes named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from stages.diagnose.likelihood.covariance import Covariance, estimate, shadow_variance, texture
from stages.diagnose.likelihood.products import Residual, Rows, make_shams, products, whitened_residual
from stages.diagnose.likelihood.weigh import Found, Whole
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import Nominal, fit
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.explain import Registration
from stages.diagnose.registration.forms import aligned
from stages.diagnose.rows.columns import Plan, frame_columns, make_plan, shared_columns
from stages.diagnose.rows.patches import Grid, Patch, cuts, make_grid, make_patches
from stages.diagnose.settings import SEEN, SHAMS
from stages.effects import Effect, Survey, get_effect


@dataclass
class Cause:
    """A named effect with its standard errors by coordinate (per frame: of the root mean square, under 'rms')."""

    effect: Effect
    found: Found
    errors: dict[str, float] = field(default_factory=dict)
    rms: float = float("nan")  # of values per frame
    group: list[str] = field(default_factory=list)
    gain_percent: float = float("nan")
    gain_low: float = float("nan")
    gain_high: float = float("nan")
    rms_before: float = float("nan")
    rms_after: float = float("nan")


@dataclass
class State:
    """What the search knows so far."""

    nominal: Nominal
    sites: list[Site]
    data: Survey
    frames: int
    units: str
    has: frozenset[str]
    seed: int
    hidden: list[Site] = field(default_factory=list)  # of the test pairs, which nothing is fitted to
    registration: Registration | None = None
    causes: list[Cause] = field(default_factory=list)
    covariance: Covariance | None = None
    reference: Nominal | None = None
    say: Callable[[str], None] = lambda text: None
    progress: Callable[[int, int, str], None] = lambda done, total, what: None

    @property
    def base(self) -> list[Effect]:
        """The effects found so far."""
        return [c.effect for c in self.causes]

    @property
    def free_gains(self) -> bool:
        """Whether every image has an unknown gain and offset."""
        return self.units == "dn"

    def chains(self) -> list[Chain]:
        """The formation chain of every site with the effects found so far."""
        base = self.base
        return per_site(lambda site: self.nominal.chain(site, base), self.sites)

    def grid(self) -> tuple[Grid, int]:
        """The patches' frequencies, and into how many pieces a side a crop is cut."""
        height, width = self.sites[0].image.shape[-2:]
        pieces = cuts(min(height, width), len(self.sites))
        return make_grid(height // pieces, width // pieces), pieces

    def align(self) -> None:
        """Lay the images over the ground as the registration has them."""
        for site in self.sites:
            site.image, site.valid = site.read, site.read_valid
            if site.displacement is not None:
                site.image, site.valid = aligned(site.read, site.read_valid, *site.displacement)

    def fit(self, start: bool = False) -> None:
        """Fit the nominal model (and gain and offset of dn images) to the aligned images."""
        self.align()
        kept = [site.texture for site in self.sites]
        for site in self.sites:
            site.texture = torch.ones_like(site.texture)
        fit(self.nominal, self.sites, self.base, self.units, [s.image for s in self.sites], start=start)
        for site, known in zip(self.sites, kept, strict=True):
            site.texture = known

    def leave_out_rare_images(self) -> None:
        """Images that show too few pieces of ground, unless that is all there are."""
        _, pieces = self.grid()
        patches = [p for k, chain in enumerate(self.chains()) for p in make_patches(k, chain, pieces, self.free_gains)]
        seen = torch.bincount(torch.cat([p.frames for p in patches]), minlength=self.frames) if patches else None
        if seen is not None and int(seen.max()) >= SEEN:
            for site in self.sites:
                site.left_out = frozenset(k for k, f in enumerate(site.frames) if seen[f] < SEEN)

    def learn_texture(self) -> None:
        """Estimate the covariance from the bare residual, and with it the ground's albedo, which effects go with."""
        chains = self.chains()
        grid, pieces = self.grid()
        patches: list[Patch] = []
        rows: list[tuple[Tensor, Tensor]] = []
        for k, chain in enumerate(chains):
            residual = (chain.site.image - chain.predict())[None]
            for patch in make_patches(k, chain, pieces, self.free_gains):
                z, mean = patch.transform(residual, grid)
                patches.append(patch)
                rows.append((z[0], mean[0]))
        if not patches:
            return
        self.covariance = estimate(patches, rows, grid, self.frames)
        for chain in chains:
            chain.site.texture = texture(chain.site, chain, self.covariance)

    def open_names(self) -> list[str]:
        """Effects that are not named and that data of this kind can show."""
        named = {c.effect.name for c in self.causes}
        from stages.effects import effect_names

        every = [n for n in effect_names() if n not in named]
        return [n for n in every if get_effect(n).visible(self.data, self.has)]

    def rows(self, number: int, chain: Chain, plan: Plan) -> list[Rows]:
        """Of one site, piece by piece."""
        grid, pieces = self.grid()
        shared, own = shared_columns(chain, plan, self.data), frame_columns(chain, plan, self.data)
        out = []
        for patch in make_patches(number, chain, pieces, self.free_gains):
            z, mean = patch.transform(shared, grid)
            z_own, mean_own = patch.transform(own, grid)
            out.append(Rows(patch, z, mean, z_own, mean_own, patch.shadow(shared), patch.shadow(own)))
        return out

    def look(self, names: Sequence[str], shams: int = SHAMS) -> View:
        """Rows and products of everything, with the effects ``names`` as candidates."""
        chains = self.chains()
        grid, _ = self.grid()
        plan = make_plan(chains[0], names, self.data)

        rows = [r for part in per_site(lambda k: self.rows(k, chains[k], plan), range(len(chains))) for r in part]
        model = estimate([r.patch for r in rows], [(r.shared[0], r.shared_mean[0]) for r in rows], grid, self.frames)
        model.dark = shadow_variance([r.patch for r in rows], [r.shared_dark[0] for r in rows])
        self.covariance = model
        tricks: list[Residual | None] = [None] * len(rows)
        if shams:
            tricks = list(make_shams([whitened_residual(r, model, grid) for r in rows], grid, shams, self.seed))
        whole = self._whole(rows, tricks, plan, grid, model)
        return View(whole, plan, rows, grid, model)

    def weigh(self, rows: Sequence[Rows], view: View) -> Whole:
        """The sums of other rows under the covariance of a look."""
        return self._whole(rows, [None] * len(rows), view.plan, view.grid, view.model)

    def _whole(
        self, rows: Sequence[Rows], shams: Sequence[Residual | None], plan: Plan, grid: Grid, model: Covariance
    ) -> Whole:
        units = per_site(lambda k: products(rows[k], model, grid, self.frames, shams[k]), range(len(rows)))
        whole = Whole(units, plan, self.frames)
        for name in dict.fromkeys(plan.per_frame):
            if get_effect(name).scatters:
                places = whole.frame_places([k for k, n in enumerate(plan.per_frame) if n == name])
                whole.let_scatter(places)
                if not get_effect(name).displaces:
                    whole.scattered = places
        return whole


@dataclass
class View:
    """One look at the data under the model so far."""

    whole: Whole
    plan: Plan
    rows: list[Rows]
    grid: Grid
    model: Covariance


__all__ = ["Cause", "State", "View"]
