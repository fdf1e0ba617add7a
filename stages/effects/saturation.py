"""Bright pixels are cut off."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Survey, Trial, register
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

PILE = 150  # pixels
STANDS_OUT = 3.0  # times the bins below
RINGING = 0.015  # of the level, by which bicubic resampling of an edge of common contrast, or of noise that was cut off, overshoots
BINS = (
    0.02,
    0.002,
    0.001,
)  # of the level: noise added later makes the pile wide, a crowded histogram asks for narrow ones
GAP = 0.01  # of a wide pile: where next to nothing lies below it, it may be an image of its own, of smooth ground
BELOW = 8  # bins: further down a histogram that falls to its end is as high as a small pile


@register
class Saturation(Effect):
    name = "saturation"
    slot = "sensor"
    judged_apart = True
    keep_below = 0.97
    title = "saturation"
    mechanism = (
        "The full well or the converter's last step cuts the signal off: nothing brighter than a level is recorded."
    )
    reference = "Janesick (2001), Scientific Charge-Coupled Devices, SPIE (full well)"
    confused_with = ("nonlinearity",)
    separate = "an image of the same ground at a shorter exposure or a lower Sun"
    parameters = (Parameter("iof", "1", 1e-4, 10.0, 10.0, "level at which the signal is cut"),)
    strong: ClassVar = {"iof": 0.0}  # set by the trials: the data's own brightness decides

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        return [Trial(({"iof": q},)) for q in survey.brightness_quantiles]

    @classmethod
    def read_off(cls, bright: Tensor) -> tuple[float, float, float] | None:
        """Level, its error and the gain in nats, where pixels pile up at one level that none exceeds; bright : (N,) valid pixels."""
        if len(bright) < 1000:
            return None
        top = float(bright.kthvalue(max(1, int(0.9995 * len(bright)))).values)
        if top <= 0:
            return None
        for width in BINS:
            edges = top * (1 + width) ** torch.arange(-16.0, 4.0)
            counts = torch.histogram(bright, edges)[0]
            best = int(counts[6:].argmax()) + 6
            # resampling rings a little over the level, noise added later blurs it: the pile is three bins wide
            above = float((bright >= edges[best] * (1 + max(2 * width, RINGING))).sum())
            if width == BINS[0]:
                near = counts[max(best - 5, 0) : best - 1]
                before = near.mean() if near.min() > GAP * counts[best] else torch.inf
            else:  # whole numbers leave bins between them empty
                before = counts[max(best - BELOW, 0) : best - 1].max()
            pile = float(counts[best - 1 : best + 2].sum())
            if pile >= PILE and counts[best] >= STANDS_OUT * before and above <= 0.05 * pile:
                break
        else:
            return None
        inside = (bright >= edges[best]) & (bright < edges[best + 1])
        level = float(bright[inside].median())
        # an unbent histogram would hold a quarter of the pile in its last bin
        return level, 0.005 * level, 1.386 * int((bright >= cls.keep_below * level).sum())

    def apply(self, state: State) -> None:
        state.image = torch.minimum(state.image, self.value("iof", state))
