"""Sufficient statistics of every candidate per cluster of pixels: all that follows is small linear algebra."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.diagnose.data import GRAZING, Site
from stages.diagnose.projection import Local, Projector
from stages.effects import Effect, Survey, Trial, get_effect

BLOCK = 32  # px
SITE = 10_000  # between the numbers of two sites' first blocks
CUT = math.radians(15)  # photometric effects are judged where neither slope nor shadow is a matter of sub-pixel relief
DEEP = math.radians(2)  # below the horizon: shadow, whatever the DEM's errors
OUTLIER = 7.0  # sigma
QUIETEST = 0.002  # noise over mean brightness: an image that looks quieter is dark
SHOT = 0.8  # share of shot noise in the noise's variance at mean brightness
EDGE = math.radians(6.0)  # relief below the DEM's resolution blurs shadows over a band like this ...
DOUBT = 0.3  # ... by up to this share of the lit brightness
# What every data set has a little of, always fitted along, with the size that is ordinary (multiples of the column):
# without a bound on it a strange amount of one imitates other effects.
BASELINE = {"dem_smoothing": 0.7, "psf_blur": 0.4}
UNRESOLVED_SLOPES = 1.0
FREE = 1e6  # no bound


@dataclass(frozen=True)
class Candidate:
    """An effect in one of its guises, and which columns are its."""

    effect: str
    trial: Trial
    columns: slice

    @property
    def size(self) -> int:
        return self.columns.stop - self.columns.start


@dataclass
class SiteWork:
    """A site made ready: weights, projection, and what is left of the measurement.

    residual : (n, H, W), I/F, measured minus predicted; albedo : (H, W), relative albedo of the ground beyond the
    prediction, not whitened; static : (K, H, W), whitened maps of the residual; dynamic : (n, H, W), the residual's
    dynamic rows once everything local and the nominal model's own freedom are taken out; slope_error : rms per axis of the
    apparent slope errors, as tangent, by their median, NaN where images are too few
    """

    chain: Chain
    projector: Projector
    local: Local
    residual: Tensor
    albedo: Tensor
    static: Tensor
    dynamic: Tensor
    slope_error: float = math.nan

    def remains(self) -> Remains:
        return Remains(self.chain.site, self.projector.weight, self.albedo, self.dynamic, self.slope_error)


@dataclass
class Remains:
    """What is kept of a site's work while other sites are worked on; names as in :class:`SiteWork`."""

    site: Site
    weight: Tensor
    albedo: Tensor
    dynamic: Tensor
    slope_error: float


@dataclass
class Statistics:
    """Per cluster the products of m nuisance columns, the residual and E candidate columns.

    products : (C, m + 1 + E, m + 1 + E); bound : (m,) ordinary sizes of the nuisances
    image, place : (C,) cluster numbers
    """

    candidates: list[Candidate]
    names: list[str]  # of the nuisance columns
    bound: Tensor
    products: Tensor
    image: np.ndarray
    place: np.ndarray
    rows: float  # dynamic degrees of freedom

    @property
    def count(self) -> int:
        """Nuisance columns."""
        return len(self.names)


def ready(chain: Chain, dn: bool, wide: bool = False) -> SiteWork:
    """Weights from the residual's own scatter, the projector, the texture. ``wide`` keeps the pixels about shadow edges."""
    site = chain.site
    weight = _first_weight(chain, wide)
    residual = torch.where(site.valid, site.image - chain.textured, 0.0)
    level = (chain.textured * site.valid).sum((-2, -1)) / site.valid.sum((-2, -1)).clamp(min=1)
    most = 1 / (QUIETEST * level.clamp(min=1e-6))[:, None, None]

    def split() -> tuple[Projector, Tensor, Tensor]:
        projector = Projector(chain, weight)
        weighted = (residual * weight)[None]
        on_basis = projector.coefficients(weighted)
        return projector, projector.project_(weighted, on_basis)[0], projector.maps(on_basis)[0]

    projector, dynamic, maps = split()
    for _ in range(2):
        if len(weight) < 2:  # one image: its noise and the ground's texture cannot be told apart
            weight = weight / float((residual * weight).square()[weight > 0].mean().clamp(min=1e-12)) ** 0.5
        else:
            weight = weight * _rescale(dynamic, projector)[:, None, None]
            if not wide:  # what no smooth effect can do: shadows of unknown walls, cut-off highlights, dead pixels
                gross = dynamic.abs() > OUTLIER
                if float(gross.sum()) < 0.3 * float((weight > 0).sum()):
                    weight = weight * ~gross
        weight = weight.minimum(most)
        projector, dynamic, maps = split()
    # the prediction moves the texture along with the ground; the static rows are about all of it
    maps[0] += site.texture - 1
    if len(weight) >= 3:
        site.texture = (1 + maps[0]).clamp(0.4, 2.5)
        chain.textured = chain.render()
    projector.learn_spectrum(maps)
    local = Local(projector, nuisance_columns(chain, dn))
    slopes = float(maps[1:].square().sum(0).median() / (2 * math.log(2))) ** 0.5 if len(maps) > 1 else math.nan
    return SiteWork(chain, projector, local, residual, maps[0], projector.whiten(maps[None])[0], dynamic, slopes)


