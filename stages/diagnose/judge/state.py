"""What a diagnosis knows so far: the data, the nominal model, where the images lie, the causes named."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from stages.common.intervals import student_quantile
from stages.common.memory import return_freed_memory
from stages.diagnose.data.parallel import per_site
from stages.diagnose.data.sites import Site
from stages.diagnose.judge.claim import Claim, Refusal, decide
from stages.diagnose.likelihood.columns import Plan, frame_columns, make_plan, moved_columns, shared_columns
from stages.diagnose.likelihood.covariance import Covariance, estimate, kept_share, shadow_variance
from stages.diagnose.likelihood.patches import Grid, Patch, cuts, make_grid, make_patches
from stages.diagnose.likelihood.products import Rows, Shams, products, whitened_residual
from stages.diagnose.likelihood.weigh import Found, beyond_bounds
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import LEAST_SCATTER, MOST_SCATTER, Nominal, fit
from stages.diagnose.registration.registered import Registration
from stages.diagnose.settings import GROUPS, SEEN, SHAMS, STILL
from stages.effects import Effect, Survey, effect_names, get_effect

TOGETHER = 16  # columns that are transformed at a time: all at once take as much memory again as they do


@dataclass
class Cause:
    """An effect in the model, with its standard errors by coordinate (per frame: of the root mean square, under 'rms').

    of_given_shape : errors where what only shapes the effect is held; over_images : errors by leaving out images
    away : standard errors from nothing, of all amounts together
    share_error, share_freedom : of one factor on all values, by leaving out images, and with how many degrees of freedom it is known
    rms : of values per frame; ordinary : sure, and of a size that any data set has
    gains, units : on each piece of ground, nats, and what they go with; total : all squares, nats
    """

    effect: Effect
    found: Found
    gains: np.ndarray
    units: np.ndarray
    errors: dict[str, float] = field(default_factory=dict)
    of_given_shape: dict[str, float] = field(default_factory=dict)
    over_images: dict[str, float] = field(default_factory=dict)
    away: float = math.inf
    share_error: float = 0.0
    share_freedom: float = 1.0
    rms: float = math.nan
    group: list[str] = field(default_factory=list)
    ordinary: bool = False
    total: float = math.nan
    rms_before: float = math.nan
    rms_after: float = math.nan

    @property
    def single(self) -> bool:
        """Whether one amount acts on all images, which other ground can be asked about by itself."""
        return type(self.effect).scope == "scene" and len(self.found.guise.columns) == 1

    def copy(self) -> Cause:
        """As it is now, whatever is fitted later."""
        out = copy.copy(self)
        vars(out).update({k: dict(v) for k, v in vars(self).items() if isinstance(v, dict)})
        return out

    def reported(self, law: float) -> dict[str, tuple[float, float]]:
        """Reported parameter -> value and standard error, the larger of those over ground and over images.

        law : how far the law of the ground is open, in departures of measured laws
        """
        cls = type(self.effect)
        if cls.scope != "scene":
            return {cls.parameters[0].name: (self.rms, self.errors.get("rms", math.inf))}
        errors = {k: max(e, self.over_images.get(k, 0.0)) for k, e in self.errors.items()}
        errors = {k: math.hypot(e, min(law, 1.0) * cls.law_error.get(k, 0.0)) for k, e in errors.items()}
        return cls.report({k: float(v) for k, v in self.effect.values.items()}, errors)

    def claim(self, data: Survey, law: float, sure: bool = False) -> Claim:
        """What it claims as it is fitted now. Rivals were asked in the look that it was found in.

        sure : it was found sure before everything was fitted together
        """
        cls = type(self.effect)
        null = cls.null()
        sizes = {k: (abs(v - null.get(k, 0.0)), e) for k, (v, e) in self.reported(law).items()}
        if cls.scope != "scene":
            sizes, away, amounts = dict.fromkeys(["rms", *sizes], next(iter(sizes.values()))), math.inf, 1
            away = self.rms / max(self.errors.get("rms", math.inf), 1e-30)
        else:
            away, amounts = self.away, len(self.of_given_shape)
        images = 1 / max(self.share_error * student_quantile(self.share_freedom), 1e-9)
        away = math.inf if sure and away > STILL else away
        return Claim(
            self.effect, sizes, self.gains, self.units, away, amounts, self.found.p, images, self._odd(data),
            values=self.found.values,
        )  # fmt: skip

    def _odd(self, data: Survey) -> str:
        """What is impossible about the values, or ''."""
        cls = type(self.effect)
        if cls.scope != "scene":
            return ""
        values = {k: float(v) for k, v in self.effect.values.items()}
        said = ", ".join(f"{k} = {v:.3g}" for k, v in values.items())
        if not cls.plausible(values, data):
            return said + (f"; expected: {cls.possible}" if cls.possible else "")
        for name in [n for n in self.errors if n not in cls.shaped]:  # a shape may end anywhere
            near = self.of_given_shape.get(name, 1e-9)
            low, high = (
                b if b != cls.null()[name] else math.inf * side
                for b, side in zip(cls.bounds(name), (-1, 1), strict=True)
            )
            if not low + near <= values[name] <= high - near:
                return f"{name} = {values[name]:.3g}, at a bound of what is physical"
        return ""


@dataclass
class State:
    """What the search knows so far.

    hidden : sites of the test pairs, which nothing is fitted to; seldom : frames that show too few pieces of ground for values of their own
    kept : share of the DEM's waves that is relief if all that images show beside it is its errors
    """

    nominal: Nominal
    sites: list[Site]
    data: Survey
    frames: int
    units: str
    has: frozenset[str]
    seed: int
    hidden: list[Site] = field(default_factory=list)
    registration: Registration | None = None
    causes: list[Cause] = field(default_factory=list)
    seldom: frozenset[int] = frozenset()
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

    @property
    def law(self) -> float:
        """How far the law of the ground is open, in departures of measured laws; 0 where it is known."""
        return self.nominal.scatter if self.nominal.laws is not None else 0.0

    def decide(self, cause: Cause, sure: bool = False) -> Refusal | None:
        """Why a cause, as it is fitted now, gets no name; or None."""
        return decide(cause.claim(self.data, self.law, sure))

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
            site.align()

    def fit(self, law: bool = False) -> None:
        """Fit the nominal model (and gain and offset of dn images) to the aligned images; law : and its departures"""
        self.align()
        per_image = any(c.found.guise.per_frame and not c.effect.displaces for c in self.causes)
        for site in [*self.sites, *self.hidden]:
            site.unknown = frozenset(k for k, f in enumerate(site.frames) if per_image and f in self.seldom)
        fit(self.nominal, self.sites, self.base, self.units, [s.laid for s in self.sites], law=law)

    def beside(self, effects: Sequence[Effect]) -> Nominal:
        """The nominal model as it is fitted to the same images beside these effects, with departures of the law unless one of them is of the law.

        Gains and offsets of dn images stay as they are.
        """
        law = not any(c.effect.of_law for c in self.named)
        nominal = copy.copy(self.nominal) if law else self.nominal.alone()
        known = [(s.gain, s.offset, s.image) for s in self.sites]
        fit(nominal, self.sites, effects, self.units, [s.laid for s in self.sites], law=law)
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
        patches = per_site(lambda k: self.patches(k, chains[k]), range(len(chains)))
        self.kept = kept_share(chains, patches, grid, self.frames)
        plan = make_plan(chains[0], names, self.data, candidates, law_scatter=self.nominal.scatter)
        return_freed_memory()  # of the look before, whose pieces have other sizes
        every = per_site(lambda k: self.rows(patches[k], chains[k], plan), range(len(chains)))
        return_freed_memory()
        return self._view([r for part in every for r in part], plan, grid, None, shams)

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
        plan = make_plan(chains[0], names, self.data, candidates, law_scatter=self.nominal.scatter)
        parts = per_site(lambda k: self.moved(view, k, chains[k], plan), range(len(chains)))
        return self._view([r for part in parts for r in part], plan, view.grid, model, shams)

    def _view(self, rows: list[Rows], plan: Plan, grid: Grid, model: Covariance | None, shams: int) -> View:
        model = model or self._covariance(rows, plan, grid)
        false = Shams([whitened_residual(r, model, grid) for r in rows], grid, shams, self.seed) if shams else None
        units = per_site(
            lambda k: products(rows[k], model, grid, self.frames, false.of(k) if false else None), range(len(rows))
        )
        whole = self._scattered(Whole(units, plan, self.frames))
        # an ordinary amount that nothing real has would hide what it stands for
        while strange := _impossible_ordinary(whole):
            for name in strange:
                for k in plan.ordinary.pop(name):
                    plan.prior.pop(k)
            whole = self._scattered(Whole(units, plan, self.frames))
        return View(whole, plan, rows, grid, model)

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

    def _scattered(self, whole: Whole) -> Whole:
        """With the scatter of values per image estimated."""
        plan = whole.plan
        if len(forms := whole.form_places()):
            self.nominal.scatter = whole.let_scatter(forms, LEAST_SCATTER, MOST_SCATTER)
            if whole.levels is not None:
                whole.levels.precision |= {int(p): whole.precision[int(p)] for p in forms}
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


def _impossible_ordinary(whole: Whole) -> list[str]:
    """Effects that are fitted along and of which nothing real has as much as fits best."""
    out = []
    for guise in whole.plan.guises:
        if list(guise.columns) != whole.plan.ordinary.get(guise.effect) or guise.per_frame:
            continue
        places = whole.places(guise)
        if not whole.seen[places].all():
            continue
        information, score, _, _ = whole.reduce(places, whole.stood_for([type(c) for c in whole.plan.base]))
        covariance = np.linalg.inv(information + np.diag(whole.weight(places)))
        if beyond_bounds(Found(guise.effect, guise, covariance @ score, np.sqrt(covariance.diagonal()), 0.0)):
            out.append(guise.effect)
    return out


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
