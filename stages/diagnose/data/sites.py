"""Measured pairs, grouped by the ground they show, and what the effects need to know about them as a whole."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.diagnose.data.aligned import aligned
from stages.diagnose.settings import FEWEST_PIXELS, TAPER
from stages.effects import Survey, fields
from stages.effects.azimuthal_anisotropy import sun_cotangent
from stages.effects.relief_displacement import lean
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import Observation

if TYPE_CHECKING:
    from stages.diagnose.model.chain import Chain


@dataclass
class Site:
    """All images of one piece of ground, pixel for pixel.

    image, valid : (n, H, W), I/F aligned with the ground (after the nominal fit also for dn images), and bool
    read, read_valid : the same as they were read
    pairs : (n,) indices into the file; number : the site's number in the file; place : (2,) row and column in the scene, px
    gain, offset : (n,), measured = gain x I/F + offset; 1 and 0 for calibrated images
    displacement : where each image looks for its pixels, (columns east, rows south), px, broadcastable to it
    left_out : of the images, those too seldom seen for a covariance of their own
    unknown : of the images, those of which no values are known while causes have values per image: neither law nor score counts them
    latest : its last rendering, of which the next one takes over what is the same
    """

    observation: Observation
    image: Tensor
    valid: Tensor
    read: Tensor
    read_valid: Tensor
    pairs: NDArray[np.int64]
    number: int
    place: tuple[float, float]
    gain: Tensor
    offset: Tensor
    displacement: tuple[Tensor, Tensor] | None = None
    left_out: frozenset[int] = frozenset()
    unknown: frozenset[int] = frozenset()
    latest: Chain | None = None
    _shown: Tensor | None = None  # what ``read_valid`` was before pixels were hidden
    _laid: tuple[object, Tensor, Tensor] | None = None  # for one displacement: image and mask over the ground

    @property
    def laid(self) -> Tensor:
        """(n, H, W) the images as read, over the ground, since :meth:`align`."""
        return self.read if self._laid is None else self._laid[1]

    def align(self) -> None:
        """Lay the images over the ground, with the gains and offsets that are known so far."""
        if self._laid is None or self._laid[0] is not self.displacement:
            laid = aligned(self.read, self.read_valid, *self.displacement or 2 * [torch.zeros(self.count, 1, 1)])
            self._laid = self.displacement, *laid
        _, laid_image, self.valid = self._laid
        self.image = (laid_image - self.offset[:, None, None]) / self.gain[:, None, None]

    def hide(self, dark: Tensor) -> None:
        """Leave pixels (n, H, W) of the images out until they are shown again."""
        self._shown, self.read_valid, self._laid = self.read_valid, self.read_valid & ~dark, None
        self.align()

    def show(self) -> None:
        """Take all pixels in again."""
        if self._shown is not None:
            self.read_valid, self._shown, self._laid = self._shown, None, None
            self.align()

    def on_detector(self) -> Tensor:
        """(n, 2, H, W) line and sample of every pixel as the images lie now; row and column of the crop where the detector is not known."""
        line, sample = self.observation.detector_line, self.observation.detector_sample
        if line is None or sample is None:
            rows, columns = (torch.arange(k, dtype=self.read.dtype) for k in self.read.shape[-2:])
            line, sample = rows[:, None].expand_as(self.read), columns.expand_as(self.read)
        out = torch.stack([line, sample], 1)
        if self.displacement is not None:
            east, south = (d[:, None] for d in self.displacement)
            down, across = torch.gradient(out, dim=(-2, -1))
            out = out + down * south + across * east
        return out

    @property
    def counts(self) -> Tensor:
        """(n, 1, 1) bool: images that are not unknown."""
        return torch.tensor([k not in self.unknown for k in range(self.count)])[:, None, None]

    @property
    def count(self) -> int:
        """Pairs that show it."""
        return len(self.pairs)

    @property
    def frames(self) -> NDArray[np.int64]:
        """(B,) source image of each pair."""
        assert self.observation.frame is not None
        return self.observation.frame.numpy()


def load_site(reader: PairReader, pairs: NDArray[np.int64]) -> Site | None:
    """Read one site's pairs, but for images that show hardly a pixel; None if there is no other."""
    valid = reader.valid(pairs)
    pairs = pairs[(valid.sum((-2, -1)) >= FEWEST_PIXELS).numpy()]
    if not len(pairs):
        return None
    observation = reader.observation(pairs)
    number = int(reader.site[pairs[0]])
    observation.site = torch.full((len(pairs),), number)
    if observation.detector_sample is None or observation.detector_line is None:
        observation.detector_sample = observation.detector_line = None
    image, valid = reader.image(pairs), reader.valid(pairs)
    if observation.sun_horizon is not None:
        valid &= torch.isfinite(observation.sun_horizon)
    one = torch.ones(len(pairs))
    place = tuple(float(reader.file[name][pairs[0]]) if name in reader.file else 0.0 for name in ("row", "col"))
    return Site(observation, image, valid, image, valid, pairs, number, (place[0], place[1]), one, one * 0)


