"""The nominal simulation: a checkpoint's coefficient maps, or one smooth set of coefficients fitted to the data."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from schemas.errors import ArtefactError, RegistryError
from stages.diagnose.data.parallel import per_site
from stages.diagnose.data.sites import Site
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.laws import Departures, departures
from stages.diagnose.model.sampled import draw, sampled_fit
from stages.diagnose.settings import CORRELATED, GRAZING, LIT_MARGIN
from stages.effects import Effect
from stages.physics.photometry import ReflectanceModel, get_model

ROUNDS = 10
PULL = 0.05
SETTLED = 3e-4  # of the squared residual: a step that lowers it by less is the last
DAMPING = 0.1  # at first: the coefficients of a curved model imitate each other
DARK = 0.3  # of the predicted brightness
LEAST_SCATTER, MOST_SCATTER = (
    0.05,
    1.0,
)  # of the law's departures, in those of measured laws: more than these no ground is expected to have
BETWEEN = 0.03  # of a site's own level that the law answers for: the rest is the albedo of the ground, which differs from place to place by far more


@dataclass
class Nominal:
    """``vector`` (C,) scales maps (checkpoint) or is the set itself (fitted); ``free`` (C,) bool is what a fit may move.

    laws, amounts, scatter : directions in which the law may be another one, how much of each is fitted, (K,), and their estimated standard
        deviation, where measured lunar laws have 1
    maps : of every site, what the network says
    """

    model: ReflectanceModel
    vector: Tensor
    free: Tensor
    predictor: Any = None
    laws: Departures | None = None
    amounts: Tensor = field(default_factory=lambda: torch.zeros(0))
    scatter: float = 1.0
    maps: dict[int, Tensor] = field(default_factory=dict)

    @property
    def departs(self) -> bool:
        """Whether departures of the law are fitted and rendered: of a fitted sum of terms. A physical law keeps its own freedom."""
        return self.laws is not None and self.predictor is None and self.model.linear and bool(self.free.all())

    def alone(self) -> Nominal:
        """A copy without departures."""
        return dataclasses.replace(self, amounts=torch.zeros_like(self.amounts))

    def open_law(self, sites: Sequence[Site]) -> None:
        """Add the directions in which measured lunar laws differ from this one at the angles of these sites."""
        chains = per_site(lambda site: self.chain(site, []), sites)
        cosines, _, measured = draw(chains, [lit_mask(c) for c in chains], [s.image for s in sites])
        if len(measured):
            vector = self.vector if self.predictor is None else self.coefficients(sites[0]).mean((0, 2, 3))
            self.laws = departures(self.model, vector, cosines.flatten(1))
            self.amounts = torch.zeros(len(self.laws))

    def coefficients(self, site: Site) -> Tensor:
        """(1 or n, C, 1 or H, 1 or W)"""
        vector = self.vector[None, :, None, None]
        if self.predictor is None:
            return vector
        if site.number not in self.maps:
            self.maps[site.number] = self.predictor.coefficients(site.observation.elevation[:1])
        return self.maps[site.number] * vector

    def chain(self, site: Site, base: Sequence[Effect]) -> Chain:
        """The formation chain of one site with these effects."""
        free = self.free if self.predictor is None else None  # maps may still drift
        site.latest = Chain(site, self.model, self.coefficients(site), base, free, self.laws, self.amounts, site.latest)
        return site.latest


def load_nominal(checkpoint: Path | None, model: str, units: str, free: Sequence[str] = ()) -> Nominal:
    """From a checkpoint, or with default coefficients that :func:`fit` improves.

    free : the coefficients that it may move, the others stay at their published values; () for all
    Raises ArtefactError, RegistryError.
    """
    if checkpoint is None:
        reflectance = get_model(model)
        names = [p.name for p in reflectance.parameters]
        for name in free:
            if name not in names:
                raise RegistryError.unknown(f"coefficient of {model}", name, names)
        chosen = torch.tensor([not free or name in free for name in names])
        return Nominal(reflectance, torch.tensor([p.default for p in reflectance.parameters]), chosen)
    from stages.network.predictor import load_predictor

    predictor = load_predictor(checkpoint, "cpu")
    if predictor.image_units != units:
        raise ArtefactError(
            f"{checkpoint}: expected a checkpoint for images in '{units}', found one for '{predictor.image_units}'; "
            "train on the pairs that are to be diagnosed, or use `model`."
        )
    count = len(predictor.model.parameters)
    return Nominal(predictor.model, torch.ones(count), torch.zeros(count, dtype=torch.bool), predictor)


def lit_mask(chain: Chain) -> Tensor:
    """Valid pixels in full light, (n, H, W) bool."""
    return chain.site.valid & full_light(chain)


def full_light(chain: Chain) -> Tensor:
    """Ground in full light, clear of the horizon and of grazing incidence, seen by an image or not, (n, H, W) bool."""
    angles = chain.state.angles
    lit = (angles.cos_incidence > GRAZING) & (angles.cos_emission > 0.15)
    above = chain.height_above_horizon()
    return lit if above is None else lit & (above > LIT_MARGIN)


def fit(
    nominal: Nominal,
    sites: Sequence[Site],
    base: Sequence[Effect],
    units: str,
    measured: Sequence[Tensor],
    most: int = ROUNDS,
    start: bool = False,
    law: bool = False,
) -> None:
    """Least squares of the coefficients (and of gain and offset per pair where images are in dn), in place.

    measured : the images as read, one (n, H, W) per site; ``site.image`` becomes I/F
    most : rounds at most; one is enough for a linear model that was fitted to nearly the same before
    start : nothing is known of the coefficients yet; law : whether departures of the law are fitted as well
    """
    fitted = nominal.predictor is None
    if start:
        nominal.amounts = torch.zeros_like(nominal.amounts)
    if fitted and not nominal.model.linear and start:
        chains = per_site(lambda site: nominal.chain(site, base), sites)
        nominal.vector = sampled_fit(
            nominal.model,
            nominal.vector,
            nominal.free,
            chains,
            [lit_mask(c) for c in chains],
            measured,
            units == "dn",
            PULL,
        )
    rounds = min((ROUNDS if units == "dn" or not nominal.model.linear else 3) if fitted else int(units == "dn"), most)
    if not fitted or nominal.model.linear:
        for _ in range(rounds):
            gram, score, cost, count = _normal_equations(nominal, sites, base, units, measured, fitted, law)
            _drawn_to_measured(nominal, gram, score, cost)
            if (
                fitted
                and _step(nominal, gram, score, 1e-7 if units == "iof" else DAMPING / 100) < SETTLED * cost * count
            ):
                break
        return
    best, damping = (math.inf, nominal.vector), DAMPING  # Levenberg (1944), Marquardt (1963)
    for k in range(rounds + 1):
        gram, score, cost, count = _normal_equations(nominal, sites, base, units, measured, True)
        cost += _drawn_to_published(nominal, gram, score, cost, count)
        settled = abs(cost - best[0]) < SETTLED * best[0] or k == rounds
        if cost < best[0]:
            best, damping, equations = (cost, nominal.vector), max(damping / 3, 1e-7), (gram, score)
        else:
            nominal.vector, damping = best[1], damping * 10
        if settled or _step(nominal, *equations, damping) < SETTLED * best[0] * count * min(DAMPING / damping, 1):
            break
    nominal.vector = best[1]
    if units == "dn" and cost > best[0]:  # gains and offsets go with the coefficients
        _normal_equations(nominal, sites, base, units, measured, False)


def _step(nominal: Nominal, gram: Tensor, score: Tensor, damping: float) -> float:
    """Move the free coefficients, and the departures of the law, by a damped step; returns by how much it lowers the sum of squares, to first order."""
    felt = gram.diagonal() > 1e-12 * gram.diagonal().max()  # a width without its amplitude changes nothing
    low = torch.tensor([p.lower for p in nominal.model.parameters])[nominal.free]
    high = torch.tensor([p.upper for p in nominal.model.parameters])[nominal.free]
    at = nominal.vector[nominal.free]
    if not nominal.model.linear:  # at a bound, and drawn beyond it
        felt &= ~((at <= low) & (score < 0) | (at >= high) & (score > 0))
    if not bool(felt.any()):
        return 0.0
    scale = gram.diagonal()[felt].rsqrt()
    normal = gram[felt][:, felt] * scale[:, None] * scale + damping * torch.eye(len(scale), dtype=torch.float64)
    move = torch.linalg.solve(normal, score[felt] * scale) * scale
    moves = torch.zeros(len(gram))
    moves[felt] = move.float()
    moved = at + moves[: len(at)]
    nominal.vector = nominal.vector.clone()
    nominal.vector[nominal.free] = moved if nominal.model.linear else moved.clamp(min=low, max=high)
    nominal.amounts = nominal.amounts + moves[len(at) :] if len(moves) > len(at) else nominal.amounts
    return float(score[felt] @ move)


def _normal_equations(
    nominal: Nominal,
    sites: Sequence[Site],
    base: Sequence[Effect],
    units: str,
    measured: Sequence[Tensor],
    fitted: bool,
    law: bool = False,
) -> tuple[Tensor, Tensor, float, float]:
    """Gram matrix and score of the coefficients (zero unless ``fitted``), the mean squared residual, its pixels."""
    count_free = int(nominal.free.sum()) + (len(nominal.amounts) if law and nominal.departs else 0)
    gram = torch.zeros(count_free, count_free, dtype=torch.float64)
    score = torch.zeros(count_free, dtype=torch.float64)
    cost, count = 0.0, 0.0
    chains = per_site(lambda site: nominal.chain(site, base), sites)
    masks = [lit_mask(chain) & chain.site.counts for chain in chains]
    if units == "dn":
        for chain, raw, mask in zip(chains, measured, masks, strict=True):
            scale_images(chain.site, raw, chain.rendered, mask)
    dark = DARK * _brightness(chains, masks)

    def of(place: int) -> tuple[Tensor, Tensor, float, float]:
        chain = chains[place]
        site, predicted = chain.site, chain.rendered
        # darker: in the shadow of something that the horizon does not know
        mask = masks[place] & (site.image > dark * predicted)
        # relative weights: every image counts alike, however low its Sun
        level = (site.image * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
        if units == "dn":  # as it was read: an image that lies beside the ground has a low gain, and says little
            level = level + site.offset / site.gain
        weight = (mask / level.clamp(min=1e-6)[:, None, None]).double()
        weight = weight * _near(site.image - predicted, weight)
        residual = (site.image - predicted).double() * weight
        residual = residual.flatten()
        flat = residual.new_zeros(count_free, len(residual) if fitted else 1)
        if fitted:
            columns = chain.surface_tangents() + (chain.form_tangents() if law and nominal.departs else [])
            flat = (torch.stack(columns) * weight).flatten(1)
            if units == "iof" and int(site.counts.sum()) > 1:
                common = torch.nn.functional.normalize((predicted * weight).flatten(), dim=0)
                residual, flat = (x - (1 - BETWEEN) * (x @ common)[..., None] * common for x in (residual, flat))
        on = flat @ residual if fitted else flat[:, 0]
        return flat @ flat.T, on, float(residual.square().sum()), float((weight > 0).sum())

    for products, on, squares, pixels in per_site(of, range(len(chains))):
        gram += products
        score += on
        cost, count = cost + squares, count + pixels
    return gram, score, cost / max(count, 1.0), count


def _drawn_to_published(nominal: Nominal, gram: Tensor, score: Tensor, cost: float, count: float) -> float:
    """Add the pull of a curved model's published coefficients to the normal equations; returns its share of the cost.

    Films and detectors of unknown gain leave the level open, and the nine of Hapke's model imitate each other: nothing
    is gained by an albedo of zero.
    """
    if nominal.model.linear:
        return 0.0
    every = nominal.model.parameters
    published = torch.tensor([p.default for p in every])[nominal.free].double()
    width = torch.tensor([(p.upper - p.lower) / 4 for p in every])[nominal.free].double()
    away = (nominal.vector[nominal.free].double() - published) / width
    pull = PULL * cost * count / len(width)
    gram += torch.diag(pull / width.square())
    score -= pull * away / width
    return PULL * cost * float(away.square().mean())


def _drawn_to_measured(nominal: Nominal, gram: Tensor, score: Tensor, cost: float) -> None:
    """Add the prior of the law's departures to the normal equations."""
    count = len(nominal.amounts)
    if len(gram) > int(nominal.free.sum()):
        pull = cost * CORRELATED * nominal.scatter**-2
        gram[-count:, -count:] += pull * torch.eye(count, dtype=torch.float64)
        score[-count:] -= pull * nominal.amounts.double()


