"""Forward selection: name the cause that predicts held-out data best, take it into the model, look again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.diagnose.data import Site
from stages.diagnose.evidence import Evidence, best_guises, weigh
from stages.diagnose.images import FEWEST, ImageEvidence, as_effect, weigh_images
from stages.diagnose.nominal import Nominal, fit, lit_mask
from stages.diagnose.projection import FREE_SLOPES
from stages.diagnose.statistics import (
    BASELINE,
    Candidate,
    SiteWork,
    Statistics,
    gather_site,
    gather_static,
    join,
    make_candidates,
    ready,
)
from stages.effects import Effect, Survey, effect_names, get_effect

EDGE_EFFECTS = ("penumbra", "distant_shadow")  # judged with the pixels about shadow edges
ALBEDO = ("slope_albedo", "elevation_albedo", "curvature_albedo")  # live in the ground's texture alone
RELIEF = ("dem_scale", "dem_smoothing")  # live in the ground's apparent slopes alone
STATIC = (*ALBEDO, *RELIEF)
GATE = 0.01  # family-wise
GATE_STATIC = 5e-4
FLOOR_FID = 0.012  # an effect smaller than this against the noise is never worth a name
FLOOR_IMAGE = 0.035  # the same for effects with values per image, which have more to fit with
FLOOR_STATIC = 4.0  # nats; the static rows are cut at short waves and count for less than their worth
FLOOR_GAIN = 12.0  # nats
# linear in their coordinates: the first estimate needs no second one
LINEAR = (
    "dark_bias",
    "earthshine",
    "interreflection",
    "nonlinearity",
    "column_pattern",
    "azimuthal_anisotropy",
    *STATIC,
)
KEEP_SHARE = 0.8  # of a per-image effect's gain that a scene-wide effect must keep to replace it


@dataclass
class Cause:
    """A named cause; ``fid`` and ``gain`` as when it was named."""

    effect: Effect
    p: float
    gain: float
    gain_error: float
    fid: float
    group: list[str]
    errors: dict[str, float] = field(default_factory=dict)
    image_evidence: ImageEvidence | None = None
    rms_before: float = math.nan
    rms_after: float = math.nan


@dataclass
class Round:
    """What one look at the data found."""

    works: list[SiteWork]
    statistics: Statistics
    best: dict[str, Evidence]
    images: dict[str, ImageEvidence]


@dataclass
class Search:
    """State of a diagnosis; ``look`` measures, ``choose`` decides."""

    nominal: Nominal
    sites: list[Site]
    data: Survey
    frames: int
    units: str
    has: frozenset[str]
    progress: Callable[[int, int, str], None]
    causes: list[Cause] = field(default_factory=list)
    measured: list[Tensor] = field(default_factory=list)
    refused: set[str] = field(default_factory=set)  # looked good to the linear model, and made things worse

    @property
    def base(self) -> list[Effect]:
        return [c.effect for c in self.causes]

    @property
    def dn(self) -> bool:
        return self.units == "dn"

    def chains(self) -> list[Chain]:
        return [self.nominal.chain(site, self.base) for site in self.sites]

    def residual_rms(self) -> float:
        """rms of measured minus predicted over fully lit pixels, I/F."""
        total, count = 0.0, 0
        for chain in self.chains():
            residual = (chain.site.image - chain.predict())[lit_mask(chain)]
            total, count = total + float(residual.double().square().sum()), count + len(residual)
        return math.sqrt(total / max(count, 1))

    def open_names(self) -> list[str]:
        """Effects that are neither named nor excluded by the kind of data."""
        named = {c.effect.name for c in self.causes}
        excluded = {"image_gain"} if self.dn else set()
        excluded |= self.refused
        if max(s.count for s in self.sites) < FEWEST:  # one look at the ground: albedo and shading are the same thing
            excluded |= set(STATIC)
        return [n for n in effect_names() if n not in named | excluded and get_effect(n).visible(self.data, self.has)]

    def look(self) -> Round:
        names = self.open_names()
        plain = [n for n in names if get_effect(n).scope == "scene" and n not in (*EDGE_EFFECTS, *BASELINE, *STATIC)]
        # group of effects -> the nuisances fitted along, in the rows of what stays with the ground
        still = [(make_candidates([n for n in names if n in ALBEDO], self.data), ())]
        if max(s.count for s in self.sites) >= FREE_SLOPES:
            still.append((make_candidates([n for n in names if n == "dem_smoothing"], self.data), ()))
            still.append((make_candidates([n for n in names if n == "dem_scale"], self.data), ("dem_smoothing",)))
        still = [(c, [n for n in fixed if n in names]) for c, fixed in still if c]
        edge = [n for n in names if n in EDGE_EFFECTS]
        candidates, at_edge = make_candidates(plain, self.data), make_candidates(edge, self.data)
        works, parts, edge_parts, still_parts = [], [], [], [[] for _ in still]
        for k, chain in enumerate(self.chains()):
            work = ready(chain, self.dn)
            parts.append(gather_site(work, candidates, self.data))
            works.append(work)
            for collected, (group, fixed) in zip(still_parts, still, strict=True):
                collected.append(gather_static(work, group, self.data, fixed))
            if at_edge:
                work = ready(chain, self.dn, wide=True)
                edge_parts.append(gather_site(work, at_edge, self.data, [edge_nuisance(chain, self.data)]))
            self.progress(k + 1, len(self.sites), f"looking for causes, round {len(self.causes) + 1}")
        statistics = join(parts)
        best = best_guises(weigh(statistics))
        if "psf_blur" in names:
            best["psf_blur"] = weigh(_swap(statistics, "psf_blur", self.data))[0]
        for collected in [*still_parts, edge_parts]:
            if collected:
                best |= best_guises(weigh(join(collected)))
        image_names = [n for n in names if get_effect(n).scope == "image"]
        images = weigh_images(works, image_names, self.frames, self.dn, self.data)
        return Round(works, statistics, best, images)

    def choose(self, seen: Round) -> Cause | None:
        """The next cause to name, or None."""
        count = len(effect_names())
        scene = [e for e in seen.best.values() if self.worth(e, count)]
        scene.sort(key=lambda e: -e.gain)
        image = [e for e in seen.images.values() if self.worth_image(e, count)]
        image.sort(key=lambda e: -e.gain)
        if image and image[0].effect == "image_gain" and not scene:
            # a scene-wide effect that does nearly as well with a few numbers as gains do with one for each image
            near = [e for e in seen.best.values() if e.gain > KEEP_SHARE * image[0].gain and self.worth(e, count, 5.0)]
            scene = sorted(near, key=lambda e: -e.gain)
        if image and (not scene or scene[0].gain < KEEP_SHARE * image[0].gain):
            top = image[0]
            close = [e.effect for e in image[1:] if e.gain > top.gain - 2 * math.hypot(top.gain_error, e.gain_error)]
            return Cause(
                as_effect(top, None, self.data), min(1.0, top.p * count), top.gain, top.gain_error, top.fid,
                [top.effect, *close], image_evidence=top,
            )  # fmt: skip
        if not scene:
            return None
        wall = [e for e in scene if e.effect in ("distant_shadow", "saturation")]
        first = wall[0] if wall else scene[0]  # gross as it is, a missing shadow spoils every other estimate
        rivals = [e for e in scene if e is not first and _as_good(first, e)]
        simpler = [e for e in rivals if e.candidate.size < first.candidate.size and e.gain > 0.85 * first.gain]
        if simpler:
            rivals = [first, *(e for e in rivals if e is not simpler[0])]
            first = simpler[0]
        group = [first.effect, *(e.effect for e in rivals)]
        effect = start(first, self.data)
        errors = dict(effect.first_errors)  # type: ignore[attr-defined]
        p = min(1.0, first.p * count)
        return Cause(effect, p, first.gain, first.gain_error, first.fid, group, errors)

    def worth(self, e: Evidence, count: int, ease: float = 1.0) -> bool:
        """Whether the evidence is enough for a name."""
        gate = min(GATE, GATE_STATIC * count) if e.effect in STATIC else GATE
        if (
            e.p * count > gate * ease
            or (e.fid < FLOOR_FID and e.effect not in STATIC)
            or min(e.gain_image, e.gain_place) <= 0
        ):
            return False
        if e.gain < max(FLOOR_STATIC if e.effect in STATIC else FLOOR_GAIN, 1.5 * e.gain_error):
            return False
        cls = get_effect(e.effect)
        column = e.candidate.trial.columns[0]
        (name, reference), *_ = column.items()
        unit = reference - cls.null()[name]
        value = cls.null()[name] + float(e.amount[0]) * unit
        error = abs(unit) * float(e.covariance[0, 0].clamp(min=0)) ** 0.5
        low, high = cls.bounds(name)
        span = high - low
        if not low - 0.05 * span <= value <= high + 0.05 * span:
            return False
        if cls.null()[name] == 0 and low < 0 < high and not 0.9 * low < value < 0.9 * high:
            return False
        if name in cls.tolerance:
            return abs(value - cls.null()[name]) - cls.tolerance[name] > 3 * error
        if e.effect == "earthshine":  # a source above the ground, known to a third
            up, spread = e.amount[0], e.covariance[0, 0].clamp(min=0).sqrt()
            return float(up) > 3 * float(spread)
        if e.effect in ("distant_shadow", "saturation"):  # a shadow is dark and a cut-off flat, or it is something else
            return (
                0.5 < float(e.amount[0]) < (10.0 if e.effect == "distant_shadow" else 2.0)
                and e.amount[0] ** 2 > 9 * e.covariance[0, 0]
            )
        return True

    def worth_image(self, e: ImageEvidence, count: int) -> bool:
        if e.p * count > GATE or e.gain < max(FLOOR_GAIN, 2 * e.gain_error) or e.fid < FLOOR_IMAGE:
            return False
        cls = get_effect(e.effect)
        if not cls.tolerance:
            return e.fid > 2 * FLOOR_IMAGE
        return e.rms > 1.1 * cls.tolerance[cls.parameters[0].name]

    def refine(self, steps: int = 2) -> None:
        """Gauss-Newton on all named scene-wide coordinates together; image-wide values are estimated anew."""
        fit(self.nominal, self.sites, self.base, self.units, self.measured)
        for _ in range(steps):
            works, parts = [], []
            wide = any(c.effect.name in EDGE_EFFECTS for c in self.causes)
            for chain in self.chains():
                work = ready(chain, self.dn, wide)
                works.append(work)
                extra = [edge_nuisance(chain, self.data)] if wide else []
                parts.append(gather_site(work, [], self.data, extra))
            joined = join(parts)
            if joined.count > 0:
                delta, error = solve_nuisance(joined)
                for cause in self.causes:
                    _move(cause, joined.names, delta, error)
            named = {c.effect.name: c for c in self.causes if c.effect.scope == "image"}
            found = weigh_images(works, list(named), self.frames, self.dn, self.data) if named else {}
            for name, cause in named.items():
                if name in found and name != "image_gain" and found[name].gain > FLOOR_GAIN:
                    cause.effect = as_effect(found[name], cause.effect, self.data)


def edge_nuisance(chain: Chain, data: Survey) -> tuple[str, list[Tensor]]:
    """Shadow edges blurred by relief below the DEM's resolution, by two widths: no matter of the Sun's disc."""
    cls = get_effect("penumbra")
    return "relief", [chain.render(cls({"radius_deg": r}, data)) - chain.textured for r in (1.6, 4.0)]


def start(evidence: Evidence, data: Survey) -> Effect:
    """The effect at its linear estimate, within bounds; coordinates of other guises are held at their null value."""
    cls = get_effect(evidence.effect)
    null = cls.null()
    values: dict[str, float] = {**null, **evidence.candidate.trial.fixed}
    touched = set(evidence.candidate.trial.fixed)
    cause_errors: dict[str, float] = {}
    for k, (amount, column) in enumerate(zip(evidence.amount.tolist(), evidence.candidate.trial.columns, strict=True)):
        for name, reference in column.items():
            low, high = cls.bounds(name)
            values[name] = min(max(values[name] + amount * (reference - null[name]), low), high)
            touched.add(name)
            if cls.name in (*EDGE_EFFECTS, "saturation", "macroscopic_roughness"):  # far from linear: near the trial
                share = min(max(amount, 0.3), 1.5)
                values[name] = min(max(null[name] + share * (reference - null[name]), low), high)
                if cls.name == "saturation":
                    values[name] = reference
            if cls.name in LINEAR:
                cause_errors[name] = abs(reference - null[name]) * float(evidence.covariance[k, k].clamp(min=0)) ** 0.5
    effect = cls(values, data)
    effect.first_errors = cause_errors  # type: ignore[attr-defined]
    still = {"axis", "side", "distance_px"}
    effect.held = tuple(p.name for p in cls.fitted() if p.name not in touched or p.name in still)  # type: ignore[attr-defined]
    return effect


def _as_good(first: Evidence, other: Evidence) -> bool:
    """Whether the paired difference of gains is within two standard errors."""
    if len(first.share) != len(other.share):
        return (
            other.gain > first.gain - 2 * math.hypot(first.gain_error, other.gain_error)
            and other.gain > 0.7 * first.gain
        )
    difference = first.share - other.share
    error = float(difference.std()) * math.sqrt(len(difference))
    return float(difference.sum()) < 2 * error and other.gain > 0.5 * first.gain


def _swap(data: Statistics, name: str, survey: Survey) -> Statistics:
    """The same statistics with one nuisance column as the only candidate."""
    j, m = data.names.index(name), data.count
    rest = [k for k in range(m) if k != j]
    order = [*rest, m, j]
    trial = get_effect(name).trials(survey)[0]
    return dataclasses.replace(
        data,
        candidates=[Candidate(name, trial, slice(0, 1))],
        names=[data.names[k] for k in rest],
        bound=data.bound[rest],
        products=data.products[:, order][:, :, order],
    )


def solve_nuisance(data: Statistics) -> tuple[Tensor, Tensor]:
    """Estimates and cluster-robust standard errors of all nuisance columns together."""
    m = data.count
    sums = data.products.sum(0)
    gram = sums[:m, :m] + torch.diag(data.bound**-2)
    scale = gram.diagonal().clamp(min=1e-30).rsqrt()
    normal = gram * scale[:, None] * scale + 1e-6 * torch.eye(m, dtype=torch.float64)
    inverse = torch.linalg.inv(normal) * scale[:, None] * scale
    delta = inverse @ sums[:m, m]
    score = data.products[:, :m, m] - torch.einsum("cml,l->cm", data.products[:, :m, :m], delta)
    variance = torch.zeros(m, dtype=torch.float64)
    for labels in (data.image, data.place):
        _, index = np.unique(labels, return_inverse=True)
        count = int(index.max()) + 1
        summed = torch.zeros(count, m, dtype=torch.float64).index_add_(0, torch.from_numpy(index), score)
        robust = inverse @ (summed.T @ summed) @ inverse * count / max(count - 1, 1)
        variance = torch.maximum(variance, robust.diagonal())
    return delta, variance.clamp(min=0).sqrt()


def _move(cause: Cause, names: Sequence[str], delta: Tensor, error: Tensor) -> None:
    cls = type(cause.effect)
    if cls.scope != "scene":
        return
    values = dict(cause.effect.values)
    for k, name in enumerate(names):
        owner, _, coordinate = name.partition(".")
        if owner != cls.name or not coordinate or cls.name in LINEAR:
            continue
        low, high = cls.bounds(coordinate)
        step = float(delta[k])
        if coordinate not in cls.null() or not math.isfinite(step):
            continue
        if coordinate in ("h", "lag_px", "radius_deg", "theta_bar_deg", "height_m", "iof") and cls.name != "dark_bias":
            size = abs(values[coordinate]) + 1e-9  # shapes: not more than half of themselves at a time
            step = min(max(step, -0.5 * size), 0.5 * size)
        values[coordinate] = min(max(values[coordinate] + step, low), high)
        cause.errors[coordinate] = float(error[k])
    moved = cls(values, cause.effect.survey)
    moved.held = getattr(cause.effect, "held", ())  # type: ignore[attr-defined]
    cause.effect = moved


def search(state: Search, most: int, say: Callable[[str], None]) -> Round:
    """Name causes one after the other; returns the last look, at what is left."""
    while True:
        seen = state.look()
        if len(state.causes) >= most:
            return seen
        cause = state.choose(seen)
        if cause is None:
            return seen
        cause.rms_before = state.residual_rms()
        kept = state.nominal.vector, [s.texture for s in state.sites], [(c, c.effect) for c in state.causes]
        state.causes.append(cause)
        state.refine()
        cause.rms_after = state.residual_rms()
        if not cause.rms_after < 1.02 * cause.rms_before:
            state.causes.pop()
            state.refused.add(cause.effect.name)
            state.nominal.vector = kept[0]
            for site, texture in zip(state.sites, kept[1], strict=True):
                site.texture = texture
            for known, effect in kept[2]:
                known.effect = effect
            if len(state.refused) > 3:
                return seen
            continue
        say(f"found {cause.effect.name}: gain {cause.gain:.0f} +- {cause.gain_error:.0f} nats")


def enough(sites: list[Site]) -> str:
    """Why nothing can be concluded from these data; empty where something can."""
    pixels = sum(int(s.valid.sum()) for s in sites)
    images = sum(s.count for s in sites)
    if pixels < 20_000:
        return f"{pixels} valid pixels are too few to conclude anything (20000 are the least)"
    if images < 4 or max((s.count for s in sites), default=0) < 1:
        return f"{images} images are too few to conclude anything (4 are the least)"
    return ""


__all__ = ["Cause", "Round", "Search", "enough", "search"]
