"""A site made ready: weights from the residual's own scatter, texture and slopes taken out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.diagnose.columns import nominal_columns, nuisance_columns
from stages.diagnose.data import GRAZING, Site
from stages.diagnose.judged import judged, rising
from stages.diagnose.projection import Local, Projector

DEEP = math.radians(2)  # below the horizon: shadow, whatever the DEM's errors
UNRESOLVED_SLOPES = 1.0  # ordinary amount of the column of unresolved slopes
SHORE = 1  # px of shadow next to light, where the place of the edge decides
FAR = 3  # px of shadow, into which neither a blur carries light nor an error of the DEM
OUTLIER = 7.0  # sigma ...
STRAY = 0.2  # ... but far in shadow as much light as this, of the mean brightness: what strays there is evidence
QUIETEST = 0.002  # noise over mean brightness: an image that looks quieter is dark
SHOT = 0.8  # share of shot noise in the noise's variance at mean brightness
EDGE = math.radians(6.0)  # relief below the DEM's resolution blurs shadows over a band like this ...
DOUBT = 0.3  # ... by up to this share of the lit brightness
FAR_OFF = 10.0  # px: shadows cast from nearer by show the relief that the DEM has not, and little else
CAST = (math.radians(0.3), math.radians(24.0))  # the band about cast shadows: far away, and at a distance of one px


@dataclass
class SiteWork:
    """A site made ready: weights, projection, and what is left of the measurement.

    residual : (n, H, W), I/F, measured minus predicted; albedo : (H, W), relative albedo of the ground beyond the
    prediction, not whitened; static : (K, H, W), whitened maps of the residual; dynamic : (n, H, W), the residual's
    dynamic rows once everything local and the nominal model's own freedom are taken out
    """

    chain: Chain
    projector: Projector
    local: Local
    residual: Tensor
    albedo: Tensor
    static: Tensor
    dynamic: Tensor

    def remains(self) -> Remains:
        return Remains(self.chain.site, self.projector.weight, self.albedo, self.dynamic)


@dataclass
class Remains:
    """What is kept of a site's work while other sites are worked on; names as in :class:`SiteWork`."""

    site: Site
    weight: Tensor
    albedo: Tensor
    dynamic: Tensor


def ready(chain: Chain, dn: bool, wide: bool = False, far: bool = False) -> SiteWork:
    """Weights from the residual's own scatter, the projector, the texture.

    wide : keeps the pixels about shadow edges; far : of these, only where the shadow is cast from afar
    """
    site = chain.site
    weight = _first_weight(chain, wide, far)
    residual = torch.where(site.valid, site.image - chain.textured, 0.0)
    level = (chain.textured * site.valid).sum((-2, -1)) / site.valid.sum((-2, -1)).clamp(min=1)
    most = 1 / (QUIETEST * level.clamp(min=1e-6))[:, None, None]
    shaded = _inner_shadow(chain, FAR)

    def split() -> tuple[Projector, Tensor, Tensor]:
        projector = Projector(chain, weight)
        weighted = (residual * weight)[None]
        on_basis = projector.coefficients(weighted)
        return projector, projector.project_(weighted, on_basis)[0], on_basis

    projector, dynamic, on_basis = split()
    for _ in range(2):
        if len(weight) < 2:  # one image: its noise and the ground's texture cannot be told apart
            weight = weight / float((residual * weight).square()[weight > 0].mean().clamp(min=1e-12)) ** 0.5
        else:
            weight = weight * _rescale(dynamic, projector)[:, None, None]
            if not wide:  # what no smooth effect can do: shadows of unknown walls, cut-off highlights, dead pixels
                gross = dynamic.abs() > torch.where(shaded, STRAY * level[:, None, None] * weight, 0.0).clamp(
                    min=OUTLIER
                )
                if float(gross.sum()) < 0.3 * float((weight > 0).sum()):
                    weight = weight * ~gross
        weight = weight.minimum(most)
        projector, dynamic, on_basis = split()
    maps = projector.maps(on_basis)[0]
    # the prediction moves the texture along with the ground; the static rows are about all of it
    maps[0] += site.texture - 1
    if len(weight) >= 3:
        site.texture = (1 + maps[0]).clamp(0.4, 2.5)
        chain.textured = chain.render()
    projector.learn_spectrum(maps)
    local = Local(projector, nuisance_columns(chain, dn))
    return SiteWork(chain, projector, local, residual, maps[0], projector.whiten(maps[None])[0], dynamic)


