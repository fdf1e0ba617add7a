"""Measured pairs, grouped by the ground they show, and what the effects need to know about them as a whole."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.occluders import occluder_distance
from stages.effects import Survey, fields
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Observation

MARGIN = math.radians(1.2)  # from the horizon: closer, a DEM error decides whether a pixel is lit
GRAZING = math.cos(math.radians(84))  # a slope error of a degree changes brightness by 15 % there


@dataclass
class Site:
    """All images of one piece of ground, pixel for pixel.

    image : (n, H, W), I/F (after the nominal fit also for dn images); valid : (n, H, W) bool
    pairs : (n,) indices into the file; number : the site's number in the file
    gain, offset : (n,), measured = gain x I/F + offset; 1 and 0 for calibrated images
    texture : (H, W), relative albedo of the ground beyond the nominal model, estimated along the way
    shadow_px : (n, H, W), distance of what casts shadows, px, once asked for
    """

    observation: Observation
    image: Tensor
    valid: Tensor
    pairs: NDArray[np.int64]
    number: int
    gain: Tensor
    offset: Tensor
    texture: Tensor
    shadow_px: Tensor | None = None

    @property
    def count(self) -> int:
        return len(self.pairs)

    def as_read(self, image: Tensor, valid: Tensor) -> None:
        """Back to what was measured, with nothing known of it."""
        self.image, self.valid = image, valid
        self.gain, self.offset = torch.ones_like(self.gain), torch.zeros_like(self.offset)
        self.texture = torch.ones_like(self.texture)

    def occluders(self) -> Tensor:
        """(n, H, W), px: how far away what casts a shadow on each pixel stands."""
        if self.shadow_px is None:
            self.shadow_px = occluder_distance(self.observation)
        return self.shadow_px

    @property
    def frames(self) -> NDArray[np.int64]:
        return self.observation.frame.numpy()


def load_site(reader: PairReader, pairs: NDArray[np.int64]) -> Site:
    """Read one site's pairs."""
    observation = reader.observation(pairs)
    number = int(reader.site[pairs[0]])
    observation.site = torch.full((len(pairs),), number)
    if observation.detector_sample is None or observation.detector_line is None:
        observation.detector_sample = observation.detector_line = None
    image, valid = reader.image(pairs), reader.valid(pairs)
    if observation.sun_horizon is not None:
        valid &= torch.isfinite(observation.sun_horizon)
    one = torch.ones(len(pairs))
    height, width = image.shape[-2:]
    return Site(observation, image, valid, pairs, number, one, one * 0, torch.ones(height, width))


def group_pairs(reader: PairReader, pairs: NDArray[np.int64], most: int) -> list[NDArray[np.int64]]:
    """Pairs by site, each site cut to ``most`` images spread evenly; sites with many images first."""
    groups = []
    for number in np.unique(reader.site[pairs]):
        members = pairs[reader.site[pairs] == number]
        if len(members) > most:
            members = members[np.linspace(0, len(members) - 1, most).round().astype(int)]
        groups.append(members)
    return sorted(groups, key=lambda g: -len(g))


def survey(sites: list[Site], frames: int) -> Survey:
    """Means and deviations of the terrain and the brightness over all sites."""
    first = sites[0].observation
    bright = torch.cat([s.image[s.valid].flatten()[:: max(1, s.count // 2)] for s in sites])
    bright = bright[:: max(1, len(bright) // 200_000)]
    lit = bright[bright > 0.3 * bright.mean()] if len(bright) else torch.tensor([0.05])
    top = torch.quantile(bright, torch.tensor([0.9, 0.97, 0.99, 0.998])) if len(bright) else lit.repeat(4)
    terrain = [s.observation.elevation[:1] for s in sites]
    columns = [s.observation.detector_sample for s in sites]
    known = all(c is not None for c in columns)
    ends = (
        (min(float(c.nan_to_num(1e9).min()) for c in columns), max(float(c.nan_to_num(-1e9).max()) for c in columns))
        if known
        else (0.0, float(first.elevation.shape[-1] - 1))
    )
    return Survey(
        crop_px=int(min(first.elevation.shape[-2:])),
        gsd=first.gsd,
        brightness=float(lit.mean()),
        brightness_quantiles=tuple(float(q) for q in top),
        slope=_moments([fields.slope(z, first.gsd) for z in terrain]),
        elevation=_moments(terrain),
        curvature=_moments([fields.curvature(z, first.gsd) for z in terrain]),
        relief=max(float(z.max() - z.min()) for z in terrain),
        columns=ends,
        has_detector=known,
        frames=frames,
        sites=len(sites),
    )


def _moments(parts: list[Tensor]) -> tuple[float, float]:
    values = torch.cat([p.flatten() for p in parts]).double()
    return float(values.mean()), max(float(values.std()), 1e-9)
