"""Walls beyond the DEM that leave whole images in the dark: their shadow is left out before anything else is looked at."""

from __future__ import annotations

from stages.diagnose.data.parallel import per_site
from stages.diagnose.judge.state import State
from stages.diagnose.likelihood.intervals import gain_interval
from stages.diagnose.model.nominal import fit
from stages.diagnose.settings import CLEAR, FAINT, SHADED
from stages.diagnose.sources.edges import Edges, dark_share
from stages.diagnose.sources.shadows import Shadows
from stages.effects import get_effect


def hide_dark(state: State) -> bool:
    """Hide ground that is dark though the DEM has the Sun above it, if a wall beyond the DEM surely makes it so, and fit the law again: images that lie
    in its shadow as a whole would pass for another law, or for gains of theirs. ``by_shadows`` looks at it in the end.
    """
    chains = [c for c in state.chains() if c.state.sun_horizon is not None]
    # how dark a shadow is nobody knows beside free offsets
    if not chains or state.free_gains or max(map(dark_share, chains)) < FAINT:
        return False
    shadows = Shadows(state, per_site(Edges, chains))
    walls = [effects for name, effects in shadows.every.items() if get_effect(name).raises_horizon]
    first = min((shadows.tried(w, []) for w in walls), key=lambda t: float(t.held_out().sum()), default=None)
    if first is None:
        return False
    before, after = shadows.tried([type(first.best)({}, state.data)], []).held_out(), first.held_out()
    if not gain_interval(before[before > 0], after[before > 0])[1] > 100 * SHADED:
        return False
    for chain in chains:
        sun, horizon, _ = chain.sunlight([first.best])
        known = chain.sunlight([])[1]
        assert horizon is not None and known is not None
        chain.site.hide((horizon > known) & (horizon > sun[:, None, None] - CLEAR))  # its height is not known yet
    state.leave_out_rare_images()
    fit(state.nominal, state.sites, [], state.units, [s.read for s in state.sites], start=True, law=True)
    return True


__all__ = ["hide_dark"]
