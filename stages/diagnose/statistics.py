"""Sufficient statistics of every candidate per cluster of pixels: all that follows is small linear algebra."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.columns import BASELINE, Candidate, nominal_columns, tangent_columns, trial_columns
from stages.diagnose.preparing import UNRESOLVED_SLOPES, SiteWork, clear_of_
from stages.effects import Survey, get_effect

BLOCK = 32  # px
SITE = 10_000  # between the numbers of two sites' first blocks ...
FRAMES = 100_000  # ... and of their first images
FREE = 1e6  # no bound


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
    def static(self) -> np.ndarray:
        """(C,) bool: clusters of maps of the ground, as against those of images."""
        return (self.image + 1) % FRAMES == 0

    @property
    def count(self) -> int:
        """Nuisance columns."""
        return len(self.names)


def gather_site(
    work: SiteWork, candidates: Sequence[Candidate], data: Survey, extra: Sequence[tuple[str, list[Tensor]]] = ()
) -> Statistics:
    """Statistics of one site; ``work.dynamic`` becomes what local columns and the nominal model's freedom leave."""
    chain, projector = work.chain, work.projector
    own = nominal_columns(chain)
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
    clear_of_(dynamic, static, s)
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
    nominal : take the nominal model's own freedom out of everything, the residual included: its fit, with other weights
    and to all sites, took an unknown part of the effect
    maps : which of the static maps count: albedo, and slopes to the east and south
    """
    projector, first = work.projector, len(nuisance)
    weighted = torch.stack([*(column for _, _, column in nuisance), work.residual, *columns]) * projector.weight
    if nominal:
        tangents = torch.stack(work.chain.surface_tangents()).mul_(projector.weight).flatten(1)
        gram = (tangents @ tangents.T).double()
        ridge = 1e-9 * torch.diag(gram.diagonal().clamp(min=1e-12))
        share = torch.linalg.solve(gram + ridge, (tangents @ weighted.flatten(1).T).double()).float()
        weighted.flatten(1).addmm_(share.T, tangents, alpha=-1)
    static = projector.whiten(projector.maps(projector.coefficients(weighted)))
    if not nominal:
        static[first] = work.static
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
    per_map = len(products[0]) if products else 0  # a site with few images has no map of slopes
    image = np.concatenate(
        [np.repeat(site.frames[: dynamic.shape[1]], per_map), np.full(static.shape[1] * per_map, -1)]
    )
    place = np.tile(np.arange(per_map), len(products)) + SITE * site.number
    # an image's faults are known for all of its sites, yet each site has a DEM error of its own
    image = image + FRAMES * site.number
    return Statistics(
        list(candidates), list(names), torch.tensor(bound, dtype=torch.float64), torch.cat(products or [dynamic.new_zeros(0, len(dynamic), len(dynamic))]).double(),
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
