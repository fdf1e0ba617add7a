"""A case: what is dealt to it, the world around that, a strength worth judging, and the file with what is true of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .exposure import Departure, expose
from .faults import FAULTS
from .fields import Array, log_uniform
from .files import write_pairs
from .layout import Needs
from .plant import ABSOLUTE, FID, GAINS, Plant, clean_images
from .planted import PLANTED
from .resampling import BILINEAR, CUBIC
from .scene import Scene, draw_scene
from .strength import Strength, strength

HAND = 44  # cases dealt at a time
NULLS, EFFECTS, WITH_FAULT = 14, 22, 8
LAYOUT_NAMES = "abcd"
LIT_DEG = 2.0  # how far the Sun stands above the horizon of a lit pixel
TUNING = 4  # steps of the calibration
MOST_PAIRS = 16  # that it uses


@dataclass(frozen=True)
class Deal:
    """What a case hides: an effect, a fault or neither."""

    layout: str
    effect: str | None = None
    fault: str | None = None
    given_law: bool = False  # the ground follows the law that `diagnose` is given


def deal(seed: int, count: int) -> list[Deal]:
    """Shuffled hands of 44: 14 nulls, 22 effects, 8 faults, each group spread over the layouts."""
    dealt: list[Deal] = []
    while len(dealt) < count:
        dealt += _hand(np.random.default_rng([seed, 7 + len(dealt) // HAND]))
    return dealt[:count]


def _hand(rng: np.random.Generator) -> list[Deal]:
    effects = [list(PLANTED)[i] for i in rng.permutation(len(PLANTED))[:EFFECTS]]
    faults = [list(FAULTS)[i] for i in rng.permutation(len(FAULTS))[:WITH_FAULT]]
    hidden = [[{}] * NULLS, [{"effect": effect} for effect in effects], [{"fault": fault} for fault in faults]]
    hand = []
    for group in hidden:
        layouts = rng.permutation(list(LAYOUT_NAMES * 6)[: len(group)])
        hand += [Deal(str(layout), **what) for what, layout in zip(group, layouts, strict=True)]
    return [hand[i] for i in rng.permutation(len(hand))]


def make_case(number: int, dealt: Deal, seed: int, path: Path) -> dict:
    """Write pairs.h5 to `path`; what is true of it, as JSON holds it."""
    rng = np.random.default_rng([seed, 1000 + number])
    kind = _kind(dealt)
    scene = draw_scene(rng, dealt.layout, _needs(rng, kind), dealt.given_law)
    pairs = list(range(len(scene.pairs)))
    suns = scene.geometry.sun
    horizons = scene.horizons(scene.dem, suns)
    clean = clean_images(scene)
    above = np.degrees(np.arcsin(suns[:, 2]))[:, None, None] - horizons
    lit = (above > LIT_DEG) & (clean.images > 0.1 * clean.images.mean((1, 2), keepdims=True))
    truth: dict = {
        "planted": {},
        "law": scene.law.name,
        "layout": dealt.layout,
        "world": scene.story,
        "fid": 0.0,
        "unknown": bool(dealt.fault),
    }
    dem, images, samples, lines = scene.dem, clean.images + clean.noise, clean.samples, clean.lines
    if kind is None:
        size = strength(scene, pairs, clean.images, clean.images, clean.noise, lit)
    else:
        plant = kind(scene, clean, rng)
        x, target = _calibrated(plant, rng, lit)
        size = _strength(plant, pairs, x, lit)
        truth |= {
            "fid": size.fid,
            "fid_global_factor_only": size.fid_global_factor_only,
            "fid_abs_all_pixels": size.fid_abs_all_pixels,
            "fid_without_ground_mean": size.fid_without_ground_mean,
            "rms_of_pair_gains": size.rms_of_pair_gains,
            "target": target,
            "calibrated_on": "none, drawn" if plant.low == plant.high else plant.measure,
        }
        truth |= {"planted": {dealt.effect: plant.parameters(x)}} if dealt.effect else {"fault": {dealt.fault: x}}
        if plant.of_inputs:
            suns = plant.given_sun(x)
            worse = plant.given_dem(x)
            if worse is not None:
                dem = worse
                images, samples, lines = _projected_with(scene, dem)
            horizons = scene.horizons(dem, suns)
        else:
            images = np.array([plant.image(pair, x, noise=True) for pair in pairs])
    truth |= _record(scene, size) | {"lit_share": float(lit.mean()), "mean_if": float(images.mean())}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_pairs(path, scene, images, dem, horizons, suns, samples, lines)
    return truth | {"seed": seed, "case": number}


def _kind(dealt: Deal) -> type[Plant] | None:
    if dealt.effect:
        return PLANTED[dealt.effect]
    return FAULTS[dealt.fault] if dealt.fault else None


def _needs(rng: np.random.Generator, kind: type[Plant] | None) -> Needs:
    needs = (kind or Plant).needs
    needs = replace(needs, steep=needs.steep or rng.random() < 0.3)
    if needs.oblique_share is not None:
        needs = replace(needs, oblique=bool(rng.random() < needs.oblique_share))
    return needs


def _strength(plant: Plant, pairs: list[int], x: float, lit: Array) -> Strength:
    clean = plant.clean
    without = clean.images + clean.noise if plant.needs_noise else clean.images
    changed = np.array([plant.image(pair, x, noise=plant.needs_noise) for pair in pairs])
    return strength(plant.scene, pairs, without[pairs], changed, clean.noise[pairs], lit[pairs])


def _calibrated(plant: Plant, rng: np.random.Generator, lit: Array) -> tuple[float, float]:
    """Strength x at which the plant's measure comes near a drawn target, from weak to plain; and that target."""
    target = log_uniform(rng, 0.08, 0.4) if rng.random() < 0.75 else log_uniform(rng, 0.4, 1.5)
    if plant.measure == GAINS:
        target = log_uniform(rng, 0.01, 0.08)
    some = _some_pairs(plant.scene)
    x = plant.start
    for _ in range(TUNING):
        size = _strength(plant, some, x, lit)
        found = {FID: size.fid, ABSOLUTE: size.fid_abs_all_pixels, GAINS: size.rms_of_pair_gains}[plant.measure]
        if found <= 0:
            new = min(x * 3, plant.high)
        else:
            new = min(max(x * (target / found) ** 0.9, plant.low), plant.high)
        if abs(math.log(new / x)) < 0.06 or plant.low == plant.high:
            break
        x = new
    return float(f"{x:.4g}"), target


