"""What a diagnosis knows so far: the data, the nominal model, where the images lie, the causes named."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from stages.common.memory import return_freed_memory
from stages.diagnose.likelihood.covariance import Covariance, estimate, shadow_variance
from stages.diagnose.likelihood.dem_errors import kept_share
from stages.diagnose.likelihood.found import Found
from stages.diagnose.likelihood.products import Rows, Shams, products, whitened_residual
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.form import may_be_exchanged, measured_laws
from stages.diagnose.model.laws import LunarLaws
from stages.diagnose.model.nominal import Nominal, fit
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.registration.registered import Registration
from stages.diagnose.rows.columns import Guise, Plan, frame_columns, make_plan, moved_columns, shared_columns
from stages.diagnose.rows.patches import Grid, Patch, cuts, make_grid, make_patches
from stages.diagnose.settings import FAINT, GROUPS, ROUGHLY, SEEN, SHAMS
from stages.effects import Effect, Survey, effect_names, get_effect

TOGETHER = 16  # columns that are transformed at a time: all at once take as much memory again as they do


@dataclass
class Cause:
    """A named effect with its standard errors by coordinate (per frame: of the root mean square, under 'rms')."""

    effect: Effect
    found: Found
    errors: dict[str, float] = field(default_factory=dict)
    of_given_shape: dict[str, float] = field(default_factory=dict)  # errors where what only shapes the effect is held
    over_images: dict[str, float] = field(default_factory=dict)  # errors by leaving out images
    away: float = math.inf  # standard errors from nothing, of all amounts together
    share_error: float = 0.0  # of one factor on all values, by leaving out images
    share_freedom: float = 1.0  # with which it is known
    rms: float = float("nan")  # of values per frame
    group: list[str] = field(default_factory=list)
    ordinary: bool = (
        False  # no cause but what all data have of the effect, rendered like one so that others are judged beside it
    )
    gain_percent: float = float("nan")
    gain_low: float = float("nan")
    gain_high: float = float("nan")
    rms_before: float = float("nan")
    rms_after: float = float("nan")

    @property
    def single(self) -> bool:
        """Whether one amount acts on all images, which other ground can be asked about by itself."""
        return type(self.effect).scope == "scene" and len(self.found.guise.columns) == 1

    @property
    def worst_error(self) -> float:
        """The largest error of any kind of a scene-wide value, in sizes worth knowing."""
        strong = type(self.effect).strong
        every = [(k, e) for kind in (self.errors, self.over_images) for k, e in kind.items() if strong.get(k)]
        return max((e / strong[k] for k, e in every), default=0.0)

    def copy(self) -> Cause:
        """As it is now, whatever is fitted later."""
        out = copy.copy(self)
        vars(out).update({k: dict(v) for k, v in vars(self).items() if isinstance(v, dict)})
        return out

    @property
    def larger_errors(self) -> dict[str, float]:
        """Over ground or over images."""
        return {k: max(e, self.over_images.get(k, 0.0)) for k, e in self.errors.items()}


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
    seldom: frozenset[int] = frozenset()  # frames that show too few pieces of ground for values of their own
    # effects whose best values nothing real has: of them the others have no ordinary amounts beside them
    impossible: set[str] = field(default_factory=set)
    # effects that were fitted and refused -> their largest error, in sizes worth knowing
    open: dict[str, float] = field(default_factory=dict)
    # share of the DEM's waves that is relief if all that images show beside it is its errors
    kept: Callable[[Tensor], Tensor] = torch.ones_like
    say: Callable[[str], None] = lambda text: None
    progress: Callable[[int, int, str], None] = lambda done, total, what: None

    @property
    def base(self) -> list[Effect]:
        """The effects found so far."""
        return [c.effect for c in self.causes]

    @property
    def named(self) -> list[Cause]:
        """Those that are more than ordinary."""
        return [c for c in self.causes if not c.ordinary]

    def law_errors(self, effect: type[Effect]) -> Mapping[str, float]:
        """Standard errors of its values that no measured law took away, where such laws had to take the nominal one's place."""
        return effect.law_error if isinstance(self.nominal.model, LunarLaws) else {}

    def reported_errors(self, cause: Cause) -> dict[str, float]:
        """The larger ones, those of a law that is not known, and what every data set has of the effect, which is part of what was found."""
        cls = type(cause.effect)
        ordinary = cls.tolerance if cls.scope == "scene" else {"rms": max(cls.tolerance.values(), default=0.0)}
        law = self.law_errors(cls)
        return {k: math.hypot(e, law.get(k, 0.0), ordinary.get(k, 0.0)) for k, e in cause.larger_errors.items()}

    @property
    def free_gains(self) -> bool:
        """Whether every image has an unknown gain and offset."""
        return self.units == "dn"

    def chains(self) -> list[Chain]:
        """The formation chain of every site with the effects found so far."""
        base = self.base
        return per_site(lambda site: self.nominal.chain(site, base), self.sites)

    def choose_law(self, refused: Container[str] = ()) -> bool:
        """Let measured laws take the nominal one's place before a search begins again, and whether they do; effects of the law alone are looked at.

        refused : effects that stand for nothing any more
        """
        if not may_be_exchanged(self.nominal):
            return False
        names = self.open_names()
        return self.law_is_another(self.look(names, 0, [n for n in names if get_effect(n).of_law]), refused)

    def law_is_another(self, view: View, refused: Container[str] = ()) -> bool:
        """Whether another law surely gains on held-out ground whatever effect of the law stands beside it; measured ones take the place of the nominal one,
        and of causes that are effects of the law, then.

        refused : effects that stand for nothing any more
        """
        whole = view.whole
        places = whole.form_places()
        if not len(places) or not may_be_exchanged(self.nominal):
            return False
        named = any(c.effect.of_law for c in self.causes)  # a second one would be a part of another law
        least = (ROUGHLY if named else FAINT) ** 2 / 2 * float(whole.gram[0, 0])
        alone = [
            g
            for g in whole.plan.guises
            if get_effect(g.effect).of_law
            and g.effect not in refused
            and not named
            and whole.seen[whole.places(g)].all()
            and self._plausible(whole, g)
        ]
        if min(whole.another_law(guise, surely=True) for guise in [None, *alone]) < least:
            return False
        other = measured_laws(self.nominal, self.sites, self.units)
        if other is None:
            return False
        self.nominal = other
        self.causes[:] = [c for c in self.causes if not c.effect.of_law]
        self.fit()
        return True

    def _plausible(self, whole: Whole, guise: Guise) -> bool:
        """Whether an effect may have the amounts that are estimated first; what is larger stands for another law."""
        information, score, _, _ = whole.reduce(whole.places(guise), whole.exclude(guise))
        amounts = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ score
        cls = get_effect(guise.effect)
        values = {**cls.null(), **guise.trial.fixed}
        for amount, column in zip(amounts, guise.trial.columns, strict=True):
            values |= {name: cls.null()[name] + float(amount) * (at - cls.null()[name]) for name, at in column.items()}
        return cls.plausible(values, self.data)

    def grid(self) -> tuple[Grid, int]:
        """The patches' frequencies, and into how many pieces a side a crop is cut."""
        height, width = self.sites[0].image.shape[-2:]
        pieces = cuts(min(height, width), len(self.sites))
        return make_grid(height // pieces, width // pieces), pieces

    def align(self) -> None:
        """Lay the images over the ground as the registration has them."""
        for site in self.sites:
            site.align()

    def fit(self, start: bool = False) -> None:
        """Fit the nominal model (and gain and offset of dn images) to the aligned images."""
        self.align()
        per_image = any(c.found.guise.per_frame and not c.effect.displaces for c in self.causes)
        for site in [*self.sites, *self.hidden]:
            site.unknown = frozenset(k for k, f in enumerate(site.frames) if per_image and f in self.seldom)
        fit(self.nominal, self.sites, self.base, self.units, [s.laid for s in self.sites], start=start)

    def plain(self) -> Nominal:
        """The nominal model as it is fitted to the same images without any cause. Gains and offsets of dn images stay as they are."""
        nominal = copy.copy(self.nominal)
        known = [(s.gain, s.offset, s.image) for s in self.sites]
        fit(nominal, self.sites, [], self.units, [s.laid for s in self.sites])
        for site, (gain, offset, image) in zip(self.sites, known, strict=True):
            site.gain, site.offset, site.image = gain, offset, image
        return nominal

    @property
    def exposure(self) -> tuple[float, float]:
        """Gain and offset of the middle image: of what is known in DN and told in I/F."""
        gain, offset = (torch.cat([getattr(s, name) for s in self.sites]) for name in ("gain", "offset"))
        return float(gain.median()), float(offset.median())

    def leave_out_rare_images(self) -> None:
        """Images that show too few pieces of ground, unless most ground is shown by such."""
        patches = [p for k, chain in enumerate(self.chains()) for p in self.patches(k, chain)]
        if not patches:
            return
        frames = torch.cat([p.frames for p in patches])
        seen = torch.bincount(frames, minlength=self.frames)
        least = SEEN if int((seen[frames] >= SEEN).sum()) > len(frames) / 2 else 1
        self.seldom = frozenset(torch.nonzero(seen < least)[:, 0].tolist())
        for site in self.sites:
            site.left_out = frozenset(k for k, f in enumerate(site.frames) if f in self.seldom)

    def open_names(self) -> list[str]:
        """Effects that are not rendered yet and that data of this kind can show."""
        known = {c.effect.name for c in self.causes}
        every = [n for n in effect_names(unlisted=True) if n not in known]
        return [n for n in every if get_effect(n).visible(self.data, self.has)]

    def patches(self, number: int, chain: Chain) -> list[Patch]:
        """The pieces of one site that show enough pixels."""
        return make_patches(number, chain, self.grid()[1], self.free_gains)

    def kept_share(
        self, chains: Sequence[Chain], patches: Sequence[Sequence[Patch]], grid: Grid
    ) -> Callable[[Tensor], Tensor]:
        """Of the DEM's waves, if all relief that images show beside it is errors of the DEM. patches : of every chain"""
        every: list[Patch] = []
        left: list[tuple[Tensor, Tensor]] = []
        for chain, pieces in zip(chains, patches, strict=True):
            residual = (chain.site.image - chain.rendered)[None]
            for patch in pieces:
                z, mean = patch.transform(residual, grid)
                every.append(patch)
                left.append((z[0], mean[0]))
        return kept_share(chains, every, grid, estimate(every, left, grid, self.frames))

    def rows(self, patches: Sequence[Patch], chain: Chain, plan: Plan) -> list[Rows]:
        """Of one site, piece by piece."""
        grid, _ = self.grid()
        parts: list[list[tuple[Tensor, ...]]] = [[] for _ in patches]
        columns = shared_columns(chain, plan, self.data, self.kept)
        while some := list(islice(columns, TOGETHER)):
            fields = torch.stack(some)
            for patch, part in zip(patches, parts, strict=True):
                part.append((*patch.transform(fields, grid), patch.shadow(fields)))
        own = frame_columns(chain, plan, self.data)
        out = []
        for patch, part in zip(patches, parts, strict=True):
            z, mean, dark = (torch.cat(x) for x in zip(*part, strict=True))
            out.append(Rows(patch, z, mean, *patch.transform(own, grid), dark))
        return out

    def look(self, names: Sequence[str], shams: int = SHAMS, candidates: Container[str] | None = None) -> View:
        """Rows and products of everything, with the effects ``names``; candidates : those that may be named, None for all."""
        chains = self.chains()
        grid, _ = self.grid()
        plan = make_plan(chains[0], names, self.data, candidates, self.impossible)

        patches = per_site(lambda k: self.patches(k, chains[k]), range(len(chains)))
        self.kept = self.kept_share(chains, patches, grid)
        return_freed_memory()  # of the look before, whose pieces have other sizes
        every = per_site(lambda k: self.rows(patches[k], chains[k], plan), range(len(chains)))
        return_freed_memory()
        return self._view([r for part in every for r in part], plan, grid, None, shams)

    def without_impossible(self, view: View, names: Sequence[str]) -> View:
        """The same look beside ordinary amounts of no effect that is impossible by now."""
        plan = make_plan(self.chains()[0], names, self.data, impossible=self.impossible)
        whole = self._scattered(Whole(view.whole.given, plan, self.frames))
        return View(whole, plan, view.rows, view.grid, view.model)

    def again(
        self,
        view: View,
        names: Sequence[str],
        model: Covariance | None = None,
        shams: int = 0,
        candidates: Container[str] | None = (),
    ) -> View:
        """A look beside ordinary amounts of these effects. Only the residual and the causes' own columns are rendered, the rest is as in ``view``.

        model : the covariance, estimated where None; candidates : as of :meth:`look`
        """
        chains = self.chains()
        plan = make_plan(chains[0], names, self.data, candidates, self.impossible)
        parts = per_site(lambda k: self.moved(view, k, chains[k], plan), range(len(chains)))
        return self._view([r for part in parts for r in part], plan, view.grid, model, shams)

    def _view(self, rows: list[Rows], plan: Plan, grid: Grid, model: Covariance | None, shams: int) -> View:
        model = model or self._covariance(rows, plan, grid)
        false = Shams([whitened_residual(r, model, grid) for r in rows], grid, shams, self.seed) if shams else None
        return View(self._whole(rows, false, plan, grid, model), plan, rows, grid, model)

    def moved(self, view: View, site: int, chain: Chain, plan: Plan) -> list[Rows]:
        """Rows of one site of a look under another plan: the residual and the causes' columns by ``chain``, all others as they are."""
        moved = moved_columns(chain, plan, self.data)
        own = frame_columns(chain, plan, self.data, named=True)
        return [_taken_over(r, view, plan, moved, own) for r in view.rows if r.patch.site == site]

    def _covariance(self, rows: Sequence[Rows], plan: Plan, grid: Grid) -> Covariance:
        model = estimate([r.patch for r in rows], [(r.shared[0], r.shared_mean[0]) for r in rows], grid, self.frames)
        light = [
            1 + k
            for k, name in enumerate(plan.shared)
            if name in effect_names(unlisted=True) and get_effect(name).lights_shadows
        ]
        residuals, lights = [r.shared_dark[0] for r in rows], [r.shared_dark[light] for r in rows]
        shadow_variance(model, [r.patch for r in rows], residuals, lights)
        return model

    def without_images(self, view: View) -> list[Whole]:
        """The sums of a look as if one group of images after the other had not been taken; what scatters does so as it did with all."""
        groups = self.image_groups(view.rows)
        units = per_site(
            lambda k: products(view.rows[k], view.model, view.grid, self.frames, None, groups), range(len(view.rows))
        )
        left = [Whole([u.without(g) for u in units], view.plan, self.frames) for g in range(len(groups))]
        for whole in left:
            whole.precision |= {p: v for p, v in view.whole.precision.items() if p in whole.precision}
        return left

    def image_groups(self, rows: Sequence[Rows]) -> list[list[int]]:
        """Frames that are left out together; none where there are too few to leave one out."""
        every = [f for row in rows for f in (row.patch.frames, row.patch.dark_frames)]
        frames = sorted(set(torch.cat(every).tolist()))  # most deep shadow is in images that show little lit ground
        return [frames[k::GROUPS] for k in range(min(GROUPS, len(frames)))] if len(frames) > 2 else []

    def _whole(self, rows: Sequence[Rows], shams: Shams | None, plan: Plan, grid: Grid, model: Covariance) -> Whole:
        units = per_site(
            lambda k: products(rows[k], model, grid, self.frames, shams.of(k) if shams else None), range(len(rows))
        )
        return self._scattered(Whole(units, plan, self.frames))

    def _scattered(self, whole: Whole) -> Whole:
        """With the scatter of values per image estimated."""
        plan = whole.plan
        whole.let_scatter(whole.form_places())
        if whole.levels is not None:
            whole.levels.precision |= {int(p): whole.precision[int(p)] for p in whole.form_places()}
        for name in dict.fromkeys(plan.per_frame):
            if get_effect(name).scatters:
                places = whole.frame_places([k for k, n in enumerate(plan.per_frame) if n == name])
                if get_effect(name).displaces or whole.levels is None:
                    whole.let_scatter(places)
                    continue
                whole.levels.let_scatter(places)
                whole.precision |= {int(p): whole.levels.precision[int(p)] for p in places}
                whole.scattered = whole.levels.scattered = places
        return whole


@dataclass
class View:
    """One look at the data under the model so far."""

    whole: Whole
    plan: Plan
    rows: list[Rows]
    grid: Grid
    model: Covariance


def _taken_over(row: Rows, view: View, plan: Plan, moved: Tensor, own: Tensor) -> Rows:
    """Rows of another plan: ``moved`` and ``own`` are fields of the site, all other columns stand in ``row``."""
    grid = view.grid
    fresh = ["residual", *(n for n in plan.shared if "." in n)]
    shared = _order([("residual", 0), *plan.shared_keys()], fresh, [("residual", 0), *view.plan.shared_keys()])
    per_frame = _order(plan.frame_keys(), plan.per_frame[: len(own)], view.plan.frame_keys())
    z, mean = row.patch.transform(moved, grid)
    z_own, mean_own = row.patch.transform(own, grid)
    return Rows(
        row.patch,
        torch.cat([z, row.shared])[shared],
        torch.cat([mean, row.shared_mean])[shared],
        torch.cat([z_own, row.own])[per_frame],
        torch.cat([mean_own, row.own_mean])[per_frame],
        torch.cat([row.patch.shadow(moved), row.shared_dark])[shared],
    )


def _order(wanted: Sequence[tuple[str, int]], fresh: Sequence[str], kept: Sequence[tuple[str, int]]) -> list[int]:
    """Places of the wanted columns among the fresh ones, which go first, and those that are kept."""
    known = {key: len(fresh) + k for k, key in enumerate(kept)}
    known |= {(name, fresh[:k].count(name)): k for k, name in enumerate(fresh)}
    return [known[key] for key in wanted]


__all__ = ["Cause", "State", "View"]
