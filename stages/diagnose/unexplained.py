"""What is left when nothing more can be named: structure in the residual, and effects that the data cannot show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from stages.diagnose.images import FEWEST
from stages.diagnose.looking import Round
from stages.diagnose.naming import FEW_PIXELS, floor_fid, suspected
from stages.diagnose.preparing import Remains
from stages.diagnose.state import Search
from stages.effects import effect_names, get_effect
from stages.effects.penumbra import BEYOND

CELL = 8  # px
CLUSTERS = 2.0  # effective number that must carry an effect: one alone could be anything's
SEE = 4.0  # standard errors that a strong effect must reach before its absence means anything
STRUCTURE = 0.17  # rms over noise of structure that no catalogue effect has and ordinary data do not show
PEAK = 12.0  # power of one frequency over the median, stacked over images


@dataclass
class Structure:
    """fields : rms of cell means over noise; lines, columns : of profiles; peak : of the stacked spectrum; largest : the verdict's."""

    fields: float
    lines: float
    columns: float
    peak: float

    @property
    def largest(self) -> float:
        return max(self.fields, self.lines, self.columns)

    @property
    def present(self) -> bool:
        return self.largest > STRUCTURE or self.peak > PEAK


def measure(works: list[Remains]) -> Structure:
    """Structure of the dynamic residual rows, in units of the noise."""
    cells, lines, columns, weights = [], [], [], []
    spectra = None
    for work in works:
        if work.site.count < 2:
            continue
        y = work.dynamic
        used = (work.weight > 0).float()
        y = y.clamp(-4, 4) * used
        noise = _noise(y, used)
        y = y / noise
        height, width = y.shape[-2:]
        h, w = height // CELL * CELL, width // CELL * CELL
        block = y[:, :h, :w].reshape(len(y), h // CELL, CELL, w // CELL, CELL)
        area = used[:, :h, :w].reshape(len(y), h // CELL, CELL, w // CELL, CELL).sum((2, 4))
        full = area > 0.6 * CELL * CELL
        mean = block.sum((2, 4)) / area.clamp(min=1)
        cells.append((mean.square() - 1 / area.clamp(min=1))[full])
        for axis, out in ((-1, lines), (-2, columns)):
            count = used.sum(axis)
            profile = y.sum(axis) / count.clamp(min=1)
            out.append((profile.square() - 1 / count.clamp(min=1))[count > 0.5 * y.shape[axis]])
        good = used.mean((-2, -1)) > 0.5
        if bool(good.any()):
            power = torch.fft.rfft2(y[good]).abs().square().mean(0) / (height * width)
            spectra = power if spectra is None else spectra + power
        weights.append(len(y))
    return Structure(_rms(cells), _rms(lines), _rms(columns), _peak(spectra))


def _noise(y: torch.Tensor, used: torch.Tensor) -> torch.Tensor:
    """Noise per image from differences of pixels two apart, which smooth structure does not reach; (n, 1, 1)."""
    step = (y[..., 2:] - y[..., :-2]) * used[..., 2:] * used[..., :-2]
    count = (used[..., 2:] * used[..., :-2]).sum((-2, -1)).clamp(min=1)
    return (step.square().sum((-2, -1)) / count / 2).clamp(min=1e-6).sqrt()[:, None, None]


def _rms(parts: list[torch.Tensor]) -> float:
    values = torch.cat(parts) if parts else torch.zeros(1)
    return math.sqrt(max(float(values.mean()), 0.0)) if len(values) else 0.0


def _peak(power: torch.Tensor | None) -> float:
    """Largest power of a frequency above 3 cycles per crop over the median."""
    if power is None:
        return 0.0
    height = power.shape[0]
    ky = torch.minimum(torch.arange(height), height - torch.arange(height))[:, None]
    kx = torch.arange(power.shape[1])
    middle = torch.maximum(ky, kx) > 3
    return float(power[middle].max() / power[middle].median().clamp(min=1e-12))


def blind_effects(state: Search, seen: Round) -> list[str]:
    """Effects of which these data would not show even a strong case, or showed one within its errors or too small for a name."""
    named, doubtful = {c.effect.name for c in state.causes}, state.unsure | suspected(state, seen)
    return [n for n in effect_names() if n not in named and (n in doubtful or not _would_show(n, state, seen))]


def _would_show(name: str, state: Search, seen: Round) -> bool:
    cls = get_effect(name)
    if not cls.visible(state.data, state.has) or (state.dn and name in ("image_gain", "dark_bias")):
        return False
    if cls.scope != "scene":
        return state.deepest >= FEWEST
    if name == "saturation":  # the histogram shows it
        return not state.dn
    e = seen.best.get(name)
    if e is None or e.left <= 0 or e.clusters < CLUSTERS:
        return False
    (coordinate, reference), *_ = e.candidate.trial.columns[0].items()
    unit = abs(reference - cls.null()[coordinate])
    error = unit * math.sqrt(max(float(e.covariance[0, 0]), 0.0))
    size = abs(cls.strong[coordinate] - cls.null()[coordinate]) or unit
    if cls.channel in ("lit", "edge") and name not in FEW_PIXELS and e.unit * size / unit < floor_fid(state.data.slope):
        return False
    least = cls.tolerance.get(coordinate, 0.0)
    if name == "penumbra":
        least = (BEYOND * e.candidate.trial.fixed["relief_deg"]) ** 2 - cls.null()[coordinate]
    return error * SEE < size - least
