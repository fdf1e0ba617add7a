"""A DEM's scale and smoothing, judged in the maps of apparent slope errors: the channel of what is wrong with the ground."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

from stages.diagnose.columns import BASELINE, Candidate, make_candidates, tangent, trial_columns
from stages.diagnose.evidence import Evidence, weigh
from stages.diagnose.preparing import SiteWork
from stages.diagnose.statistics import Statistics, gather_static, join
from stages.effects import Survey, Trial, get_effect

ALONG = {"dem_smoothing": (), "dem_scale": ("dem_smoothing",)}  # effect -> nuisances fitted along
NOISE = math.tan(math.radians(1.2))  # rms of the given slopes, that is taken for noise at most
MOST_HIDDEN = 0.05  # ... and of their variance
FLATTENED = 0.3  # of the slopes' variance: what relief within a pixel takes off the shading
# scale per px^2, rms over six traced scenes whose DEM had the right one: no DEM is smoothed by a perfect Gaussian, and beyond a
# pixel no sharpening brings back what is gone
SHARPENED = 0.1


@dataclass
class Relief:
    """Products of one site.

    noise : sum of squares that the images' noise leaves in its maps; steepness : mean squared slope of the ground
    sharpened : smoothing of the DEM that the model undoes already, px^2
    roughened : product of the DEM's noise and what a trial's sharpening adds to it
    """

    products: Statistics
    noise: float
    steepness: float
    sharpened: float
    roughened: float


def open_relief(work: SiteWork, name: str, data: Survey) -> Relief:
    """Products of an effect that is not in the model yet."""
    candidates = make_candidates([name], data)
    columns = [c for e in candidates for c in trial_columns(work.chain, name, e.trial, data)]
    return _gather(work, candidates, columns, name, data)


def named_relief(work: SiteWork, place: int, step: float, data: Survey) -> Relief:
    """Products of a further step of the effect at ``place`` in the model."""
    effect = work.chain.base[place]
    (coordinate,) = (p.name for p in effect.fitted())
    trial = Trial(({coordinate: effect.null()[coordinate] + step},))
    column = step * tangent(work.chain, place, coordinate, data)
    return _gather(work, [Candidate(effect.name, trial, slice(0, 1))], [column], effect.name, data)


def _gather(work: SiteWork, candidates, columns, name: str, data: Survey) -> Relief:
    named = [e.name for e in work.chain.base]
    along = [
        (other, BASELINE[other], trial_columns(work.chain, other, get_effect(other).trials(data)[0], data)[0])
        for other in ALONG[name]
        if other not in named
    ]
    products = gather_static(work, candidates, columns, along, nominal=True, maps=slice(1, None))
    steepness = data.slope[0] ** 2 + data.slope[1] ** 2
    sharpened = sum(abs(float(e.values["sigma2_px2"])) for e in work.chain.base if e.name == "dem_smoothing")
    ((_, step),) = candidates[0].trial.columns[0].items()
    # before the smoothing is named the residual's maps are full of it, and tell nothing of the DEM's noise
    roughened = work.projector.noise_sharpened(step) if name == "dem_smoothing" and name in named else 0.0
    return Relief(products, work.projector.slope_noise(), steepness, sharpened, roughened)


def weigh_relief(parts: Sequence[Relief]) -> list[Evidence]:
    """Evidence from the maps of slope errors of all sites, a DEM's scale corrected for what imitates one.

    Noise of the DEM lowers its smoothing too: sharpening raises it. By how much depends on its spectrum at the shortest
    wavelengths, which the images do not give well enough for a correction: it is counted as an error.

    Slopes that the DEM has and the ground has not draw the regression of slope errors on given slopes to smaller
    scales, by their share of the given slopes' variance (Fuller 1987, Measurement Error Models, ch. 1). That share is
    estimated from what the fit leaves of the maps beyond the images' noise. Relief within a pixel flattens the shading:
    facets of slope variance s^2 per axis dim the level ground by s^2 and the contrast of slopes by 2 s^2. How much of its
    slopes' variance ground has within a pixel was read off traced terrain (amplitudes falling as the 1.8th power of the
    frequency, and craters): about a seventh; other ground has half to one and a half of that.
    """
    data = join([p.products for p in parts])
    evidence = weigh(data)
    m, sums = data.count, data.products.sum(0)
    for k, e in enumerate(evidence):
        place = m + 1 + e.candidate.columns.start
        if e.effect == "dem_smoothing":
            missing = sum(p.roughened for p in parts) / max(float(sums[place, place]), 1e-30)
            evidence[k] = dataclasses.replace(e, covariance=e.covariance + missing**2, lowered=missing)
        if e.effect != "dem_scale" or e.gain <= 0:
            continue
        left = float(sums[m, m]) - 2 * e.gain - sum(p.noise for p in parts)
        (reference,) = e.candidate.trial.columns[0].values()
        steepness = parts[0].steepness
        hidden = reference**2 * max(left, 0.0) / max(float(sums[place, place]), 1e-30)
        hidden = min(hidden, MOST_HIDDEN, NOISE**2 / max(steepness, 1e-12))
        flattened = FLATTENED * steepness
        # any share of what is left may be the ground's own detail; relief below the DEM's resolution is known to half
        doubt = (0.5 * hidden) ** 2 + (0.5 * flattened) ** 2 + (SHARPENED * parts[0].sharpened) ** 2
        covariance = e.covariance + doubt / reference**2
        evidence[k] = dataclasses.replace(
            e, amount=e.amount + (0.5 * hidden + flattened) / reference, covariance=covariance
        )
    return evidence


__all__ = ["ALONG", "Relief", "named_relief", "open_relief", "weigh_relief"]
