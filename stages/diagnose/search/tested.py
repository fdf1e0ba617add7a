"""What a cause gains on the test pairs, which nothing was fitted to: they may take a name back."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray

from stages.diagnose.likelihood.products import weighed_squares
from stages.diagnose.model.nominal import fit, lit_mask, scale_images
from stages.diagnose.registration.forms import aligned
from stages.diagnose.rows.patches import make_patches
from stages.diagnose.search.state import Cause, State, View

NOT_LEARNED = 1_000_000  # numbers of patches whose own size the covariance does not know


def hidden_gains(state: State, cause: Cause, look: View) -> list[tuple[NDArray[np.float64], str]]:
    """What a cause, as rendered, gains on every ground of the test pairs over the model without it, fitted to the same pairs as ever.

    In nats, and in percent of the squared relative residual.
    """
    others = [c.effect for c in state.causes if c is not cause]
    less = copy.copy(state.nominal)
    fit(less, state.sites, others, state.units, [s.image for s in state.sites])
    if state.free_gains:
        state.fit()
    _, pieces = state.grid()
    parts: list[list[float]] = []
    grounds: list[int] = []
    for number, site in enumerate(state.hidden):
        chain, plain = state.nominal.chain(site, state.base), less.chain(site, others)
        image, site.valid = site.read, site.read_valid
        if site.displacement is not None:
            image, site.valid = aligned(site.read, site.read_valid, *site.displacement)
        site.image = image
        if state.free_gains:
            scale_images(site, image, chain.predict(), lit_mask(chain))
        residual = torch.stack([site.image - plain.predict(), site.image - chain.predict()])
        for patch in make_patches(NOT_LEARNED + number, chain, pieces, state.free_gains):
            z, mean = patch.transform(residual, look.grid)
            weighed = [weighed_squares(z[k], mean[k], patch, look.model, look.grid) for k in (0, 1)]
            squares = (patch.relative(residual) * patch.weight).square().sum((1, 2, 3)).tolist()
            parts.append([*weighed, *squares])
            grounds.append(site.ground)
    if not parts:
        return []
    table = np.array(parts)
    if len(set(grounds)) >= 3:  # else pieces of ground, where there are too few grounds for an interval
        table = np.stack([np.bincount(grounds, weights=column) for column in table.T], 1)
    percent = 100 * (table[:, 2] - table[:, 3]) / max(float(table[:, 2].sum()), 1e-30)
    return [(0.5 * (table[:, 0] - table[:, 1]), "nats"), (percent, "% of the squares")]


__all__ = ["hidden_gains"]