def left_over(chain: Chain, weight: Tensor, dn: bool) -> float:
    """Sum of squares of the dynamic residual at given weights, without shifts, unresolved slopes, the nominal model's freedom."""
    projector = Projector(chain, weight)
    # values per image stay as they are, or they would have a set for each site here
    local = Local(projector, nuisance_columns(chain, dn, named=False))
    residual = chain.site.image - chain.textured
    columns = torch.stack([*_site_columns(chain), chain.unresolved_slopes(), residual]) * weight
    on_basis = projector.coefficients(columns)
    local.remove_(columns, on_basis)
    projector.project_(columns, on_basis)
    _without_(columns, columns.new_zeros(len(columns), 0, 1, 1), len(columns) - 1)
    return float(columns[-1].double().square().sum())


def _first_weight(chain: Chain, wide: bool) -> Tensor:
    """1 / expected noise, (n, H, W): shot and read noise, and doubt where shadows end."""
    site, state = chain.site, chain.state
    predicted = chain.textured
    mean = (predicted * site.valid).sum((-2, -1)) / site.valid.sum((-2, -1)).clamp(min=1)
    mean = mean.clamp(min=1e-6)[:, None, None]
    variance = (0.02 * mean) ** 2 * (1 - SHOT + SHOT * (predicted / mean).clamp(min=0))
    above = chain.height_above_horizon()
    mu0 = state.angles.cos_incidence
    use = site.valid & ((mu0 > GRAZING) | (mu0 < -GRAZING)) & (state.angles.cos_emission > 0.15)
    rising = torch.asin(mu0.clamp(-1, 1))  # the Sun above the facet's own plane
    if above is not None:
        rising = torch.minimum(above, rising)
    else:
        use &= mu0 > GRAZING
    if not wide and float((use & (rising > CUT)).sum()) > 0.1 * float(use.sum()):
        use &= (rising > CUT) | ((above < -DEEP) if above is not None else torch.zeros_like(use))
    edge = torch.where(mu0 > 0 if above is None else above > 0, EDGE, 0.3 * EDGE)
    doubt = DOUBT * (state.reflectance + 0.2 * mean) * torch.exp(-rising.abs() / edge)
    variance = variance + doubt**2
    return use * variance.clamp(min=1e-14).rsqrt()


def _rescale(dynamic: Tensor, projector: Projector) -> Tensor:
    """Per image, 1 / robust scatter of weighted rows that should have unit noise.

    The projection takes the more from an image the larger its weight: each row is judged by the variance it has left,
    and no image is believed to be much quieter than the others, or its weight would run away.
    """
    weight = projector.weight
    left = (1 - sum(q.square() for q in projector.basis)).clamp(min=0.02).sqrt()
    out = torch.ones(len(dynamic))
    for k, (row, w, share) in enumerate(zip(dynamic, weight, left, strict=True)):
        used = (row / share)[w > 0]
        if len(used) > 50:
            out[k] = 1 / max(1.4826 * float((used - used.median()).abs().median()), 1e-3)
    return out.clamp(max=float(2 * out.median())).clamp(0.2, 5.0)


