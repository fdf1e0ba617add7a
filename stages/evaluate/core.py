"""The comparison itself: fit what is free on the train split, then score every model on the chosen split."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from stages.evaluate import fit
from stages.evaluate.metrics import psnr, squared_error, ssim
from stages.evaluate.perceptual import Perceptual
from stages.evaluate.renderers import (
    Batch,
    Constant,
    Predictor,
    Reader,
    Renderer,
    learned,
    published,
    read_batch,
    unit_images,
)
from stages.physics.formation.chain import Extension
from stages.physics.formation.radiometry import crop_range, full_scale

SAMPLE_PIXELS = 100_000  # for models that are not linear in their parameters
TITLES = {
    "learned": "learned reflectance",
    "learned_gain_offset": "learned, least-squares gain + offset per crop",
    "learned_extended": "learned, with the diagnosed effects",
    "learned_extended_gain_offset": "learned, diagnosed effects, gain + offset per crop",
    "global": "same model, one global coefficient set",
    "global_extended": "global set, with the diagnosed effects",
    "lunar_lambert": "Lunar-Lambert, albedo fitted",
    "hapke_raw": "Hapke, published parameters",
    "hapke_minmax": "Hapke, min-max matched per crop (the paper's baseline)",
    "hapke_gain": "Hapke, least-squares gain per crop",
    "hapke_gain_offset": "Hapke, least-squares gain + offset per crop (the fairest)",
}


@dataclass
class Row:
    """A line of the table: a renderer and how its crops are matched to the measured ones."""

    name: str
    renderer: Renderer
    how: str | None = None


@dataclass
class Scores:
    """Per row (M) and crop (N); errors in I/F or in shares of the full DN range.

    squared_error : (M, N) sums over valid pixels; ssim (crop range), ssim_range_1, lpips : (M, N)
    pixels, data_range : (N,)
    """

    names: list[str]
    squared_error: np.ndarray
    ssim: np.ndarray
    ssim_range_1: np.ndarray
    lpips: np.ndarray
    pixels: np.ndarray
    data_range: np.ndarray

    @property
    def mse(self) -> np.ndarray:
        """(M, N); NaN for crops without a valid pixel."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.squared_error / self.pixels

    @property
    def psnr_crop_range(self) -> np.ndarray:
        """(M, N), dB, with the range of each measured crop."""
        return np.asarray(psnr(self.mse, np.where(self.data_range > 0, self.data_range, np.nan)))


def batches(indices: np.ndarray, size: int) -> Iterator[np.ndarray]:
    for start in range(0, len(indices), size):
        yield indices[start : start + size]


