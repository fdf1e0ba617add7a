"""What a cause, as it is rendered, gains on ground that it was not fitted to."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch

from stages.diagnose.data.parallel import per_site
from stages.diagnose.judge.state import Cause, State, View
from stages.diagnose.likelihood.products import Rows, products
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.model.chain import Chain


def secant_gains(state: State, cause: Cause, look: View) -> None:
    """Set what the cause, as it was rendered, gains beside everything else on each piece of ground, and the residual with and without it.

    Effects with several values keep the gain that their columns had: one amount for all of them would not be held out.
    """
    chains = state.chains()
    every = [
        r for part in per_site(lambda k: _without(state, chains[k], cause, look, k), range(len(chains))) for r in part
    ]
    pixels = max(sum(float(r.patch.weight.square().sum()) for r in every), 1.0)
    cause.rms_before, cause.rms_after = (
        math.sqrt(sum(float(r.shared[0].abs().square().sum()) for r in rows) / pixels) for rows in (every, look.rows)
    )
    units = per_site(lambda k: products(every[k], look.model, look.grid, state.frames), range(len(every)))
    whole = Whole(units, dataclasses.replace(look.plan, shared=[*look.plan.shared, "secant"]), state.frames)
    for k in [k for k, n in enumerate(look.plan.shared) if n.startswith(cause.effect.name + ".")]:
        whole.precision.pop(1 + k, None)
    whole.precision |= {k + 1: v for k, v in look.whole.precision.items() if k >= look.whole.first}  # one column more
    cause.total = float(whole.gram[0, 0])
    if cause.single:
        beside = whole.stood_for([type(cause.effect)])
        if cause.found.levels:
            beside += (look.whole.scattered + 1).tolist()
        place = np.array([whole.first - 1])
        shades = type(cause.effect).lights_shadows
        cause.gains = whole.held_out(place, beside)
        cause.units = whole.power(place, np.ones(1)) if shades else whole.sizes


def _without(state: State, chain: Chain, cause: Cause, look: View, site: int) -> list[Rows]:
    """Rows of a site as they are without the cause, and what it brings as the last shared column."""
    others = [c.effect for c in state.causes if c is not cause]
    brought = (chain.render() - state.nominal.chain(chain.site, others).render())[None]
    out = []
    for row in (r for r in look.rows if r.patch.site == site):
        z, mean = row.patch.transform(brought, look.grid)
        fields = [
            torch.cat(x)
            for x in ((row.shared, z), (row.shared_mean, mean), (row.shared_dark, row.patch.shadow(brought)))
        ]
        for x in fields:
            x[0] = x[0] + x[-1]
        out.append(dataclasses.replace(row, shared=fields[0], shared_mean=fields[1], shared_dark=fields[2]))
    return out


__all__ = ["secant_gains"]
