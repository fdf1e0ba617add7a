"""What a cause, as it is rendered, gains on held-out ground."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.products import Products, Rows, products
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.model.chain import Chain
from stages.diagnose.search.state import Cause, State, View
from stages.effects import Effect


def secant_gains(state: State, cause: Cause, look: View) -> tuple[np.ndarray, np.ndarray, float]:
    """Nats that the cause, as it was rendered, gains beside everything else on held-out ground, and what they go with (labels,); the squares
    without it.

    Effects with several values keep the gain that their columns had on held-out ground: one amount for all would not be held out.
    """
    others = [c.effect for c in state.causes if c is not cause]
    few = 1 + sum(n.startswith("coefficient") for n in look.plan.shared)
    flat = Covariance.white(look.grid.annuli, state.frames)
    pieces = [
        more
        for k, chain in enumerate(state.chains())
        for more in _with_cause(state, chain, others, [r for r in look.rows if r.patch.site == k], look)
    ]
    plain = [products(_few(more, few), flat, look.grid, state.frames).gram for more in pieces]
    cause.rms_before, cause.rms_after = _rms(np.sum(plain, 0), look)
    units = [products(more, look.model, look.grid, state.frames) for more in pieces]
    whole = _beside(units, cause, look, state.frames)
    total = float(whole.gram[0, 0])
    if not cause.single:
        return cause.found.gains, cause.found.sizes, total
    form = whole.stood_for([type(cause.effect)])
    if cause.found.beside:
        form += (look.whole.scattered + 1).tolist()  # one shared column more
    place = np.array([whole.first - 1])
    shades = type(cause.effect).lights_shadows
    return whole.held_out(place, form), whole.power(place, np.ones(1)) if shades else cause.found.sizes, total


def _few(rows: Rows, count: int) -> Rows:
    """The first and the last of the shared columns, and none per frame."""
    keep = [*range(count), -1]
    return dataclasses.replace(
        rows,
        shared=rows.shared[keep],
        shared_mean=rows.shared_mean[keep],
        shared_dark=0 * rows.shared_dark[keep],
        own=rows.own[:0],
        own_mean=rows.own_mean[:0],
    )


def _beside(units: Sequence[Products], cause: Cause, look: View, frames: int) -> Whole:
    """Everything but the cause's own values, what it brought as the last shared column."""
    whole = Whole(units, dataclasses.replace(look.plan, shared=[*look.plan.shared, "secant"]), frames)
    for k in [k for k, n in enumerate(look.plan.shared) if n.startswith(cause.effect.name + ".")]:
        whole.precision.pop(1 + k, None)
    first = look.whole.first
    whole.precision |= {k + 1: v for k, v in look.whole.precision.items() if k >= first}  # one shared column more
    return whole


def _with_cause(state: State, chain: Chain, others: Sequence[Effect], rows: Sequence[Rows], look: View) -> list[Rows]:
    """Rows as they are without the cause, what it brought as the last column."""
    brought = (chain.render() - state.nominal.chain(chain.site, others).render())[None]
    out = []
    for row in rows:
        z, mean = row.patch.transform(brought, look.grid)
        shared, means = torch.cat([row.shared, z]), torch.cat([row.shared_mean, mean])
        dark = torch.cat([row.shared_dark, row.patch.shadow(brought)])
        for x in (shared, means, dark):
            x[0] = x[0] + x[-1]
        out.append(dataclasses.replace(row, shared=shared, shared_mean=means, shared_dark=dark))
    return out


def _rms(gram: np.ndarray, look: View) -> tuple[float, float]:
    """rms relative residual without and with the cause, the nominal coefficients fitted to either."""
    pixels = sum(float(r.patch.weight.square().sum()) for r in look.rows)
    without = np.eye(len(gram))
    with_ = without.copy()
    with_[-1, 0] = -1.0
    out = []
    for change in (without, with_):
        g = (change.T @ gram @ change)[:-1, :-1]
        fitted = np.linalg.lstsq(g[1:, 1:], g[1:, 0], rcond=1e-9)[0]
        out.append(math.sqrt(max(g[0, 0] - fitted @ g[1:, 0], 0.0) / max(pixels, 1.0)))
    return out[0], out[1]


__all__ = ["secant_gains"]