def choose_fit_pairs(reader: Reader, wanted: np.ndarray, limit: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Train pairs to fit on, and pairs of ``wanted`` in frames that no train pair shows. Sorted indices.

    At most ``limit`` of each (0: all), drawn in proportion to the frames' pairs.
    """
    split, frame = np.asarray(reader.split), np.asarray(reader.frame)
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


def fit_renderers(
    reader: Reader,
    predictor: Predictor,
    extensions: Sequence[Extension],
    train: np.ndarray,
    orphans: np.ndarray,
    frames: int,
    calibrated: bool,
    scale: float,
    size: int,
    seed: int,
    tick: Callable[[int], None],
    only: Sequence[str] = (),
) -> list[Row]:
    """The rows of the table (or those in ``only``), with everything that is free fitted on ``train``.

    Frames without train pairs get their gain and offset from ``orphans``, which no shared coefficient sees.
    """
    model = predictor.model
    start = np.array([p.default for p in model.parameters])
    renderers = make_renderers(predictor, extensions, start)
    network, extended, everywhere, everywhere_extended, baseline, raw = renderers.values()
    wanted = [row for row in layout(bool(extensions)) if not only or row[0] in only]
    needed = {source for _, source, _ in wanted}
    fixed = [r for r in ([baseline] if calibrated else [network, baseline, raw, extended]) if r.name in needed]
    fit_global = not needed.isdisjoint({"global", "global_extended"})

    grams = {r.name: (fit.FrameGram(1, frames), fit.FrameGram(1, frames)) for r in fixed}
    if fit_global and model.linear:
        grams["global"] = (fit.FrameGram(len(start), frames), fit.FrameGram(len(start), frames))
    samples: list[fit.PixelSample] = []
    rng = np.random.default_rng(seed)
    per_crop = max(1, SAMPLE_PIXELS // max(1, len(train)))
    for part, indices in enumerate((train, orphans) if fixed or fit_global else ()):
        for chosen in batches(indices, size):
            batch = read_batch(reader, chosen, scale)
            for renderer in fixed:
                features = renderer.radiance_factor(batch)[:, None]
                grams[renderer.name][part].add(features, batch.image, batch.usable, batch.frame)
            if fit_global and model.linear:
                grams["global"][part].add(unit_images(model, batch), batch.image, batch.usable, batch.frame)
            elif fit_global and part == 0:
                samples.append(sample_pixels(batch, per_crop, rng))
            tick(len(chosen))

    solved = start
    if fit_global and model.linear:
        known = grams["global"][0].gram
        solved = fit.solve_coefficients(known) if calibrated else fit.solve_uncalibrated(known, start)
    elif fit_global:
        solved = fit.fit_nonlinear(model, _join(samples), frames, calibrated)
    everywhere.coefficients = everywhere_extended.coefficients = Constant(solved)
    late = []
    if "global_extended" in needed:
        late.append(everywhere_extended)
    if calibrated and baseline in fixed:
        baseline.scale = float(fit.solve_coefficients(grams["lunar_lambert"][0].gram)[0])
    elif not calibrated:
        for renderer in fixed:
            _calibrate(renderer, grams[renderer.name], np.ones(1))
        if fit_global and model.linear:
            _calibrate(everywhere, grams["global"], solved)
        elif fit_global:
            late.append(everywhere)
        again = {r.name: (fit.FrameGram(1, frames), fit.FrameGram(1, frames)) for r in late}
        for part, indices in enumerate((train, orphans) if late else ()):
            for chosen in batches(indices, size):
                batch = read_batch(reader, chosen, scale)
                for renderer in late:
                    features = renderer.radiance_factor(batch)[:, None]
                    again[renderer.name][part].add(features, batch.image, batch.usable, batch.frame)
        for renderer in late:
            _calibrate(renderer, again[renderer.name], np.ones(1))

    return [Row(name, renderers[source], how) for name, source, how in wanted]


def dn_scale(reader: Reader, indices: np.ndarray, size: int) -> float:
    """Full DN range of the images from their largest valid value."""
    largest = 0.0
    indices = np.unique(indices)
    for start in range(0, len(indices), size):
        chosen = indices[start : start + size]
        valid = torch.as_tensor(reader.valid(chosen)).bool()
        if valid.any():
            largest = max(largest, float(torch.as_tensor(reader.image(chosen))[valid].max()))
    return full_scale(largest)


def make_renderers(
    predictor: Predictor, extensions: Sequence[Extension], coefficients: np.ndarray
) -> dict[str, Renderer]:
    """Everything that is compared, before anything is fitted; ``coefficients`` of the models that are the same everywhere."""
    from_network, everywhere = learned(predictor), Constant(coefficients)
    hapke, lunar_lambert = published("hapke"), published("lunar_lambert")
    made = (
        Renderer("learned", predictor.model, from_network),
        Renderer("learned_extended", predictor.model, from_network, tuple(extensions)),
        Renderer("global", predictor.model, everywhere),
        Renderer("global_extended", predictor.model, everywhere, tuple(extensions)),
        Renderer("lunar_lambert", lunar_lambert[0], Constant(lunar_lambert[1])),
        Renderer("hapke", hapke[0], Constant(hapke[1])),
    )
    return {renderer.name: renderer for renderer in made}


def layout(extended: bool) -> list[tuple[str, str, str | None]]:
    """The rows of the table: (name, renderer, matching per crop)."""
    more: list[tuple[str, str, str | None]] = [
        ("learned_extended", "learned_extended", None),
        ("learned_extended_gain_offset", "learned_extended", "gain_offset"),
        ("global_extended", "global_extended", None),
    ]
    return [
        ("learned", "learned", None),
        ("learned_gain_offset", "learned", "gain_offset"),
        *(more if extended else []),
        ("global", "global", None),
        ("lunar_lambert", "lunar_lambert", None),
        ("hapke_raw", "hapke", None),
        ("hapke_minmax", "hapke", "minmax"),
        ("hapke_gain", "hapke", "gain"),
        ("hapke_gain_offset", "hapke", "gain_offset"),
    ]


def _calibrate(renderer: Renderer, grams: tuple[fit.FrameGram, fit.FrameGram], coefficients: np.ndarray) -> None:
    known, own = grams
    use_own = (known.pixels == 0)[:, None, None]
    renderer.gain, renderer.offset = fit.solve_gain_offset(np.where(use_own, own.gram, known.gram), coefficients)


def sample_pixels(batch: Batch, per_crop: int, rng: np.random.Generator) -> fit.PixelSample:
    """Up to ``per_crop`` usable pixels of every crop."""
    state = batch.state
    visibility = torch.ones_like(batch.image) if state.sun_visibility is None else state.sun_visibility
    width = batch.image[0].numel()
    chosen = []
    for b, usable in enumerate(batch.usable):
        places = np.flatnonzero(usable.reshape(-1).numpy())
        picked = rng.choice(places, size=min(per_crop, len(places)), replace=False)
        chosen.append(b * width + np.sort(picked))
    index = torch.from_numpy(np.concatenate(chosen).astype(np.int64))
    shape = batch.image.shape

    def take(field: torch.Tensor) -> torch.Tensor:
        return field.expand(shape).reshape(-1)[index]

    angles = state.angles
    frame = torch.as_tensor(batch.frame.astype(np.int64))[:, None, None]
    return fit.PixelSample(
        take(angles.cos_incidence),
        take(angles.cos_emission),
        take(angles.cos_phase),
        take(visibility),
        take(batch.image),
        take(frame),
    )


def _join(samples: list[fit.PixelSample]) -> fit.PixelSample:
    names = fit.PixelSample.__dataclass_fields__
    return fit.PixelSample(**{n: torch.cat([getattr(s, n) for s in samples]) for n in names})


def score(
    reader: Reader,
    rows: list[Row],
    indices: np.ndarray,
    scale: float,
    size: int,
    perceptual: Perceptual,
    keep: Callable[[int, np.ndarray, list[np.ndarray]], Any] | None,
    tick: Callable[[int], None],
) -> Scores:
    """Score every row on the crops ``indices``, batch by batch.

    keep : called with (position, measured (B, H, W), rendered of every row), NaN where not usable
    """
    m, n = len(rows), len(indices)
    scores = Scores(
        names=[r.name for r in rows],
        squared_error=np.full((m, n), np.nan),
        ssim=np.full((m, n), np.nan),
        ssim_range_1=np.full((m, n), np.nan),
        lpips=np.full((m, n), np.nan),
        pixels=np.zeros(n, np.int64),
        data_range=np.zeros(n),
    )
    done = 0
    for chosen in batches(indices, size):
        batch = read_batch(reader, chosen, scale)
        where = slice(done, done + len(chosen))
        usable, measured = batch.usable.numpy(), batch.image.numpy()
        scores.pixels[where] = usable.sum(axis=(1, 2))
        ranges = crop_range(batch.image, batch.usable).numpy()
        scores.data_range[where] = ranges
        images = []
        for k, row in enumerate(rows):
            rendered = row.renderer.image(batch, row.how).numpy()
            images.append(rendered)
            scores.squared_error[k, where] = squared_error(measured, rendered, usable)
            for b in range(len(chosen)):
                crop = (measured[b], rendered[b], usable[b])
                scores.ssim[k, done + b] = ssim(*crop, data_range=ranges[b])
                scores.ssim_range_1[k, done + b] = ssim(*crop, data_range=1.0)
                if perceptual.available:
                    scores.lpips[k, done + b] = perceptual.distance(*crop)
        if keep is not None:
            keep(done, np.where(usable, measured, np.nan), [np.where(usable, image, np.nan) for image in images])
        done += len(chosen)
        tick(len(chosen))
    return scores
