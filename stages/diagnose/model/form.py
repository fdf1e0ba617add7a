"""Another form of the nominal model, where the one asked for leaves far more than ground of the Moon needs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stages.common.arrays import Floats
from stages.diagnose.likelihood.jackknife import gain_interval
from stages.diagnose.model.laws import LunarLaws, lunar_laws
from stages.diagnose.model.nominal import Nominal, fit, lit_mask
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sampled import draw
from stages.diagnose.model.sites import Site
from stages.diagnose.settings import CORRELATED, FAINT, HALVED
from stages.effects import Survey, effect_names, get_effect


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


def better_form(nominal: Nominal, sites: Sequence[Site], data: Survey) -> Nominal | None:
    """Measured lunar laws, fitted, if they leave surely less than the nominal one; or None. The sites are as they were.

    Of calibrated images they leave less than half, and less than the nominal law beside any one effect of the law, for that may be what it
    lacks. Of images with free gains, beside which no cause is known by what it does to the law, they leave surely less of ground that
    neither law was fitted to.
    """
    other = measured_laws(nominal, sites, data.units)
    if other is None:
        return None
    if data.units == "dn":
        sure = gain_interval(left_elsewhere(nominal, sites), left_elsewhere(other, sites))[1] > 0
    else:
        left, before = relative_misfit(other, sites) ** 2, relative_misfit(nominal, sites) ** 2
        sure = left < HALVED * before and left * (1 + FAINT) ** 2 < before * left_beside_one(nominal, sites, data)
    return other if sure else None


def left_beside_one(nominal: Nominal, sites: Sequence[Site], data: Survey) -> float:
    """Share of the squared residuals that the nominal law leaves beside the one effect of the law that takes most of them away, to first order."""
    classes = [c for c in map(get_effect, effect_names()) if c.of_law and c.scope == "scene"]
    trials = [(c, trial) for c in classes for trial in c.trials(data)]

    def of(site: Site) -> Tensor:
        """Products of the residual, of what each coefficient adds to it, and of what each column of a trial adds."""
        chain = nominal.chain(site, [])
        columns = [site.image - chain.rendered, *chain.surface_tangents()]
        columns += [
            chain.render(c({**t.fixed, **column}, data)) - chain.rendered for c, t in trials for column in t.columns
        ]
        flat = (torch.stack(columns) * lit_mask(chain)).flatten(1).double()
        return flat @ flat.T

    gram = torch.stack(per_site(of, sites)).sum(0).numpy()
    first = 1 + int(nominal.free.sum())
    shares, at = [1.0], first
    for _, trial in trials:
        free = [*range(1, first), *range(at, at + len(trial.columns))]
        at += len(trial.columns)
        amounts = np.linalg.lstsq(gram[np.ix_(free, free)], gram[free, 0], rcond=1e-12)[0]
        shares.append(float(1 - amounts @ gram[free, 0] / gram[0, 0]))
    return min(shares)


def left_elsewhere(nominal: Nominal, sites: Sequence[Site]) -> Floats:
    """(sites,) squared relative residuals of the images as they were read, each with its own gain and offset, the coefficients moved to
    what all other ground says of them.
    """

    def of(site: Site) -> Tensor:
        """(1 + C, 1 + C) products of the residual and of what each free coefficient adds to it."""
        chain = nominal.chain(site, [])
        mask = lit_mask(chain)
        level = (site.read * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
        weight = (mask / level.clamp(min=1e-9)[:, None, None]).double()
        flat = torch.stack([site.read, chain.predict(), *chain.surface_tangents()]).double() * weight
        image, predicted, *moved = flat.flatten(2)
        offset = torch.nn.functional.normalize(weight.flatten(1), dim=-1)
        shape = torch.nn.functional.normalize(_without(predicted, offset), dim=-1)
        gain = (image * shape).sum(-1) / (predicted * shape).sum(-1).clamp(min=1e-12)
        columns = [image, *(gain.clamp(min=0)[:, None] * m for m in moved)]
        free = torch.stack([_without(_without(c, offset), shape) for c in columns]).flatten(1)
        return free @ free.T

    own, at = torch.stack(per_site(of, sites)).numpy(), nominal.vector[nominal.free].double().numpy()
    known = np.zeros(len(at))
    if isinstance(nominal.model, LunarLaws):
        pixels = sum(float(s.read_valid.sum()) for s in sites)
        known = CORRELATED * own[:, 0, 0].sum() / pixels * nominal.model.scatter[nominal.free].double().numpy() ** -2
    out = []
    for ground in own:
        rest = own.sum(0) - ground
        # what an image's own gain or offset does as well is not seen
        normal = rest[1:, 1:] + np.diag(known + 1e-9 * rest.diagonal()[1:].max())
        move = np.linalg.solve(normal, rest[1:, 0] - known * at)
        out.append(ground[0, 0] - 2 * move @ ground[1:, 0] + move @ ground[1:, 1:] @ move)
    return np.array(out)


def _without(x: Tensor, direction: Tensor) -> Tensor:
    """(n, X) less its part along unit vectors (n, X)."""
    return x - (x * direction).sum(-1, keepdim=True) * direction


def may_be_exchanged(nominal: Nominal) -> bool:
    """Whether measured lunar laws may take its place: that of a fitted sum of terms.

    A physical law, such as Hapke's, is one of those measured, and stays with the freedom that it has.
    """
    fitted = nominal.predictor is None and nominal.model.linear and bool(nominal.free.all())
    return fitted and nominal.laws is not None


def measured_laws(nominal: Nominal, sites: Sequence[Site], units: str) -> Nominal | None:
    """Measured lunar laws, fitted in the nominal one's place; or None. The sites are as they were."""
    laws = nominal.laws
    if laws is None or not may_be_exchanged(nominal):
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


__all__ = [
    "better_form",
    "left_beside_one",
    "left_elsewhere",
    "may_be_exchanged",
    "measured_laws",
    "other_laws",
    "relative_misfit",
]
