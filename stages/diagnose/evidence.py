"""Evidence for each candidate: held-out gain, cluster-robust significance, size against the noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from stages.diagnose.columns import Candidate
from stages.diagnose.numbers import f_tail
from stages.diagnose.statistics import SITE, Statistics


@dataclass
class Evidence:
    """What speaks for one candidate.

    amount : (K,) multiples of the trial's columns; covariance robust (K, K)
    gain, gain_error : held-out gain, nats; gain_image, gain_place : its two halves
    p : of the larger of two cluster-robust tests; fid : rms effect over rms noise
    share : (C,) contributions of clusters to the gain, for paired comparisons
    """

    candidate: Candidate
    amount: Tensor
    covariance: Tensor
    gain: float
    gain_error: float
    gain_image: float
    gain_place: float
    p: float
    statistic: float
    fid: float
    share: Tensor
    left: float  # share of the template's energy that the nuisances leave
    unit: float = 0.0  # size over noise of the first column at amount 1
    agreement: float = 1.0  # gain of one amount for all sites over that of an amount for each
    clusters: float = 0.0  # effective number, (sum of energies)^2 over the sum of their squares, that carry it
    along: dict[str, float] = field(default_factory=dict)  # further errors, along what the search alone found
    moving: float = 1.0  # share of the gain in the dynamic rows, the rest being in maps of the ground
    lowered: float = 0.0  # part of the first amount's error that can only have made it too small

    @property
    def effect(self) -> str:
        return self.candidate.effect


def weigh(data: Statistics, only: slice = slice(None)) -> list[Evidence]:
    """Evidence for every candidate, the nuisance columns fitted along."""
    m = data.count
    sums = data.products.sum(0)
    normal = sums[:m, :m] + torch.diag(1e-9 * sums[:m, :m].diagonal().clamp(min=1e-12) + data.bound**-2)
    share = torch.linalg.solve(normal, sums[:m, m:]) if m else sums[:0, m:]  # (m, 1 + E)
    # what is left of the residual and of every candidate, per cluster: rows X - N share
    n, cross = data.products[:, :m, :m], data.products[:, :m, m:]
    delta, gamma = share[:, 0], share[:, 1:]
    score = data.products[:, m + 1 :, m] - torch.einsum("cme,m->ce", cross[:, :, 1:], delta)
    score = score - (cross[:, :, 0] - n @ delta) @ gamma
    places, cells = _groups(data.place), _groups(data.image)
    sites = _groups(data.place // SITE)
    moving = torch.from_numpy(~data.static)
    out = []
    for candidate in data.candidates[only]:
        part = candidate.columns
        columns = slice(m + 1 + part.start, m + 1 + part.stop)
        g = gamma[:, part]
        half = torch.einsum("cmk,ml->ckl", data.products[:, :m, columns], g)
        raw = data.products[:, columns, columns]
        gram = raw - half - half.transpose(1, 2) + torch.einsum("mk,cmn,nl->ckl", g, n, g)
        energy = float(raw.sum(0).diagonal().sum())
        # the pull of the bounds on the nuisances belongs to no cluster: it is small and left out
        found = _weigh_one(candidate, score[:, part], gram, places, cells, data.rows, energy)
        found.agreement = _agreement(found.amount, score[:, part], gram, sites)
        if found.gain > 0:
            found.moving = min(max(float(found.share[moving].sum()) / found.gain, 0.0), 1.0)
        out.append(found)
    return out


def _groups(labels: np.ndarray) -> tuple[Tensor, int]:
    _, index = np.unique(labels, return_inverse=True)
    return torch.from_numpy(index), int(index.max()) + 1 if len(index) else 0


def _weigh_one(candidate, score: Tensor, gram: Tensor, places, images, rows: float, raw: float) -> Evidence:
    k = candidate.size
    total_u, total_g = score.sum(0), gram.sum(0)
    scale = float(total_g.diagonal().mean())
    if not scale > 1e-9 * max(raw, 1e-12) or scale < 1e-6:
        zero = torch.zeros(k, dtype=torch.float64)
        return Evidence(candidate, zero, torch.eye(k).double() * 1e12, 0, 0, 0, 0, 1.0, 0.0, 0.0, score[:, 0] * 0, 0.0)
    ridge = 1e-6 * torch.diag(total_g.diagonal().clamp(min=1e-9 * scale))
    inverse = torch.linalg.inv(total_g + ridge)
    amount = inverse @ total_u
    halves, p, statistic, covariance, fewest = [], 0.0, math.inf, None, math.inf
    share = torch.zeros(len(score), dtype=torch.float64)
    for labels, count in (images, places):
        u = torch.zeros(count, k, dtype=torch.float64).index_add_(0, labels, score)
        g = torch.zeros(count, k, k, dtype=torch.float64).index_add_(0, labels, gram)
        if count < 3:
            continue
        left_out = torch.linalg.solve(total_g + ridge - g, (total_u - u)[..., None])[..., 0]
        gain = (left_out * u).sum(1) - 0.5 * torch.einsum("ck,ckl,cl->c", left_out, g, left_out)
        halves.append((float(gain.sum()), float(gain.std()) * math.sqrt(count)))
        energy = torch.diagonal(g, dim1=1, dim2=2).sum(1)
        own = torch.diagonal(gram, dim1=1, dim2=2).sum(1)
        share += 0.5 * gain[labels] * own / energy[labels].clamp(min=1e-30)
        deleted = u - torch.einsum("ckl,cl->ck", g, left_out)
        meat = deleted.T @ deleted
        effective = float(energy.sum() ** 2 / energy.square().sum().clamp(min=1e-30))
        fewest = min(fewest, effective)
        robust = inverse @ meat @ inverse
        wald = (
            float(amount @ torch.linalg.solve(robust + torch.diag(1e-12 * robust.diagonal().clamp(min=1e-200)), amount))
            / k
        )
        freedom = max(effective - k, 0.8 * (count - 1 - k), 0.5)
        tail = f_tail(wald, k, freedom)
        if 2 * k > count:  # with about as many columns as clusters only the held-out direction can be tested
            held = (left_out * u).sum(1)
            wald = float(held.sum() ** 2 / held.square().sum().clamp(min=1e-30)) if float(held.sum()) > 0 else 0.0
            tail = f_tail(wald * max(count - 1, 1) / max(count - wald, 1e-9), 1, max(count - 1, 1))
        if tail >= p:
            p, statistic, covariance = tail, wald, robust
    if not halves:
        return Evidence(candidate, amount, inverse, 0, 0, 0, 0, 1.0, 0.0, 0.0, share, 0.0)
    size = math.sqrt(max(float(amount @ total_g @ amount), 0.0) / max(rows, 1.0))
    gains = [h[0] for h in halves]
    left = float(total_g.diagonal().sum()) / max(raw, 1e-30)
    return Evidence(
        candidate,
        amount,
        covariance,
        float(np.mean(gains)),
        max(h[1] for h in halves),
        gains[0],
        gains[-1],
        p,
        statistic,
        size,
        share,
        left,
        math.sqrt(max(float(total_g[0, 0]), 0.0) / max(rows, 1.0)),
        clusters=fewest,
    )


def _agreement(amount: Tensor, score: Tensor, gram: Tensor, sites: tuple[Tensor, int]) -> float:
    """What is wrong with the light or the camera is wrong alike everywhere; a misfit of the ground is not."""
    labels, count = sites
    k = len(amount)
    if count < 3:
        return 1.0
    u = torch.zeros(count, k, dtype=torch.float64).index_add_(0, labels, score)
    g = torch.zeros(count, k, k, dtype=torch.float64).index_add_(0, labels, gram)
    ridge = 1e-6 * torch.diag(g.sum(0).diagonal().clamp(min=1e-12))
    own = 0.5 * float((torch.linalg.solve(g + ridge, u[..., None])[..., 0] * u).sum())
    common = float(amount @ u.sum(0) - 0.5 * amount @ g.sum(0) @ amount)
    # nats that the further amounts gain from noise alone: half a chi square, two standard deviations above its mean
    chance = 0.5 * k * (count - 1) + math.sqrt(2 * k * (count - 1))
    return common / max(own - chance, 1e-9)


def best_guises(evidence: list[Evidence]) -> dict[str, Evidence]:
    """Per effect the guise with the largest held-out gain."""
    best: dict[str, Evidence] = {}
    for item in evidence:
        if item.effect not in best or item.gain > best[item.effect].gain:
            best[item.effect] = item
    return best
