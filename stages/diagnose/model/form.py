"""Another form of the nominal model, where the one asked for leaves far more than ground of the Moon needs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from stages.diagnose.model.laws import LunarLaws, lunar_laws
from stages.diagnose.model.nominal import Nominal, fit, lit_mask
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sampled import draw
from stages.diagnose.model.sites import Site
from stages.diagnose.settings import HALVED


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


def other_laws(nominal: Nominal, sites: Sequence[Site], units: str) -> LunarLaws | None:
    """In which ways the law may be another one at the angles of these sites; None where nothing is lit."""
    chains = per_site(lambda site: nominal.chain(site, []), sites)
    cosines, _, measured = draw(chains, [lit_mask(c) for c in chains], [s.image for s in sites])
    if not len(measured):
        return None
    return lunar_laws(cosines.flatten(1), float(measured.mean()) if units == "iof" else None)


def better_form(nominal: Nominal, sites: Sequence[Site], units: str) -> Nominal | None:
    """Measured lunar laws, fitted, if they leave less than half of the squared residual; or None. The sites are as they were."""
    other = measured_laws(nominal, sites, units)
    if other is None or relative_misfit(other, sites) ** 2 > HALVED * relative_misfit(nominal, sites) ** 2:
        return None
    return other


def measured_laws(nominal: Nominal, sites: Sequence[Site], units: str) -> Nominal | None:
    """Measured lunar laws, fitted in the place of a fitted sum of terms; or None. The sites are as they were.

    A physical law, such as Hapke's, is one of those measured, and stays with the freedom that it has.
    """
    laws = nominal.laws
    if nominal.predictor is not None or laws is None or not nominal.model.linear or not bool(nominal.free.all()):
        return None
    vector = torch.tensor([p.default for p in laws.parameters])
    free = torch.ones(len(vector), dtype=torch.bool)
    free[0] = units == "iof"  # beside gains of all images the level means nothing, and would drift
    other = Nominal(laws, vector, free)
    kept = [(s.image, s.gain, s.offset) for s in sites]
    measured = [s.image * s.gain[:, None, None] + s.offset[:, None, None] for s in sites]
    fit(other, sites, [], units, measured, start=True)
    for site, (image, gain, offset) in zip(sites, kept, strict=True):
        site.image, site.gain, site.offset = image, gain, offset
    return other


__all__ = ["better_form", "measured_laws", "other_laws", "relative_misfit"]