def nuisance_columns(chain: Chain, dn: bool, named: bool = True) -> Tensor:
    """(n, k, H, W): shift east and south, for dn images gain and offset, and image-wide effects ``named`` already."""
    image = chain.textured
    east = torch.zeros_like(image)
    south = torch.zeros_like(image)
    east[..., 1:-1] = (image[..., 2:] - image[..., :-2]) / 2
    south[..., 1:-1, :] = (image[..., 2:, :] - image[..., :-2, :]) / 2
    columns = [east, south]
    if dn:
        columns += [image, torch.full_like(image, float(image.mean()))]
    for k, effect in enumerate(chain.base if named else ()):
        if effect.scope == "image":
            columns += list(image_columns(chain, type(effect), k))
    for effect in chain.moved if named else ():
        if effect.name != "misregistration":  # shifts are there already
            columns += list(image_columns(chain, type(effect)))
    return torch.stack(columns, 1)


def image_columns(chain: Chain, cls: type[Effect], place: int | None = None) -> list[Tensor]:
    """d image / d coordinate for an effect with one value per image, (n, H, W) each."""
    frames = int(chain.site.observation.frame.max()) + 1
    out = []
    for parameter in cls.fitted():
        step = 0.2 * cls.strong[parameter.name]
        if place is None:
            moved = chain.render(cls({parameter.name: torch.full((frames,), step)}, None))
        else:
            values = dict(chain.base[place].values)
            values[parameter.name] = values[parameter.name] + step
            moved = chain.replace(place, cls(values, chain.base[place].survey))
        out.append((moved - chain.textured) / step)
    return out


def make_candidates(names: Sequence[str], data: Survey) -> list[Candidate]:
    """Every guise of every effect, with its place among the columns."""
    out, start = [], 0
    for name in names:
        for trial in get_effect(name).trials(data):
            out.append(Candidate(name, trial, slice(start, start + len(trial.columns))))
            start += len(trial.columns)
    return out


def trial_columns(chain: Chain, effect: str, trial: Trial, data: Survey) -> list[Tensor]:
    """(n, H, W) each: what the effect at the trial's values adds to the image."""
    cls = get_effect(effect)
    return [chain.render(cls({**trial.fixed, **column}, data)) - chain.textured for column in trial.columns]


def tangent_columns(chain: Chain, data: Survey) -> tuple[list[str], list[Tensor]]:
    """d image / d coordinate for the scene-wide effects that are in the chain already."""
    names, columns = [], []
    for k, effect in enumerate(chain.base):
        if effect.scope != "scene" or effect.channel in ("albedo", "relief"):
            continue  # what stays with the ground is estimated there
        for coordinate in free_coordinates(effect):
            names.append(f"{effect.name}.{coordinate}")
            columns.append(tangent(chain, k, coordinate, data))
    return names, columns


def tangent(chain: Chain, place: int, coordinate: str, data: Survey) -> Tensor:
    """d image / d coordinate of the effect at ``place`` in the chain, (n, H, W)."""
    effect = chain.base[place]
    step = derivative_step(type(effect), coordinate, data)
    moved = type(effect)({**effect.values, coordinate: float(effect.values[coordinate]) + step}, data)
    return (chain.replace(place, moved) - chain.textured) / step


def free_coordinates(effect: Effect) -> list[str]:
    """The coordinates that stay free once an effect is named: those of its best guise and its shape."""
    return [p.name for p in effect.fitted() if p.name not in effect.held]


def derivative_step(cls: type[Effect], coordinate: str, data: Survey) -> float:
    """A step for finite differences: a tenth of a realistic size."""
    for trial in cls.trials(data):
        for column in trial.columns:
            if coordinate in column:
                return 0.1 * abs(column[coordinate] - cls.null()[coordinate]) or 1e-3
    parameter = next(p for p in cls.fitted() if p.name == coordinate)
    return max(0.05 * abs(parameter.default), 1e-3 * (parameter.upper - parameter.lower))


