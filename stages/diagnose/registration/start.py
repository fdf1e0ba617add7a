"""Where the images lie, roughly, before any form is fitted: a shift per frame, relief displacement or none, each image's own shift beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from stages.diagnose.data.aligned import aligned
from stages.diagnose.data.parallel import per_site
from stages.diagnose.data.sites import Site
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask
from stages.diagnose.registration.capture import contrast, correlations, peak
from stages.diagnose.registration.forms import without_albedo
from stages.diagnose.settings import BROAD, CAPTURE, CONTRAST, CORRELATED, SURE
from stages.effects.relief_displacement import lean
from stages.physics.formation.resampling import displace

Field = tuple[Tensor, Tensor]  # (n, H, W) px east and south, or broadcastable to it


def start(chains: Sequence[Chain], frames: int, level: float) -> tuple[list[Field], float]:
    """Displacement of every site's images, and the rms shift, px.

    One image of a small crop may look like the next crater. All images of a frame together seldom do: their shift is taken from the sum of
    their log likelihoods over all shifts, with relief displacement and without, whichever fits better for sure. An image that shows little of
    the contrast that is rendered, wherever it is laid, tells nothing of where it lies: under a high Sun another law looks like that, on all ground alike.
    """
    sites = [c.site for c in chains]
    found = []
    for share in (0.0, 1.0):
        leaning = [_leaning(s, share, level) for s in sites]
        with laid(sites, leaning):
            found.append((leaning, *_frame_shifts(chains, frames)))
    leaning, shifts, _ = found[found[1][2] > found[0][2] + SURE**2 / 2]
    known = [_moved(d, shifts[torch.from_numpy(s.frames)]) for d, s in zip(leaning, sites, strict=True)]
    with laid(sites, known):
        own = captured(chains)
    whole = torch.cat([shifts[torch.from_numpy(s.frames)] + d for d, s in zip(own, sites, strict=True)])
    return [_moved(k, d) for k, d in zip(known, own, strict=True)], float(whole.square().mean().sqrt())


@contextmanager
def laid(sites: Sequence[Site], known: Sequence[Field]) -> Iterator[None]:
    """Sites as if their images had been read without these displacements."""
    kept = [(s.read, s.read_valid) for s in sites]
    for site, field in zip(sites, known, strict=True):
        site.read, site.read_valid = aligned(site.read, site.read_valid, *field, displace)
    try:
        yield
    finally:
        for site, (image, valid) in zip(sites, kept, strict=True):
            site.read, site.read_valid = image, valid


def captured(chains: Sequence[Chain]) -> list[Tensor]:
    """(n, 2) shift east and south per site, px: each image's own, where it stands out from lying where it is."""

    def of(chain: Chain) -> tuple[Tensor, Tensor, Tensor]:
        site, rendered, lit = chain.site, chain.predict(), _lit(chain)
        every = correlations(_told(chain), site.read_valid, rendered, lit, CAPTURE, BROAD)
        shift, highest = peak(every)
        near = slice(CAPTURE - 1, CAPTURE + 2)
        still = every[:, near, near].flatten(1).amax(1)
        count = (site.read_valid & lit).sum((-2, -1)).float()
        z = (torch.atanh(highest.clamp(max=0.999)) - torch.atanh(still.clamp(-0.9, 0.999))) * (
            count / CORRELATED
        ).sqrt()
        border = (shift.abs() > CAPTURE - 0.5).any(1)
        faint = highest * _relative_contrast(site, rendered, lit) < CONTRAST
        return shift, torch.where(border | faint, 0.0, z), still

    out = []
    for shift, z, still in per_site(of, chains):
        near = shift.abs().amax(1) <= 1.5
        sure = (z > SURE) | (near & (still > 0.3))
        out.append(torch.where(sure[:, None], shift, 0.0))
    return out


def _frame_shifts(chains: Sequence[Chain], frames: int) -> tuple[Tensor, float]:
    """(frames, 2) px east and south, 0 where no shift is surely better, and the log likelihood of all frames there, nats."""

    def of(chain: Chain) -> tuple[Tensor, Tensor, Tensor]:
        site, rendered, lit = chain.site, chain.predict(), _lit(chain)
        r = correlations(_told(chain), site.read_valid, rendered, lit, CAPTURE, BROAD).clamp(0, 0.999)
        count = ((site.read_valid & lit).sum((-2, -1)) / CORRELATED)[:, None, None]
        shown = r * _relative_contrast(site, rendered, lit)[:, None, None]
        return -0.5 * count * torch.log1p(-r.square()), count * shown, count

    side = 2 * CAPTURE + 1
    likelihood, shown = torch.zeros(2, frames, side, side)
    count = torch.zeros(frames, 1, 1)
    for chain, own in zip(chains, per_site(of, chains), strict=True):
        for total, part in zip((likelihood, shown, count), own, strict=True):
            total.index_add_(0, torch.from_numpy(chain.site.frames), part)
    shifts, best = peak(likelihood)
    still = likelihood[:, CAPTURE, CAPTURE]
    there = shown.flatten(1).gather(1, likelihood.flatten(1).argmax(1, keepdim=True))[:, 0]
    sure = (best > still + SURE**2 / 2) & (there > CONTRAST * count[:, 0, 0])
    return torch.where(sure[:, None], shifts, 0.0), float(torch.where(sure, best, still).sum())


def _told(chain: Chain) -> Tensor:
    """(n, H, W) the images without albedo, which looks like a shift where it goes with relief."""
    return without_albedo(chain.site.read, chain.predict(), (chain.site.read_valid & _lit(chain)).float())


def _lit(chain: Chain) -> Tensor:
    return lit_mask(chain) | (chain.site.read_valid & chain.lit())


def _relative_contrast(site: Site, rendered: Tensor, lit: Tensor) -> Tensor:
    """(n,) of images over their renderings, both in I/F."""
    return contrast(site.read, site.read_valid, rendered, lit, BROAD) / site.gain.abs().clamp(min=1e-9)


def _leaning(site: Site, share: float, level: float) -> Field:
    east, south = lean(site.observation, level)
    return share * east, share * south


def _moved(field: Field, shift: Tensor) -> Field:
    return field[0] + shift[:, 0, None, None], field[1] + shift[:, 1, None, None]


__all__ = ["Field", "captured", "laid", "start"]
