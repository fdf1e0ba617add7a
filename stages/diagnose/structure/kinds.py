"""Every kind of structure that is sought in what is left, in words."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from stages.diagnose.search.state import State, View
from stages.diagnose.settings import ALIKE, FAINT, FLAT, LINE, NOTABLE, PEAK, SPECKS, SURE
from stages.diagnose.structure.amplifiers import odd_and_even
from stages.diagnose.structure.blocks import blocks_of_compression
from stages.diagnose.structure.detector import pattern_of_detector
from stages.diagnose.structure.fields import field_of_images
from stages.diagnose.structure.innovations import Innovation, innovations
from stages.diagnose.structure.lines import across_columns, line_of_brightness, line_of_displacement
from stages.diagnose.structure.pixels import pixels_that_stand_out
from stages.diagnose.structure.profiles import bands, columns_that_stand_out, lines_of_their_own, profiles, seam
from stages.diagnose.structure.steps import steps_of_brightness

REPEATED = 0.015  # of the squares: bilinear resampling leaves up to two thirds of that, the nearest pixel more
STRAIGHT = 8.0  # robust standard deviations of columns from their neighbours: flat fields and noise made up to 5
# -log10 of the chance of its scatter: images of five simulators and photographs that have none had up to 6.3
SEAM = 9.0
UNEVEN = 0.003  # of the squares: images without a fault that are turned against the map had up to 0.001
PILED = "brightness that piles up at one level"


def structure(state: State, view: View, piled: float) -> dict[str, float]:
    """What is left that neither ground nor noise has, and its share: of a line, of the squares of that frame; of a field, of
    the squares of the broadest waves of all images; of all else, of all squares; weighted by the inverse covariance.

    piled : share of all pixels that pile up at one level
    """
    out: dict[str, float] = {}
    left = innovations(view.rows, view.model, view.grid, state.sites)
    columns = across_columns(state.sites, view.grid, state.frames)
    for without, ordinary in ((columns, 0.0), (None, FLAT)):
        line, share, rms = line_of_brightness(view.rows, view.model, view.grid, state.frames, without)
        if line > LINE and rms > ordinary:
            out.setdefault("lines across an image", share)
    line, share = line_of_displacement(left, view.grid, state.frames)
    if line > LINE and share > REPEATED:
        out["displacements that come back at equal distances"] = share
    alike, surely = field_of_images(view.rows, view.model, view.grid)
    if surely > ALIKE:
        out["a broad field in each image that is the same on all ground"] = alike
    if alike := pattern_of_detector(left, NOTABLE):  # pixels that differ by 0.2 % have up to that
        out["a pattern that stays on the detector whatever ground it shows"] = alike
    count, share = pixels_that_stand_out(left)
    if count >= SPECKS and share > FAINT**2:
        out[f"{count} single pixels that stand out"] = share
    surely, share = odd_and_even(left)
    if surely > SURE and share > FAINT**2:
        out["odd and even columns of the detector that differ"] = share
    line, rms, frame = steps_of_brightness(state.sites, state.frames)
    if line > LINE and (share := rms**2 / _own(view, frame)) > NOTABLE:
        out["brightness that comes in equal steps"] = min(share, 1.0)
    share, surely = lines_of_their_own(left)
    if surely > UNEVEN:
        out["lines of the detector that are brighter or darker by themselves, others in every image"] = share
    ratio, share = blocks_of_compression(left, state.frames)
    if ratio > PEAK and share > FAINT**2:
        out["edges every eight pixels of the detector, as compression leaves them"] = share
    out |= _on_columns([one for one in left if state.sites[one.patch.site].observation.detector_line is not None])
    if piled:
        out[PILED] = piled
    return out


def _on_columns(left: Sequence[Innovation]) -> dict[str, float]:
    """What images of a known detector have in common on its columns and lines."""
    out: dict[str, float] = {}
    for axis, what in ((1, "columns"), (0, "lines")):
        along = profiles(left, axis)
        chance, share = seam(along)
        if chance > SEAM:
            out[f"a seam between {what} of the detector, where each image has a step of its own"] = share
        chance, share = bands(along)
        if chance > LINE:
            out[f"bands over the {what} of the detector, at the same distance in all images"] = share
        away, share = columns_that_stand_out(along)
        if away > STRAIGHT:
            out[f"single {what} of the detector that stand out"] = share
    return out


def _own(view: View, frame: int) -> float:
    """Variance of what an image has of its own, relative to brightness squared."""
    waves = torch.bincount(view.grid.annulus, minlength=view.grid.annuli)
    return float((view.model.own[:, frame] * waves).sum() / waves.sum())


__all__ = ["structure"]
