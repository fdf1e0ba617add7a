"""Where shadows end, and how well a DEM can know it.

What casts a shadow is off by some height, and so is the ground that it falls on: seen from there, the horizon is off by an angle
that falls with the distance, as one over it where heights are as wrong far apart as near by, and as one over its root where they go apart
like terrain itself. So errors of the DEM, and relief finer than it, widen the edges of shadows cast from near by and
lengthen them (a horizon is the highest of all that stands in a direction), while a wide Sun widens all edges by the same angle and a wrong
one moves all by the same. Two numbers say how much: ``blur`` and ``lift``, fitted wherever shadows are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.common.arrays import Floats
from stages.diagnose.model.chain import Chain
from stages.diagnose.settings import CLEAR, DARKEST, LIT_MARGIN
from stages.effects import Effect
from stages.physics.horizon import occluder_distance
from stages.physics.light.sun_disc import sun_visibility, visibility_slope

LIMIT = 0.3  # of a share of light, beyond 0 and 1: noise that is cut off there alone would make all edges look wide
NEAREST = 3.0  # px: edges of shadows cast from nearer by hang on the slope of the ground itself
PARTS = 4  # bands of a site's lines that are judged apart, where grounds are few


@dataclass(frozen=True)
class Horizons:
    """What errors of the DEM do to its horizons, for terrain at a distance of one pixel: radius of the blur and lift, rad.

    fall : power of the distance with which they fall, between those of ``settings.FALLS``
    """

    blur: float = 0.15
    lift: float = 0.0
    fall: float = 1.0


@dataclass
class _Facets:
    """Some facets of a site, part after part. pixel : (M,) numbers among those of all images; image, part : (M,) of which image and band of lines

    nearness : of what casts shadow on them, 1/px; measured : share of light; sharp : what of that is left where the DEM's horizon is sharp
    """

    pixel: Tensor
    image: Tensor
    part: Tensor
    nearness: Tensor
    measured: Tensor
    sharp: Tensor


def _facets(use: Tensor, distance: Tensor, measured: Tensor, above: Tensor) -> _Facets:
    """Those in use, (n, H, W) each."""
    pixel = torch.nonzero(use.flatten())[:, 0]
    _, height, width = use.shape
    bands = np.repeat(np.arange(PARTS), [len(rows) for rows in np.array_split(np.arange(height), PARTS)])
    part = torch.from_numpy(bands)[pixel // width % height]
    part, order = torch.sort(part, stable=True)
    pixel = pixel[order]
    near, share, high = (x.flatten()[pixel] for x in (distance, measured, above))
    nearness = 1 / near.clamp(min=NEAREST)
    return _Facets(pixel, pixel // (width * height), part, nearness, share, share - (high > 0).to(share.dtype))


class Edges:
    """The facets of one site that the Sun would shine on, and the share of its light that arrives there.

    ground : the chain whose relief casts the shadows, if it is another one
    """

    def __init__(self, chain: Chain, ground: Chain | None = None) -> None:
        self.chain = ground or chain
        use, above, measured = _light(chain)
        distance = _distances(chain, use)
        use &= (distance >= NEAREST) | (above.abs() > CLEAR)
        near = above.abs() < CLEAR
        self.near, self.far = (_facets(use & here, distance, measured, above) for here in (near, ~near))
        self.far_squares = _squares(self.far.sharp, self.far.part)

    def products(self, effects: Sequence[Effect], beside: Sequence[Effect], about: Horizons) -> Floats:
        """(effects, PARTS, 3, 3) of the residual share of sunlight and of what a little more blur and lift would add to the expected one."""
        out, without = [], None
        for effect in effects:
            every = [*(b for b in beside if b.name != effect.name), effect]
            if without is None or not effect.raises_horizon:  # without walls all the same
                without = self._without_walls([e for e in every if not e.raises_horizon], about)
            walls = any(e.raises_horizon for e in every)
            out.append(self._products(every, *without, about) if walls else without[-1])
        return torch.stack(out).numpy()

    def _without_walls(self, effects: Sequence[Effect], about: Horizons) -> tuple[Tensor, Tensor, Tensor]:
        """The DEM's horizon (n * H * W,), rows (3, M) of the facets near it, and the products of all."""
        sun, horizon, disc = self.chain.sunlight(effects)
        assert horizon is not None
        nearness = self.near.nearness**about.fall
        rows = _rows(self.near, sun, horizon.flatten(), disc, nearness, about)
        out = _sums(rows, self.near.part)
        out[:, 0, 0] += self.far_squares
        return horizon.flatten(), rows, out

    def _products(
        self, effects: Sequence[Effect], known: Tensor, rows: Tensor, plain: Tensor, about: Horizons
    ) -> Tensor:
        """(PARTS, 3, 3) with walls among the effects. known, rows, plain : of :meth:`_without_walls`"""
        sun, horizon, disc = self.chain.sunlight(effects)
        assert horizon is not None
        hides = (horizon > (sun - disc)[:, None, None]).flatten()
        horizon = horizon.flatten()
        raised = horizon > known
        out = plain.clone()
        # only a wall beyond the DEM darkens what the Sun stands well above, and only one that is as high as the Sun
        for facets, touched in ((self.near, raised), (self.far, raised & hides)):
            behind = torch.nonzero(touched[facets.pixel])[:, 0]
            pixel, image, part = facets.pixel[behind], facets.image[behind], facets.part[behind]
            # what stands beyond the DEM stands far off, as it was given: errors of horizons do nothing there
            left = facets.measured[behind] - sun_visibility(sun[image], horizon[pixel], disc)
            out[:, 0, 0] += _squares(left, part)
            if facets is self.near:
                out -= _sums(rows[:, behind], part)
            else:
                out[:, 0, 0] -= _squares(facets.sharp[behind], part)
        return out


