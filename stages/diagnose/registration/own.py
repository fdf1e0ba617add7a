"""Where each image lies by itself: a shift or an affine map of its own beside what a form says of its frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.data.parallel import per_site
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import full_light
from stages.diagnose.registration.forms import Frame, Matched, displacement, match
from stages.diagnose.registration.squares import left
from stages.diagnose.registration.start import Field, captured, laid
from stages.diagnose.settings import CORRELATED
from stages.effects.relief_displacement import lean


def own_fields(
    chains: Sequence[Chain],
    shifts: Tensor,
    shares: Sequence[float],
    frame: Frame,
    level: float,
    terms: int,
) -> list[Field]:
    """Relief displacement by a share at each site plus each image's own shift (``terms`` 1) or affine map (3), captured beside it and the
    ``shifts`` (frames, 2, T) of frames.
    """
    sites = [c.site for c in chains]
    starts: list[list[Field]] = []
    # the strongest peak of a correlation may be a neighbouring crater, and the shift of a frame one of another part of the scene
    for own_share, of_frame in ((0.0, 1.0), (1.0, 1.0), (1.0, 0.0)):
        known = []
        for site, share in zip(sites, shares, strict=True):
            moved = of_frame * shifts[torch.from_numpy(site.frames), :, 0].float()[..., None, None]
            east, south = lean(site.observation, level)
            known.append((share * east + moved[:, 0], share * south + moved[:, 1]))
        if own_share:
            with laid(sites, known):
                own = captured(chains)
            known = [(e + d[:, :1, None], s + d[:, 1:, None]) for (e, s), d in zip(known, own, strict=True)]
        if not any(_near(known, other) for other in starts):  # they would end at the same place
            starts.append(known)
    ends = []
    matched: list[Matched] = []
    none = torch.zeros(len(shifts), 2, terms, dtype=shifts.dtype)
    for known in starts:
        for _ in range(3):
            matched = match_all(chains, known, frame, level, 1, terms)
            known = beside(matched, none, shares, 1, terms)
        ends.append(known)

    def nearest(k: int) -> Field:
        """Of every image at one site the displacement that leaves least."""
        every = [end[k] for end in ends]
        best = torch.from_numpy(np.argmin([squares for (squares,) in left(matched[k : k + 1], every)], 0))
        east, south = (torch.stack([field[axis] for field in every])[best, torch.arange(len(best))] for axis in (0, 1))
        return east, south

    return per_site(nearest, range(len(matched)))


def _near(first: Sequence[Field], second: Sequence[Field]) -> bool:
    """Whether displacements differ by half a pixel at most."""
    pairs = [(a, b) for f, s in zip(first, second, strict=True) for a, b in zip(f, s, strict=True)]
    return all(float((a - b).abs().max()) <= 0.5 for a, b in pairs)


def match_all(
    chains: Sequence[Chain],
    known: Sequence[Field],
    frame: Frame,
    level: float,
    pieces: int,
    terms: int | None = None,
) -> list[Matched]:
    """The products (``forms.match``) of every site in so many pieces a side, site after site."""

    def of(k: int) -> list[Matched]:
        return match(chains[k], full_light(chains[k]), known[k], frame, level, pieces, terms)

    return [m for part in per_site(of, range(len(chains))) for m in part]


def beside(
    matched: Sequence[Matched], coefficients: Tensor, share: float | Sequence[float], pieces: int, terms: int = 1
) -> list[Field]:
    """The form's displacement plus each image's own beside it, drawn to nothing as far as it is not known.

    share : of relief displacement, or one per site
    terms : 1 for a shift, 3 for an affine map about the crop's centre; the scatter of either is estimated
    """
    axis = len(matched[0].basis)
    place = torch.tensor([*range(terms), *range(axis, axis + terms)])
    degree = torch.tensor([min(k, 1) for k in range(terms)] * 2)
    parts = []
    number = len(matched) // pieces
    shares = [share] * number if isinstance(share, float) else list(share)
    for k, site_share in enumerate(shares):
        own_parts = matched[k * pieces : (k + 1) * pieces]
        m = own_parts[0]
        turn = _about_centre(m, terms)
        known = coefficients[torch.from_numpy(m.chain.site.frames)].flatten(1)
        known = torch.cat([known, torch.full((len(known), 1), site_share, dtype=known.dtype)], 1)
        gram = torch.stack([m.gram for m in own_parts]).sum(0)[:, place] / CORRELATED
        # what the residual still asks for once the form is taken out
        asks = torch.stack([m.score for m in own_parts]).sum(0)[:, place] / CORRELATED
        asks = asks - torch.einsum("nap,np->na", gram, known)
        parts.append((turn.T @ gram[:, :, place] @ turn, asks @ turn, turn, m))
    spread = torch.full((2,), 0.3, dtype=torch.float64)
    for _ in range(6):
        squares, n = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
        for gram, asks, _, _ in parts:
            inverse = torch.linalg.inv(gram + torch.diag(spread[degree] ** -2))
            own = torch.einsum("nab,nb->na", inverse, asks)
            squares.index_add_(0, degree, (own.square() + inverse.diagonal(dim1=1, dim2=2)).sum(0))
            n.index_add_(0, degree, torch.full((len(degree),), float(len(own)), dtype=torch.float64))
        spread = (squares / n.clamp(min=1)).sqrt().clamp(min=1e-3)
    out = []
    for (gram, asks, turn, m), site_share in zip(parts, shares, strict=True):
        own = torch.linalg.solve(gram + torch.diag(spread[degree] ** -2), asks[..., None])[..., 0] @ turn.T
        field = torch.einsum("nat,thw->anhw", own.float().view(len(own), 2, terms), m.basis[:terms])
        east, south = displacement(m, coefficients, site_share)
        out.append((east + field[0], south + field[1]))
    return out


def _about_centre(m: Matched, terms: int) -> Tensor:
    """(2 terms, 2 terms): polynomials over the scene for 1, and for east and south of the crop's centre over half its side."""
    turn = torch.eye(terms, dtype=torch.float64)
    for k in range(1, terms):
        here = m.basis[k].double()
        half = (here.max() - here.min()).clamp(min=1e-9) / 2
        turn[0, k], turn[k, k] = -here.mean() / half, 1 / half
    return torch.block_diag(turn, turn)


__all__ = ["beside", "match_all", "own_fields"]
