"""A faint second image, displaced."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from stages.effects.base import Effect, Survey, Trial, register
from stages.effects.fields import kept_axes
from stages.effects.filters import gaussian
from stages.physics.formation.chain import State
from stages.physics.formation.resampling import displace
from stages.physics.photometry import Parameter

CLEAR_LAG = 4  # px, beyond which an echo is no matter of the point spread function, nor of charge that spills
RESAMPLED = 4  # px, from which on the measured image, which resampling blurs near by, may be repeated
SMOOTH = 2.0  # px2, variance: noise of what is repeated would make the share of it look smaller


@register
class Echo(Effect):
    name = "echo"
    slot = "sensor"
    title = "electronic or optical echo"
    mechanism = (
        "Cross-talk between channels, charge left behind at transfer and reflections in the optics repeat the image faintly, some "
        "pixels away along the detector's samples or lines. Less than 0.3 % is not reported: on rugged ground a blur leaves as much."
    )
    reference = "Humm et al. (2016), Space Sci. Rev. 200, 431 (echo of the LROC NACs)"
    confused_with = ("psf_blur", "misregistration")
    separate = "an image turned against the others, or one with sharp shadow edges"
    parameters = (
        Parameter("fraction", "1", -0.3, 0.5, 0.0, "share of the signal that is repeated"),
        Parameter("lag_px", "px", -64.0, 64.0, 4.0, "how much later the echo appears"),
    )
    coordinates = (*parameters, Parameter("axis", "1", 0.0, 1.0, 0.0, "0 along samples, 1 along lines"))
    possible = f"a lag of more than {CLEAR_LAG} px, since nearer it is not told from optics and spilled charge"
    strong: ClassVar = {"fraction": 0.05}
    shaped = ("lag_px",)
    one_sided: ClassVar = "lag_px"  # blur and relief that the DEM has not are alike before and behind
    tolerance: ClassVar = {"fraction": 0.003}

    @classmethod
    def trials(cls, survey: Survey) -> list[Trial]:
        # the nearest are there to lose to: blur and soft shadows, which look like them, would pass for an echo further off
        lags = [k for k in (2, 3, 4, 5, 6, 8, 10, 12, 16, 24) if k < survey.crop_px / 3]
        return [
            Trial(({"fraction": 0.03},), {"lag_px": float(sign * lag), "axis": float(axis)})
            for axis in (0, 1)
            for lag in lags
            for sign in (1, -1)
        ]

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """Nearer, an echo is not told from optics and spilled charge that are not alike before and behind."""
        return abs(values["lag_px"]) > CLEAR_LAG

    def apply(self, state: State) -> None:
        observation = state.observation
        step = kept_axes(observation, len(state.image))[int(self.values["axis"])]
        lag = torch.as_tensor(self.values["lag_px"], dtype=state.image.dtype)
        source = state.image
        # the DEM does not know where shadows end as well as the image does, whose resampling, though, blurs near by
        if state.measured is not None and not self.of_model and abs(float(lag)) >= RESAMPLED:
            unforeseen = state.measured() - source
            source = source + gaussian(torch.where(unforeseen.isfinite(), unforeseen, 0.0), SMOOTH)
        repeated = displace(source, -(lag * step[:, 0])[:, None, None], -(lag * step[:, 1])[:, None, None])
        state.image = state.image + self.value("fraction", state) * repeated