def gather_site(
    work: SiteWork, candidates: Sequence[Candidate], data: Survey, extra: Sequence[tuple[str, list[Tensor]]] = ()
) -> Statistics:
    """Statistics of one site; ``work.dynamic`` becomes what local columns and the nominal model's freedom leave."""
    chain, projector = work.chain, work.projector
    own = _site_columns(chain)
    names, nuisance = tangent_columns(chain, data)
    bound = [FREE] * len(names)
    for effect, ordinary in BASELINE.items():
        if effect not in [e.name for e in chain.base]:
            names.append(effect)
            bound.append(ordinary)
            nuisance += trial_columns(chain, effect, get_effect(effect).trials(data)[0], data)
    names.append("unresolved_slopes")
    bound.append(UNRESOLVED_SLOPES)
    nuisance.append(chain.unresolved_slopes())
    for name, more in extra:
        names += [f"{name}{k}" for k in range(len(more))]
        bound += [FREE] * len(more)
        nuisance += more
    s, m = len(own), len(names)
    count = s + m + 1 + sum(c.size for c in candidates)
    columns = torch.empty(count, *work.residual.shape)
    for k, column in enumerate([*own, *nuisance, work.residual]):
        torch.mul(column, projector.weight, out=columns[k])
    k = s + m + 1
    for candidate in candidates:
        for column in trial_columns(chain, candidate.effect, candidate.trial, data):
            torch.mul(column, projector.weight, out=columns[k])
            k += 1
    dynamic, static = _rows_(work, columns, s + m)
    _without_(dynamic, static, s)
    work.dynamic = dynamic[s + m].clone()
    return _reduce(work, candidates, names, bound, dynamic[s:], static[s:])


def gather_static(
    work: SiteWork,
    candidates: Sequence[Candidate],
    columns: Sequence[Tensor],
    nuisance: Sequence[tuple[str, float, Tensor]] = (),
    nominal: bool = False,
    maps: slice = slice(None),
) -> Statistics:
    """Statistics from the static rows alone, for what stays with the ground: albedo that follows terrain, a DEM's faults.

    Such effects leave no trace in the dynamic rows, while nuisances that the dynamic rows fix would carry their own
    errors into the static ones. Clusters are blocks of ground.

    columns : (n, H, W) each, the candidates'; nuisance : name, ordinary size and column
    nominal : take out what the nominal model, fitted to images that hold the effect, took of it
    maps : which of the static maps count: albedo, and slopes to the east and south
    """
    weighted = torch.stack([*(column for _, _, column in nuisance), *columns]) * work.projector.weight
    if nominal:
        tangents = torch.stack(work.chain.surface_tangents()).mul_(work.projector.weight).flatten(1)
        gram = (tangents @ tangents.T).double()
        ridge = 1e-9 * torch.diag(gram.diagonal().clamp(min=1e-12))
        share = torch.linalg.solve(gram + ridge, (tangents @ weighted.flatten(1).T).double()).float()
        weighted.flatten(1).addmm_(share.T, tangents, alpha=-1)
    rows = work.projector.whiten(work.projector.maps(work.projector.coefficients(weighted)))
    first = len(nuisance)
    static = torch.cat([rows[:first], work.static[None], rows[first:]])
    names, bounds = [n for n, _, _ in nuisance], [b for _, b, _ in nuisance]
    out = _reduce(work, candidates, names, bounds, static[:, :0], static[:, maps])
    out.image = out.place
    return out


def _rows_(work: SiteWork, columns: Tensor, residual: int) -> tuple[Tensor, Tensor]:
    """Weighted columns, in place -> dynamic rows without the local columns (E, n, H, W), and static rows (E, K, H, W)."""
    projector = work.projector
    on_basis = projector.coefficients(columns)
    static = projector.whiten(projector.maps(on_basis))
    static[residual] = work.static
    work.local.remove_(columns, on_basis)
    return projector.project_(columns, on_basis), static


def _site_columns(chain: Chain) -> list[Tensor]:
    """The nominal model's freedom within a site: each coefficient may change and drift across the crop."""
    tangents = chain.surface_tangents()
    height, width = tangents[0].shape[-2:]
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    return [t * f for t in tangents for f in (torch.ones(()), x, y)]


def _without_(dynamic: Tensor, static: Tensor, count: int) -> None:
    """Make all rows orthogonal to the first ``count``, in place."""
    d, t = dynamic.flatten(1), static.flatten(1)
    gram = (d[:count] @ d.T + t[:count] @ t.T).double()
    scale = gram.diagonal().clamp(min=1e-30).rsqrt()
    normal = gram[:, :count] * scale[:, None] * scale + 1e-6 * torch.eye(count, dtype=torch.float64)
    share = (torch.linalg.solve(normal, scale[:, None] * gram[:, count:]) * scale[:, None]).float()
    d[count:].addmm_(share.T, d[:count], alpha=-1)
    t[count:].addmm_(share.T, t[:count], alpha=-1)


