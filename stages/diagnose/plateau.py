"""Saturation shows in the histogram itself: pixels pile up at one level that none exceeds."""

from __future__ import annotations

import torch

from stages.diagnose.data import Site
from stages.diagnose.state import Cause
from stages.effects import Survey, get_effect

PILE = 3.0  # pixels in the bin (2 %) of the level over those in the bins below it
LEAST = 150  # pixels
KEEP_BELOW = 0.97  # of the level: what is cut off says nothing more ...
CLEAR_OF = 0.9  # ... and where the prediction comes as close as this, what is left is biased


def plateau(sites: list[Site]) -> float | None:
    """The level at which I/F is cut off, or None."""
    bright = torch.cat([s.image[s.valid].flatten() for s in sites])
    if len(bright) < 1000:
        return None
    top = float(bright.kthvalue(max(1, int(0.9995 * len(bright)))).values)
    if top <= 0:
        return None
    edges = top * 1.02 ** torch.arange(-16.0, 4.0)
    counts = torch.histogram(bright, edges)[0]
    best = int(counts[6:].argmax()) + 6
    before = counts[max(best - 5, 0) : best - 1].mean()
    above = float(counts[best + 2 :].sum())
    # resampling rings a little over the level, noise added later blurs it: the pile is three bins wide
    pile = float(counts[best - 1 : best + 2].sum())
    if pile < LEAST or counts[best] < PILE * before or above > 0.05 * pile:
        return None
    inside = (bright > edges[best]) & (bright < edges[best + 1])
    return float(bright[inside].median())


def saturated(level: float, data: Survey, sites: list[Site]) -> Cause:
    """The cause; what was cut off is masked elsewhere, and the rest judged as if nothing had happened."""
    count = sum(int((s.image >= KEEP_BELOW * level).sum()) for s in sites)
    effect = get_effect("saturation")({"iof": level}, data)
    effect.held = ("iof",)
    # an unbent histogram would hold a quarter of the pile in its last bin: log-likelihood of the excess
    gain = 1.386 * count
    return Cause(effect, 1e-12, gain, gain**0.5, 1.0, ["saturation"], {"iof": 0.005 * level})


__all__ = ["KEEP_BELOW", "plateau", "saturated"]