def _rows(facets: _Facets, sun: Tensor, horizon: Tensor, disc: Tensor, nearness: Tensor, about: Horizons) -> Tensor:
    """(3, M) residual share of sunlight, and what a little more blur and lift would add to the expected one."""
    above = sun[facets.image] - horizon[facets.pixel]
    radius = torch.hypot(disc, about.blur * nearness)
    t = (about.lift * nearness - above) / radius
    slope = visibility_slope(t) / radius
    wider = -slope * t * about.blur * nearness.square() / radius
    left = facets.measured - sun_visibility(above, about.lift * nearness, radius)
    return torch.stack([left, wider, slope * nearness]).double()


def _sums(rows: Tensor, part: Tensor) -> Tensor:
    """(PARTS, 3, 3) products of the rows (3, M) of facets of these parts, in order."""
    return torch.stack([own @ own.T for own in rows.split(torch.bincount(part, minlength=PARTS).tolist(), 1)])


def _squares(left: Tensor, part: Tensor) -> Tensor:
    """(PARTS,) of what is left (M,) at facets of these parts."""
    return torch.zeros(PARTS, dtype=torch.float64).index_add_(0, part, left.double().square())


def _light(chain: Chain) -> tuple[Tensor, Tensor, Tensor]:
    """Of every facet, three (n, H, W): whether the Sun would shine on it, its height above the horizon, and the share of its light that arrives."""
    site, facet = chain.site, chain.state.reflectance
    known, above = chain.state.sun_visibility, chain.height_above_horizon()
    assert known is not None and above is not None
    lit = chain.lit() & site.valid
    level = (facet * lit).sum((-2, -1), keepdim=True) / lit.sum((-2, -1), keepdim=True).clamp(min=1)
    measured = (known + (site.image - chain.predict()) / facet.clamp(min=1e-9)).clamp(-LIMIT, 1 + LIMIT)
    return site.valid & (facet > DARKEST * level), above, measured


def dark_share(chain: Chain) -> float:
    """Of the facets of a site that should be sunlit for sure, the share that lies in the dark."""
    use, above, measured = _light(chain)
    sunlit = use & (above > LIT_MARGIN)
    return float((sunlit & (measured < 0.5)).sum()) / max(int(sunlit.sum()), 1)


def _distances(chain: Chain, use: Tensor) -> Tensor:
    """(n, H, W) px to what makes the horizon; 0 where not in use."""
    state, gsd = chain.state, chain.site.observation.gsd
    assert state.sun_horizon is not None
    out = []
    for k, (sun, mask) in enumerate(zip(state.sun_direction, use, strict=True)):
        elevation = state.elevation[min(k, len(state.elevation) - 1)]
        azimuth = math.atan2(float(sun[0]), float(sun[1]))
        distance = occluder_distance(elevation.numpy(), gsd, azimuth, state.sun_horizon[k].numpy(), mask.numpy())
        out.append(torch.from_numpy(distance))
    return torch.stack(out)


def move(products: Floats) -> Floats:
    """(2,) more blur and lift with which the squares of (3, 3) are least."""
    inner = products[1:, 1:] + 1e-9 * np.trace(products[1:, 1:]) * np.eye(2) + 1e-12 * np.eye(2)
    return np.linalg.solve(inner, products[1:, 0])


def squares(products: Floats, moved: Floats) -> Floats:
    """Of (..., 3, 3), what that blur and lift leave."""
    change = np.concatenate([[1.0], -moved])
    return np.asarray(change @ products @ change)


__all__ = ["PARTS", "Edges", "Horizons", "dark_share", "move", "squares"]