def _reduce(
    work: SiteWork,
    candidates: Sequence[Candidate],
    names: list[str],
    bound: list[float],
    dynamic: Tensor,
    static: Tensor,
) -> Statistics:
    """Rows (m + 1 + E, ...) -> products per cluster: a block of an image, or of a map."""
    site = work.chain.site
    size = min(BLOCK, max(8, min(site.image.shape[-2:]) // 4))
    products = [_block_products(rows, size) for every in (dynamic, static) for rows in every.unbind(1)]
    per_map = len(products[0])
    image = np.concatenate(
        [np.repeat(site.frames[: dynamic.shape[1]], per_map), np.full(static.shape[1] * per_map, -1)]
    )
    place = np.tile(np.arange(per_map), len(products)) + SITE * site.number
    # an image's faults are known for all of its sites, yet each site has a DEM error of its own
    image = image + 100_000 * site.number
    return Statistics(
        list(candidates), list(names), torch.tensor(bound, dtype=torch.float64), torch.cat(products).double(),
        image, place, float(max(work.projector.dynamic_rows, 1)),
    )  # fmt: skip


def _block_products(columns: Tensor, size: int) -> Tensor:
    """(E, H, W) -> inner products within each block, (blocks, E, E); edges filled with zeros."""
    height, width = columns.shape[-2:]
    if height % size or width % size:
        columns = torch.nn.functional.pad(columns, (0, -width % size, 0, -height % size))
    e, height, width = columns.shape
    cut = columns.view(e, height // size, size, width // size, size).permute(1, 3, 0, 2, 4).reshape(-1, e, size * size)
    return torch.bmm(cut, cut.transpose(1, 2))


def without(data: Statistics, drop: Sequence[str], candidates: Sequence[Candidate]) -> Statistics:
    """The same statistics with some nuisances ignored and of the candidates only those."""
    keep = [k for k, name in enumerate(data.names) if name not in drop]
    first = data.count + 1
    columns = [k for c in candidates for k in range(first + c.columns.start, first + c.columns.stop)]
    order = [*keep, data.count, *columns]
    placed, start = [], 0
    for c in candidates:
        placed.append(dataclasses.replace(c, columns=slice(start, start + c.size)))
        start += c.size
    return dataclasses.replace(
        data,
        candidates=placed,
        names=[data.names[k] for k in keep],
        bound=data.bound[keep],
        products=data.products[:, order][:, :, order],
    )


def given(data: Statistics, known: Candidate) -> Statistics:
    """The same statistics with one candidate's columns among the nuisances, and without its effect's other guises."""
    first = data.count + 1
    own = list(range(first + known.columns.start, first + known.columns.stop))
    order = [*range(data.count), *own, data.count]
    placed, start = [], 0
    for c in data.candidates:
        if c.effect != known.effect:
            placed.append(dataclasses.replace(c, columns=slice(start, start + c.size)))
            order += range(first + c.columns.start, first + c.columns.stop)
            start += c.size
    return dataclasses.replace(
        data,
        candidates=placed,
        names=[*data.names, *(f"{known.effect}{k}" for k in range(len(own)))],
        bound=torch.cat([data.bound, torch.full((len(own),), FREE, dtype=torch.float64)]),
        products=data.products[:, order][:, :, order],
    )


def swap(data: Statistics, name: str, survey: Survey) -> Statistics:
    """The same statistics with one nuisance column as the only candidate."""
    j, m = data.names.index(name), data.count
    rest = [k for k in range(m) if k != j]
    order = [*rest, m, j]
    return dataclasses.replace(
        data,
        candidates=[Candidate(name, get_effect(name).trials(survey)[0], slice(0, 1))],
        names=[data.names[k] for k in rest],
        bound=data.bound[rest],
        products=data.products[:, order][:, :, order],
    )


def join(parts: Sequence[Statistics]) -> Statistics:
    """Statistics of several sites as one."""
    first = parts[0]
    return Statistics(
        first.candidates,
        first.names,
        first.bound,
        torch.cat([p.products for p in parts]),
        np.concatenate([p.image for p in parts]),
        np.concatenate([p.place for p in parts]),
        sum(p.rows for p in parts),
    )
