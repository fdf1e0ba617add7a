"""Sufficient statistics of every candidate per cluster of pixels: all that follows is small linear algebra."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.diagnose.data import GRAZING
from stages.diagnose.projection import Local, Projector, Rows
from stages.effects import Effect, Survey, Trial, get_effect

BLOCK = 32  # px
CUT = math.radians(15)  # photometric effects are judged where neither slope nor shadow is a matter of sub-pixel relief
DEEP = math.radians(2)  # below the horizon: shadow, whatever the DEM's errors
OUTLIER = 7.0  # sigma
SHOT = 0.8  # share of shot noise in the noise's variance at mean brightness
EDGE = math.radians(6.0)  # relief below the DEM's resolution blurs shadows over a band like this ...
DOUBT = 0.3  # ... by up to this share of the lit brightness
BASELINE = ("dem_smoothing", "psf_blur")  # what every data set has a little of: always fitted along


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
    """A site made ready: weights, projection, residual rows with the local nuisance removed."""

    chain: Chain
    projector: Projector
    local: Local
    residual: Tensor  # (n, H, W), I/F, measured minus predicted
    albedo: Tensor  # (H, W), relative albedo of the ground beyond the prediction, not whitened
    rows: Rows  # of the residual alone, (1, ...), local nuisance removed
    raw_rows: Rows  # the same before that


@dataclass
class Statistics:
    """Per cluster: m nuisance columns, the residual, E candidate columns.

    nuisance : (C, m + 1, m + 1) products of [nuisance, residual]; cross : (C, E, m + 1)
    grams : per candidate (C, K, K); image, place : (C,) cluster numbers; total : (E, E)
    """

    candidates: list[Candidate]
    names: list[str]  # of the nuisance columns
    nuisance: Tensor
    cross: Tensor
    grams: list[Tensor]
    image: np.ndarray
    place: np.ndarray
    total: Tensor
    rows: float  # dynamic degrees of freedom
    power: float  # sum of squares of the dynamic residual rows
    static_cluster: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))


def ready(chain: Chain, dn: bool, wide: bool = False) -> SiteWork:
    """``wide`` keeps the pixels about shadow edges. Weights from the residual's own scatter, the projector, the texture and the residual's rows."""
    site = chain.site
    weight = _first_weight(chain, wide)
    residual = torch.where(site.valid, site.image - chain.textured, 0.0)
    for _ in range(2):
        projector = Projector(chain, weight)
        dynamic, maps = projector.split(residual[None])
        if len(weight) < 2:
            break
        weight = weight * _rescale(dynamic[0], projector)[:, None, None]
        if not wide:  # what no smooth effect can do: shadows of unknown walls, cut-off highlights, dead pixels
            gross = dynamic[0].abs() > OUTLIER
            if float(gross.sum()) < 0.3 * float((weight > 0).sum()):
                weight = weight * ~gross
    projector = Projector(chain, weight)
    dynamic, maps = projector.split(residual[None])
    if len(weight) < 2:  # one image: its noise and the ground's texture cannot be told apart
        weight = weight / float((residual * weight).square()[weight > 0].mean().clamp(min=1e-12)) ** 0.5
        projector = Projector(chain, weight)
        dynamic, maps = projector.split(residual[None])
    # the prediction moves the texture along with the ground; the static rows are about all of it
    maps[:, 0] += site.texture - 1
    if len(weight) >= 3:
        site.texture = (1 + maps[0, 0]).clamp(0.4, 2.5)
        chain.textured = chain.render()
    projector.learn_spectrum(maps[0])
    local = Local(projector, nuisance_columns(chain, dn))
    raw = Rows(dynamic, projector.whiten(maps))
    return SiteWork(chain, projector, local, residual, maps[0, 0], local.remove(raw), raw)


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


def nuisance_columns(chain: Chain, dn: bool) -> Tensor:
    """(n, k, H, W): shift east and south, for dn images gain and offset, and image-wide effects named already."""
    image = chain.textured
    east = torch.zeros_like(image)
    south = torch.zeros_like(image)
    east[..., 1:-1] = (image[..., 2:] - image[..., :-2]) / 2
    south[..., 1:-1, :] = (image[..., 2:, :] - image[..., :-2, :]) / 2
    columns = [east, south]
    if dn:
        columns += [image, torch.full_like(image, float(image.mean()))]
    for k, effect in enumerate(chain.base):
        if effect.scope == "image" and effect.name != "misregistration":
            columns += list(image_columns(chain, type(effect), k))
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
        if effect.scope != "scene":
            continue
        for coordinate in free_coordinates(effect):
            value = float(effect.values[coordinate])
            step = derivative_step(type(effect), coordinate, data)
            moved = type(effect)({**effect.values, coordinate: value + step}, data)
            names.append(f"{effect.name}.{coordinate}")
            columns.append((chain.replace(k, moved) - chain.textured) / step)
    return names, columns


def free_coordinates(effect: Effect) -> list[str]:
    """The coordinates that stay free once an effect is named: those of its best guise and its shape."""
    fixed = getattr(effect, "held", ())
    return [p.name for p in effect.fitted() if p.name not in fixed]


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
) -> tuple[Statistics, Rows, Rows]:
    """Statistics of one site, with the candidates' and nuisance rows for whoever needs more."""
    chain = work.chain
    columns: list[Tensor] = []
    for candidate in candidates:
        columns += trial_columns(chain, candidate.effect, candidate.trial, data)
    names, nuisance = tangent_columns(chain, data)
    for effect in BASELINE:
        if effect not in [e.name for e in chain.base]:
            names.append(effect)
            nuisance += trial_columns(chain, effect, get_effect(effect).trials(data)[0], data)
    names.append("unresolved_slopes")
    nuisance.append(chain.unresolved_slopes())
    for name, more in extra:
        names += [f"{name}{k}" for k in range(len(more))]
        nuisance += more
    own = _site_columns(chain)
    z = work.local.remove(work.projector.rows(torch.stack(columns))) if columns else None
    m = work.local.remove(work.projector.rows(torch.stack(nuisance)))
    s = work.local.remove(work.projector.rows(own))
    y = work.rows
    if z is None:
        z = Rows(m.dynamic[:0], m.static[:0])
    z, m, y = _without(s, z), _without(s, m), _without(s, y)
    return _reduce(work, candidates, names, z, m, y), z, m