def _some_pairs(scene: Scene) -> list[int]:
    """Of one or two sites; where sites share no image, of the first eight."""
    if not scene.sites.layout.shared:
        return list(range(8))
    some = [pair for pair, (site, _) in enumerate(scene.pairs) if site < 2]
    if len(some) > MOST_PAIRS:
        some = [pair for pair, (site, _) in enumerate(scene.pairs) if site == 0]
    return some


def _projected_with(scene: Scene, dem: Array) -> tuple[Array, Array, Array]:
    """Images, samples and lines of all pairs, orthorectified with a DEM (grid, grid)."""
    found = []
    for pair, (site, _) in enumerate(scene.pairs):
        departure = Departure(projection_height=scene.sites.crop(dem, site))
        found.append(expose(scene, pair, scene.plain(pair), departure))
    images, samples, lines = zip(*found, strict=True)
    return np.array(images), np.array(samples), np.array(lines)


def _record(scene: Scene, size: Strength) -> dict:
    """What a reader of the results may want to know of the world."""
    camera, sky, errors = scene.camera, scene.sky, scene.errors
    return {
        "relative_pixel_noise": size.relative_noise,
        "snr": camera.snr,
        "dem": {
            "sigma_px": errors.smoothing,
            "slope_noise_deg": errors.noise_deg,
            "corr_px": errors.noise_length,
            "seam_gsd": errors.seam,
        },
        "sensor": {
            "psf": camera.psf_kind,
            "fwhm_det_px": camera.psf_fwhm,
            "pitch_gsd": [float(pitch) for pitch in camera.pitch / scene.ground.gsd],
            "linescan": camera.line_scan,
            "resample": {BILINEAR: "bilinear", CUBIC: "cubic"}[camera.resampling],
            "gain_rms": camera.gain_rms,
            "flat_rms": camera.flat_rms,
            "broad_rms": camera.broad_rms,
            "reg_rms_px": camera.registration_rms,
        },
        "sun_el": [round(float(value), 2) for value in sky.elevation],
        "sun_az": [round(float(value), 2) for value in sky.azimuth],
        "em": [round(float(value), 1) for value in sky.emission],
        "view_az": [round(float(value), 1) for value in sky.view_azimuth],
        "images": scene.sites.images,
    }
