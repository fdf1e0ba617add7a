"""What is free is fitted on train pairs: global coefficient sets, and gain and offset of uncalibrated images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from stages.evaluate.least_squares import (
    FrameGram,
    fit_nonlinear,
    sample_gram,
    solve_coefficients,
    solve_gain_offset,
    solve_uncalibrated,
)
from stages.evaluate.renderers import Batch, Constant, Renderer, batches, read_batch, unit_images
from stages.evaluate.rows import HAPKE_FREE, Row
from stages.network.pixels import Pixels
from stages.pairs.reader import PairReader
from stages.physics.formation.geometry import Angles
from stages.physics.formation.radiometry import full_scale

SAMPLE_PIXELS = 100_000  # for sets that are fitted to a random sample
LEVENBERG_PIXELS = 20_000  # of these, for models that are not linear: a handful of parameters needs no more


@dataclass(frozen=True)
class Fitting:
    """What free parameters are fitted on.

    train : indices of train pairs; orphans : indices of scored pairs of images that no train pair shows
    frames : how many images there are; scale : full range of DN, 1 for calibrated images; size : pairs at a time
    """

    reader: PairReader
    train: np.ndarray
    orphans: np.ndarray
    frames: int
    calibrated: bool
    scale: float
    size: int
    seed: int

    @property
    def steps(self) -> int:
        """How many pairs ``fit_rows`` reads."""
        return len(self.train) if self.calibrated else 2 * len(self.train) + len(self.orphans)


def choose_fit_pairs(reader: PairReader, wanted: np.ndarray, limit: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Train pairs to fit on, and pairs of ``wanted`` in images that no train pair shows; indices (n,) each, sorted.

    At most ``limit`` of each (0: all), drawn in proportion to the frames' pairs.
    """
    split, frame = reader.split, reader.frame
    train = np.flatnonzero(split == 0)
    orphans = wanted[~np.isin(frame[wanted], frame[train])]
    return _thin(train, frame, limit, seed), _thin(orphans, frame, limit, seed)


def _thin(indices: np.ndarray, frame: np.ndarray, limit: int, seed: int) -> np.ndarray:
    if not limit or len(indices) <= limit:
        return indices
    rng = np.random.default_rng(seed)
    kept = []
    for f in np.unique(frame[indices]):
        mine = indices[frame[indices] == f]
        share = max(1, round(limit * len(mine) / len(indices)))
        kept.append(rng.choice(mine, size=min(share, len(mine)), replace=False))
    return np.sort(np.concatenate(kept))


def fit_rows(data: Fitting, rows: Sequence[Row], tick: Callable[[int], None] = lambda count: None) -> None:
    """Fit everything that is free in the renderers of ``rows`` on the train pairs.

    Uncalibrated frames without train pairs get their gain and offset from the orphans, which no shared coefficient sees.
    """
    renderers = list({row.renderer.name: row.renderer for row in rows}.values())
    _fit_sets(data, renderers, tick)
    if data.calibrated:
        return
    grams = {r.name: (FrameGram(1, data.frames), FrameGram(1, data.frames)) for r in renderers}
    for part, indices in enumerate((data.train, data.orphans)):
        for chosen in batches(indices, data.size):
            batch = read_batch(data.reader, chosen, data.scale)
            for renderer in renderers:
                features = renderer.radiance_factor(batch)[:, None]
                grams[renderer.name][part].add(features, batch.image, batch.usable, batch.frame)
            tick(len(chosen))
    for renderer in renderers:
        of_train, of_orphans = grams[renderer.name]
        joined = np.where((of_train.pixels == 0)[:, None, None], of_orphans.gram, of_train.gram)
        renderer.gain, renderer.offset = solve_gain_offset(joined, np.ones(1))