def left_over(chain: Chain, weight: Tensor, dn: bool, extra: Sequence[Tensor] = ()) -> float:
    """Sum of squares of the dynamic residual at given weights, without shifts, ordinary relief, the nominal model's freedom.

    extra : further columns (n, H, W) that may be fitted along
    """
    projector = Projector(chain, weight)
    # values per image stay as they are, or they would have a set for each site here
    local = Local(projector, nuisance_columns(chain, dn, named=False))
    residual = chain.site.image - chain.textured
    free = [*nominal_columns(chain), *extra]
    columns = torch.stack([*free, chain.unresolved_slopes(), residual]) * weight
    on_basis = projector.coefficients(columns)
    local.remove_(columns, on_basis)
    projector.project_(columns, on_basis)
    clear_of_(columns, columns.new_zeros(len(columns), 0, 1, 1), len(free))
    unresolved, left = columns[-2].flatten().double(), columns[-1].flatten().double()
    # no more relief than is ordinary: without a bound it imitates other effects
    energy, cross = float(unresolved @ unresolved) + UNRESOLVED_SLOPES**-2, float(unresolved @ left)
    return float(left @ left) - cross**2 / energy


def _first_weight(chain: Chain, wide: bool, far: bool) -> Tensor:
    """1 / expected noise, (n, H, W): shot and read noise, and doubt where shadows end."""
    site, state = chain.site, chain.state
    predicted = chain.textured
    mean = (predicted * site.valid).sum((-2, -1)) / site.valid.sum((-2, -1)).clamp(min=1)
    mean = mean.clamp(min=1e-6)[:, None, None]
    variance = (0.02 * mean) ** 2 * (1 - SHOT + SHOT * (predicted / mean).clamp(min=0))
    above = chain.height_above_horizon()
    mu0 = state.angles.cos_incidence
    use = site.valid & ((mu0 > GRAZING) | (mu0 < -GRAZING)) & (state.angles.cos_emission > 0.15)
    if above is None:
        use &= mu0 > GRAZING
    sun = rising(chain)
    if not wide:
        use &= judged(chain, use, sun) | _inner_shadow(chain, SHORE)
    doubt = DOUBT * (state.reflectance + 0.2 * mean)
    if wide and above is not None:  # the further away a shadow's edge begins the better its place is known
        if far:
            use &= (above.abs() > EDGE) | (site.occluders() >= FAR_OFF)
        afar, near = CAST
        cast = torch.sqrt(afar**2 + (near / site.occluders()) ** 2)
        own = torch.asin(mu0.clamp(-1, 1))
        variance = variance + (doubt * torch.exp(-own.abs() / EDGE)) ** 2
        variance = variance + (doubt * torch.exp(-above.abs() / cast)) ** 2
    else:
        edge = torch.where(mu0 > 0 if above is None else above > 0, EDGE, 0.3 * EDGE)
        variance = variance + (doubt * torch.exp(-sun.abs() / edge)) ** 2
    return use * variance.clamp(min=1e-14).rsqrt()


def _inner_shadow(chain: Chain, distance: int) -> Tensor:
    """(n, H, W) bool: shadow more than so many pixels from light."""
    above = chain.height_above_horizon()
    if above is None:
        return torch.zeros_like(chain.site.valid)
    near = torch.nn.functional.max_pool2d(
        (above > -DEEP)[:, None].float(), 2 * distance + 1, stride=1, padding=distance
    )
    return near[:, 0] == 0


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


def clear_of_(dynamic: Tensor, static: Tensor, count: int) -> None:
    """Make all rows orthogonal to the first ``count``, in place."""
    d, t = dynamic.flatten(1), static.flatten(1)
    gram = (d[:count] @ d.T + t[:count] @ t.T).double()
    scale = gram.diagonal().clamp(min=1e-30).rsqrt()
    normal = gram[:, :count] * scale[:, None] * scale + 1e-6 * torch.eye(count, dtype=torch.float64)
    share = (torch.linalg.solve(normal, scale[:, None] * gram[:, count:]) * scale[:, None]).float()
    d[count:].addmm_(share.T, d[:count], alpha=-1)
    t[count:].addmm_(share.T, t[:count], alpha=-1)
