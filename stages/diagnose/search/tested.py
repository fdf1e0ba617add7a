"""The test pairs, which nothing was fitted to, under the model so far: they may take a name back."""

from __future__ import annotations

from stages.diagnose.likelihood.products import Rows
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask, scale_images
from stages.diagnose.rows.columns import Plan
from stages.diagnose.search.state import State

NOT_LEARNED = 1_000_000  # numbers of patches whose own size the covariance does not know


def hidden_rows(state: State, plan: Plan) -> list[tuple[Chain, list[Rows]]]:
    """Rows of the test pairs, laid over the ground as the registration has them."""
    out = []
    for number, site in enumerate(state.hidden):
        site.align()
        chain = state.nominal.chain(site, state.base)
        if state.free_gains:
            scale_images(site, site.laid, chain.predict(), lit_mask(chain))
            chain = state.nominal.chain(site, state.base)  # of the image in I/F
        out.append((chain, state.rows(NOT_LEARNED + number, chain, plan)))
    return out


__all__ = ["hidden_rows"]