def gather_static(work: SiteWork, candidates: Sequence[Candidate], data: Survey) -> Statistics:
    """Statistics from the static rows alone, for albedo that follows terrain.

    Such effects leave no trace in the dynamic rows, while nuisances that the dynamic rows fix would carry their own
    errors into the static ones. Clusters are blocks of ground.
    """
    columns = [c for k in candidates for c in trial_columns(work.chain, k.effect, k.trial, data)]
    z, y = _still(work.projector.rows(torch.stack(columns))), _still(work.raw_rows)
    nothing = Rows(y.dynamic[:1] * 0, y.static[:1] * 0)
    out = _reduce(work, candidates, ["none"], z, nothing, y)
    out.image = out.place
    out.rows = max(out.rows, 1.0)
    return out


def _still(rows: Rows) -> Rows:
    return Rows(torch.zeros_like(rows.dynamic), rows.static)


def _site_columns(chain: Chain) -> Tensor:
    """The nominal model's freedom within a site: each coefficient may change and drift across the crop."""
    tangents = chain.surface_tangents()
    height, width = tangents[0].shape[-2:]
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    return torch.stack([t * f for t in tangents for f in (torch.ones(()), x, y)])


def _without(nuisance: Rows, rows: Rows) -> Rows:
    """Rows orthogonal to the nuisance rows."""
    if not len(rows.dynamic):
        return rows
    gram = nuisance.dot(nuisance).double()
    scale = gram.diagonal().clamp(min=1e-30).rsqrt()
    normal = gram * scale[:, None] * scale + 1e-6 * torch.eye(len(gram), dtype=torch.float64)
    share = torch.linalg.solve(normal, scale[:, None] * nuisance.dot(rows).double()) * scale[:, None]
    share = share.float()
    return Rows(
        rows.dynamic - torch.einsum("fe,f...->e...", share, nuisance.dynamic),
        rows.static - torch.einsum("fe,f...->e...", share, nuisance.static),
    )


def _reduce(work: SiteWork, candidates, names, z: Rows, m: Rows, y: Rows) -> Statistics:
    site = work.chain.site
    size = min(BLOCK, max(8, min(site.image.shape[-2:]) // 4))
    count, k = z.dynamic.shape[0], len(names)
    every = torch.cat([m.dynamic, y.dynamic, z.dynamic])
    static = torch.cat([m.static, y.static, z.static])
    blocks = torch.cat([_blocks(every, size), _blocks(static, size)], 1)  # (columns, clusters, px)
    a = blocks.permute(1, 0, 2).contiguous()
    head = a[:, : k + 1]
    nuisance = head @ head.transpose(1, 2)
    cross = a[:, k + 1 :] @ head.transpose(1, 2)
    grams = []
    for candidate in candidates:
        part = a[:, k + 1 + candidate.columns.start : k + 1 + candidate.columns.stop]
        grams.append((part @ part.transpose(1, 2)).double())
    per_map = blocks.shape[1] // (every.shape[1] + static.shape[1])
    frames = site.frames
    image = np.concatenate([np.repeat(frames, per_map), np.full(static.shape[1] * per_map, -1 - site.number)])
    place = np.tile(np.arange(per_map), every.shape[1] + static.shape[1]) + 10_000 * site.number
    flat = z.dynamic.flatten(1)
    total = flat @ flat.T + z.static.flatten(1) @ z.static.flatten(1).T if count else torch.zeros(0, 0)
    is_static = np.arange(len(image)) >= every.shape[1] * per_map
    return Statistics(
        list(candidates), list(names), nuisance.double(), cross.double(), grams, image, place, total.double(),
        work.projector.dynamic_rows, float(y.dynamic.square().sum()), is_static,
    )  # fmt: skip


def _blocks(columns: Tensor, size: int) -> Tensor:
    """(E, n, H, W) -> (E, n * blocks, px of a block), edges filled with zeros."""
    height, width = columns.shape[-2:]
    columns = torch.nn.functional.pad(columns, (0, -width % size, 0, -height % size))
    e, n, height, width = columns.shape
    cut = columns.view(e, n, height // size, size, width // size, size)
    return cut.permute(0, 1, 2, 4, 3, 5).reshape(e, n * (height // size) * (width // size), size * size)


def join(parts: Sequence[Statistics]) -> Statistics:
    """Statistics of several sites as one."""
    first = parts[0]
    return Statistics(
        first.candidates,
        first.names,
        torch.cat([p.nuisance for p in parts]),
        torch.cat([p.cross for p in parts]),
        [torch.cat([p.grams[k] for p in parts]) for k in range(len(first.grams))],
        np.concatenate([p.image for p in parts]),
        np.concatenate([p.place for p in parts]),
        torch.stack([p.total for p in parts]).sum(0),
        sum(p.rows for p in parts),
        sum(p.power for p in parts),
        np.concatenate([p.static_cluster for p in parts]),
    )