def _brightness(chains: Sequence[Chain], masks: Sequence[Tensor]) -> float:
    """Measured over predicted brightness, the median over the images of each one's median over lit pixels."""
    ratios = []
    for chain, mask in zip(chains, masks, strict=True):
        ratio = chain.site.image / chain.rendered.clamp(min=1e-6)
        ratios += [float(r[m].median()) for r, m in zip(ratio, mask, strict=True) if int(m.sum()) > 50]
    return max(float(torch.tensor(ratios).median()), 0.0) if ratios else 0.0


def _near(residual: Tensor, weight: Tensor) -> Tensor:
    """1 where a weighted residual is within five robust deviations of its image's median: shadows of unknown walls are not."""
    out = torch.zeros_like(weight)
    for k, (r, w) in enumerate(zip(residual * weight, weight, strict=True)):
        used = r[w > 0]
        if len(used):
            middle = used.median()
            width = 1.4826 * (used - middle).abs().median()
            out[k] = (r - middle).abs() < 5 * width + 1e-9
    return out


def scale_images(site: Site, raw: Tensor, predicted: Tensor, mask: Tensor) -> None:
    """Gain and offset per pair by least squares; the image in I/F follows."""
    weight = mask.double()
    n = weight.sum((-2, -1)).clamp(min=1)
    mx = (predicted * weight).sum((-2, -1)) / n
    my = (raw * weight).sum((-2, -1)) / n
    dx = (predicted - mx[:, None, None]) * weight
    gain = (dx * raw).sum((-2, -1)) / (dx * dx).sum((-2, -1)).clamp(min=1e-12)
    usable = gain > 1e-9  # brighter is brighter: an image that lies beside the ground may say otherwise
    gain = torch.where(usable, gain, my / mx.clamp(min=1e-9))
    site.gain = gain.float()
    site.offset = torch.where(usable, my - gain * mx, 0.0).float()
    site.image = ((raw - site.offset[:, None, None]) / site.gain[:, None, None]).float()


def relative_misfit(nominal: Nominal, sites: Sequence[Site], varied: bool = False, whole: bool = False) -> float:
    """rms residual over the mean brightness of lit pixels; ``whole``: over the rms of the images (``varied``: their means taken out)."""

    def of(site: Site) -> tuple[float, float, float]:
        chain = nominal.chain(site, [])
        mask = lit_mask(chain)
        left = ((site.image - chain.predict()) * mask).double()
        light = (site.image * mask).double()
        if varied:
            level = light.sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
            light = (light - level[:, None, None]) * mask
            size = site.gain[:, None, None].abs().double()  # as read: a gain fitted too low would blow both up
            left, light = left * size, light * size
        return float(left.square().sum()), float(light.square().sum() if whole else light.sum()), float(mask.sum())

    left, light, count = (sum(x) for x in zip(*per_site(of, sites), strict=True))
    if count == 0 or light <= 0:
        return math.inf
    return math.sqrt(left / light) if whole else math.sqrt(left / count) / (light / count)