def _fit_sets(data: Fitting, renderers: Sequence[Renderer], tick: Callable[[int], None]) -> None:
    """One coefficient set for all ground for every renderer that has one."""
    frames, calibrated = data.frames, data.calibrated
    by_name = {r.name: r for r in renderers}
    shared = [by_name[name] for name in ("global", "global_extended") if name in by_name]
    exact = bool(shared) and shared[0].model.linear
    sampled = ({"kernels", "hapke_fitted"} & set(by_name)) or (shared and not exact)
    albedo = by_name.get("lunar_lambert") if calibrated else None  # of uncalibrated images the gains carry it
    gram = FrameGram(len(shared[0].model.parameters), frames) if exact else None
    albedo_gram = FrameGram(1, frames)
    samples: list[torch.Tensor] = []
    rng = np.random.default_rng(data.seed)
    per_crop = max(1, SAMPLE_PIXELS // max(1, len(data.train)))
    for chosen in batches(data.train, data.size) if exact or sampled or albedo else ():
        batch = read_batch(data.reader, chosen, data.scale)
        if gram is not None:
            gram.add(unit_images(shared[0].model, batch), batch.image, batch.usable, batch.frame)
        if albedo is not None:
            albedo_gram.add(albedo.radiance_factor(batch)[:, None], batch.image, batch.usable, batch.frame)
        if sampled:
            samples.append(draw_pixels(batch, per_crop, rng))
        tick(len(chosen))
    if albedo is not None:
        albedo.scale = float(solve_coefficients(albedo_gram.gram)[0])
    sample = torch.cat(samples, dim=1) if samples else None
    if gram is not None:
        found = Constant(_solve_linear(gram.gram, shared[0], calibrated))
    elif shared and sample is not None:
        found = Constant(fit_nonlinear(shared[0].model, as_pixels(sample, LEVENBERG_PIXELS), calibrated))
    for renderer in shared:
        renderer.coefficients = found
    if "kernels" in by_name and sample is not None:
        grams = sample_gram(by_name["kernels"].model, as_pixels(sample), frames)
        by_name["kernels"].coefficients = Constant(_solve_linear(grams, by_name["kernels"], calibrated))
    if "hapke_fitted" in by_name and sample is not None:
        hapke, thin = by_name["hapke_fitted"], as_pixels(sample, LEVENBERG_PIXELS)
        hapke.coefficients = Constant(fit_nonlinear(hapke.model, thin, calibrated, HAPKE_FREE))


def _solve_linear(gram: np.ndarray, renderer: Renderer, calibrated: bool) -> np.ndarray:
    if calibrated:
        return solve_coefficients(gram)
    return solve_uncalibrated(gram, np.array([p.default for p in renderer.model.parameters]))


def dn_scale(reader: PairReader, indices: np.ndarray, size: int) -> float:
    """Full DN range of the images from the largest valid value of the pairs ``indices``, read ``size`` at a time."""
    largest = 0.0
    for chosen in batches(np.unique(indices), size):
        valid = reader.valid(chosen)
        if valid.any():
            largest = max(largest, float(reader.image(chosen)[valid].max()))
    return full_scale(largest)


def draw_pixels(batch: Batch, per_crop: int, rng: np.random.Generator) -> torch.Tensor:
    """Up to ``per_crop`` usable pixels of every crop: the fields of :func:`as_pixels`, (6, N) float64."""
    state = batch.state
    visibility = torch.ones_like(batch.image) if state.sun_visibility is None else state.sun_visibility
    width = batch.image[0].numel()
    chosen = []
    for b, usable in enumerate(batch.usable):
        places = np.flatnonzero(usable.reshape(-1).numpy())
        picked = rng.choice(places, size=min(per_crop, len(places)), replace=False)
        chosen.append(b * width + np.sort(picked))
    index = torch.from_numpy(np.concatenate(chosen).astype(np.int64))
    angles, frame = state.angles, torch.as_tensor(batch.frame)[:, None, None]
    fields = angles.cos_incidence, angles.cos_emission, angles.cos_phase, visibility, batch.image, frame
    return torch.stack([field.expand(batch.image.shape).reshape(-1)[index].double() for field in fields])


def as_pixels(fields: torch.Tensor, most: int = SAMPLE_PIXELS) -> Pixels:
    """At most ``most`` of drawn pixels (6, N), evenly taken."""
    *angles, light, image, frame = fields[:, :: max(1, -(-fields.shape[1] // most))]
    return Pixels(Angles(*angles), light, image, frame=frame.long())
