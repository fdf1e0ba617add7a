"""Another form of the nominal model, where the one asked for leaves far more than ground of the Moon needs."""

from __future__ import annotations

import math
from collections.abc import Sequence

from stages.diagnose.model.nominal import Nominal, fit, lit_mask, load_nominal
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site
from stages.diagnose.settings import GROSS, HALVED

LUNAR = ("kernels", "hapke")  # a sum of kernels that follows any smooth law, and the physical one


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


def better_form(nominal: Nominal, sites: Sequence[Site], units: str) -> Nominal | None:
    """A fitted model of another form that halves a gross misfit, or None. The sites are as they were."""
    if nominal.predictor is not None or nominal.model.name in LUNAR:
        return None
    now = relative_misfit(nominal, sites)
    if not now > GROSS:
        return None
    best, least = None, HALVED * now
    kept = [(s.image, s.gain, s.offset) for s in sites]
    measured = [s.image * s.gain[:, None, None] + s.offset[:, None, None] for s in sites]
    for name in LUNAR:
        other = load_nominal(None, name, units)
        fit(other, sites, [], units, measured, start=True)
        left = relative_misfit(other, sites)
        if left < least:
            best, least = other, left
        for site, (image, gain, offset) in zip(sites, kept, strict=True):
            site.image, site.gain, site.offset = image, gain, offset
    return best


__all__ = ["better_form", "relative_misfit"]