def grounds(reader: PairReader, pairs: NDArray[np.int64], most: int) -> list[NDArray[np.int64]]:
    """Pairs by site, of sites that share no ground, each cut to ``most`` images spread evenly; sites with many images first."""
    site = reader.site[pairs]
    order = np.argsort(site, kind="stable")
    groups = np.split(pairs[order], np.flatnonzero(np.diff(site[order])) + 1) if len(pairs) else []
    groups = [g[np.linspace(0, len(g) - 1, most).round().astype(int)] if len(g) > most else g for g in groups]
    groups = sorted(groups, key=lambda g: -len(g))
    if "row" not in reader.file:  # such files do not say where crops lie
        return groups
    place = np.stack([reader.file[k][...] for k in ("row", "col")], 1)[[g[0] for g in groups]]
    apart: list[int] = []
    for k in range(len(groups)):
        if not overlap(place[k], place[apart], reader.size):
            apart.append(k)
    return [groups[k] for k in apart]


def overlap(place: NDArray[np.float64], others: NDArray[np.float64], sides: tuple[int, int]) -> bool:
    """Whether a crop shows the same ground as one of the others, but for the borders that windows leave out.

    What is learned on one piece of ground is judged on another one, which must not be the same.
    place, others : (2,) and (K, 2) rows and columns in the scene; sides : height and width of all crops, px
    """
    return bool((np.abs(others - place) < (1 - TAPER) * np.array(sides)).all(1).any())


def all_over(groups: list[NDArray[np.int64]], most_pairs: int, most_sites: int) -> list[NDArray[np.int64]]:
    """Where not all can be taken, in an order in which the first ones lie all over the scene: crops are numbered by row. Many images still go first."""
    if len(groups) <= most_sites and sum(map(len, groups)) <= most_pairs:
        return groups
    golden = np.arange(len(groups)) * (math.sqrt(5) - 1) / 2 % 1  # no two of the first n are nearer than about 1/n
    return [groups[k] for k in np.lexsort((golden, np.array([-len(g) for g in groups])))]


def survey(sites: list[Site], frames: int, units: str) -> Survey:
    """Means and deviations of the terrain and the brightness over all sites."""
    first = sites[0].observation
    bright = torch.cat([s.image[s.valid].flatten()[:: max(1, s.count // 2)] for s in sites])
    bright = bright[:: max(1, len(bright) // 200_000)]
    lit = bright[bright > 0.3 * bright.mean()] if len(bright) else torch.tensor([0.05])
    top = torch.quantile(bright, torch.tensor([0.9, 0.97, 0.99, 0.998])) if len(bright) else lit.repeat(4)
    terrain = [s.observation.elevation[:1] for s in sites]
    columns = [c for s in sites if (c := s.observation.detector_sample) is not None]
    known = len(columns) == len(sites)
    ends = (
        (min(float(c.nan_to_num(1e9).min()) for c in columns), max(float(c.nan_to_num(-1e9).max()) for c in columns))
        if known
        else (0.0, float(first.elevation.shape[-1] - 1))
    )
    level = float(torch.cat([z.flatten() for z in terrain]).double().mean())
    leaning = [torch.stack(lean(s.observation, level)).square().sum(0).mean() for s in sites]
    return Survey(
        crop_px=int(min(first.elevation.shape[-2:])),
        gsd=first.gsd,
        brightness=float(lit.mean()),
        brightness_quantiles=(float(top[0]), float(top[1]), float(top[2]), float(top[3])),
        slope=_moments([fields.slope(z, first.gsd) for z in terrain]),
        elevation=_moments(terrain),
        curvature=_moments([fields.curvature(z, first.gsd) for z in terrain]),
        relief=max(float(z.max() - z.min()) for z in terrain),
        columns=ends,
        sun_cotangent=float(torch.cat([sun_cotangent(s.observation.sun_direction) for s in sites]).mean()),
        lean_px=float(torch.stack(leaning).mean().sqrt()),
        units=units,
        has_detector=known,
        frames=frames,
        sites=len(sites),
    )


def _moments(parts: list[Tensor]) -> tuple[float, float]:
    values = torch.cat([p.flatten() for p in parts]).double()
    return float(values.mean()), max(float(values.std()), 1e-9)
