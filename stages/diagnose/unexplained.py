"""What is left when nothing more can be named: structure in the residual, and effects that the data cannot show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from stages.diagnose.images import FEWEST
from stages.diagnose.selection import EDGE_EFFECTS, Round, Search
from stages.diagnose.statistics import BASELINE, SiteWork
from stages.effects import effect_names, get_effect

CELL = 8  # px
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


def measure(works: list[SiteWork]) -> Structure:
    """Structure of the dynamic residual rows, in units of the noise."""
    cells, lines, columns, weights = [], [], [], []
    spectra = None
    for work in works:
        if work.chain.site.count < 2:
            continue
        y = work.dynamic
        used = (work.projector.weight > 0).float()
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
    """Effects of which these data would not show even a strong case."""
    named = {c.effect.name for c in state.causes}
    out = []
    deep = max((s.count for s in state.sites), default=0) >= FEWEST
    for name in effect_names():
        cls = get_effect(name)
        if name in named:
            continue
        if not cls.visible(state.data, state.has) or (state.dn and name in ("image_gain", "dark_bias")):
            out.append(name)
        elif cls.scope == "image":
            if not deep:
                out.append(name)
        elif cls.scope == "scene" and name != "saturation":
            evidence = seen.best.get(name)
            if evidence is None or evidence.left <= 0:
                out.append(name)
                continue
            if name in (*BASELINE, "distant_shadow"):
                continue
            column = evidence.candidate.trial.columns[0]
            (coordinate, reference), *_ = column.items()
            unit = abs(reference - cls.null()[coordinate])
            error = unit * math.sqrt(max(float(evidence.covariance[0, 0]), 0.0))
            size = abs(cls.strong[coordinate] - cls.null()[coordinate])
            if error * SEE > size:
                out.append(name)
    if state.data.crop_px < 16 and "distant_shadow" not in out:
        out.append("distant_shadow")
    if all(not _shaded(state, name, seen) for name in EDGE_EFFECTS):
        out += [n for n in EDGE_EFFECTS if n not in out and n not in named]
    return out


def _shaded(state: Search, name: str, seen: Round) -> bool:
    evidence = seen.best.get(name)
    return evidence is not None and float(evidence.covariance[0, 0]) < 1.0
