"""The test pairs, which nothing was fitted to, under the model so far: they may take a name back."""

from __future__ import annotations

import dataclasses

from stages.diagnose.likelihood.products import Rows
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask, scale_images
from stages.diagnose.rows.columns import Plan, make_plan
from stages.diagnose.search.refine import along
from stages.diagnose.search.state import State, View

NOT_LEARNED = 1_000_000  # numbers of patches whose own size the covariance does not know


def hidden_look(state: State, view: View) -> View | None:
    """The test pairs, laid over the ground as the registration has them, as ``view`` has all others; None where there are none.

    To be taken before a cause is put into the model: a step along columns that were rendered elsewhere would be another step.
    """
    chains = _chains(state)
    if not chains:
        return None
    plan = make_plan(chains[0], along(state, view), state.data, candidates=(), impossible=state.impossible)
    rows = [r for k, chain in enumerate(chains) for r in state.rows(state.patches(NOT_LEARNED + k, chain), chain, plan)]
    return dataclasses.replace(view, plan=plan, rows=rows)


def hidden_rows(state: State, before: View | None, plan: Plan) -> list[tuple[Chain, list[Rows]]]:
    """Their rows under another plan, with the causes that are named by now."""
    if before is None:
        return []
    return [(c, state.moved(before, NOT_LEARNED + k, c, plan)) for k, c in enumerate(_chains(state))]


def _chains(state: State) -> list[Chain]:
    out = []
    for site in state.hidden:
        site.align()
        chain = state.nominal.chain(site, state.base)
        if state.free_gains:
            scale_images(site, site.laid, chain.predict(), lit_mask(chain))
            chain = state.nominal.chain(site, state.base)  # of the image in I/F
        out.append(chain)
    return out


__all__ = ["hidden_look", "hidden_rows"]
