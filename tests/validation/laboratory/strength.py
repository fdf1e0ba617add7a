"""How strong a planted effect is, against the noise, once what no diagnosis could see is taken away."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .fields import Array
from .scene import Scene

TURNS = 4  # of plane and ground in turn


@dataclass
class Strength:
    """Ratios of the effect's rms to that of the noise; names as in the record of a case.

    fid: change relative to the clean image over lit pixels, less a plane per pair and the mean of each ground pixel over its
    images; fid_global_factor_only: less one factor instead of the planes; fid_without_ground_mean: less the planes alone;
    fid_abs_all_pixels: over every pixel, in units of the pixel's noise, less a gain per pair. rms_of_pair_gains is a relative
    change of whole images.
    """

    fid: float
    fid_global_factor_only: float
    fid_abs_all_pixels: float
    fid_without_ground_mean: float
    rms_of_pair_gains: float
    relative_noise: float


def strength(scene: Scene, pairs: list[int], clean: Array, changed: Array, noise: Array, lit: Array) -> Strength:
    """Of `changed` against `clean` (pairs, size, size), with the noise of these pairs and their mask of lit pixels."""
    floor = np.maximum(clean, 1e-3 * scene.mean_iof)
    relative = np.where(lit, (changed - clean) / floor, 0)
    relative_noise = math.sqrt(np.mean(np.clip(noise / floor, -1, 1)[lit] ** 2))

    def over_noise(planes: bool, ground: bool) -> float:
        left = _less(relative, lit, scene, pairs, planes, ground)
        return math.sqrt(np.mean(left[lit] ** 2)) / relative_noise

    gains = [change[mask].mean() if mask.any() else 0 for change, mask in zip(relative, lit, strict=True)]
    deviation = scene.noise_deviation(clean)
    absolute = (changed - clean) / deviation
    for change, image, sigma in zip(absolute, clean, deviation, strict=True):
        unit = image / sigma
        change -= unit * (unit * change).sum() / (unit * unit).sum()
    scaled_noise = math.sqrt(np.mean((noise / deviation) ** 2))
    return Strength(
        fid=over_noise(planes=True, ground=True),
        fid_global_factor_only=over_noise(planes=False, ground=True),
        fid_abs_all_pixels=math.sqrt(np.mean(absolute**2)) / scaled_noise,
        fid_without_ground_mean=over_noise(planes=True, ground=False),
        rms_of_pair_gains=float(np.std(gains)),
        relative_noise=relative_noise,
    )


def _less(change: Array, lit: Array, scene: Scene, pairs: list[int], planes: bool, ground: bool) -> Array:
    """Take a plane per pair, or else one mean over all, and the mean of each ground pixel over its images from a change."""
    n = scene.size
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    basis = np.stack([np.ones((n, n)), y, x])
    change = change.copy()
    of_site: dict[int, list[int]] = {}
    for at, pair in enumerate(pairs):
        of_site.setdefault(scene.pairs[pair][0], []).append(at)
    shared = [at for at in of_site.values() if len(at) > 1]
    for _ in range(TURNS if shared else 1):
        if planes:
            for at, mask in enumerate(lit):
                if mask.sum() >= 50:
                    plane = np.linalg.lstsq(basis[:, mask].T, change[at][mask], rcond=None)[0]
                    change[at] -= np.tensordot(plane, basis, 1)
        else:
            change -= change[lit].mean()
        for at in shared if ground else []:
            weight = lit[at].astype(float)
            change[at] -= ((change[at] * weight).sum(0) / np.maximum(weight.sum(0), 1e-9))[None]
    return change
