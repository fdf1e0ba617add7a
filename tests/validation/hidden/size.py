"""How much a planted effect changes what a simulation of the given data leaves, by a plain simulation of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

CLEAR_DEG = 2.0  # from the horizon: pixels nearer to a shadow say more of the DEM than of anything else


def strength(planted: dict[str, Any], twin: dict[str, Any], gsd: float) -> tuple[float, float | None]:
    """(fid, possible gain) of data with an effect against the same world, noise included, without it.

    fid : rms of the difference between what both leave after a smooth law and the ground's static texture, over the rms
        of what the twin leaves from one pixel to the next (its noise)
    possible gain : percent of the mean squared error on the test split that undoing the effect wins; None without such
    """
    first, second = _residuals(planted, gsd), _residuals(twin, gsd)
    learn = planted["split"] != 2
    total, count, noise, steps = 0.0, 0, 0.0, 0
    for site in np.unique(planted["site"][learn]):
        members = np.flatnonzero((planted["site"] == site) & learn)
        use = (first.lit[members] & second.lit[members]).astype(float)
        level = np.maximum(second.level[members], 1e-4)
        difference = (first.left[members] - second.left[members]) / level * use
        if len(members) > 1:  # a static pattern of the ground is no effect
            difference = (difference - difference.sum(0) / np.maximum(use.sum(0), 1)) * use
        total += float((difference**2).sum())
        count += int(use.sum())
        # neighbours differ by noise: texture, veil and relief are broader than a pixel
        rough = np.diff(second.left[members] / level, 2, axis=-1) * use[..., 2:] * use[..., 1:-1] * use[..., :-2]
        noise += float((rough**2).sum()) / 6
        steps += int((rough != 0).sum())
    fid = float(np.sqrt(total / max(count, 1) / (noise / max(steps, 1))))
    if learn.all():
        return fid, None
    errors = [float((r.left[~learn] ** 2)[r.lit[~learn]].mean()) for r in (first, second)]
    return fid, 100 * (1 - errors[1] / errors[0])


class _residuals:
    """left, level : measured minus simulated, and simulated, (pairs, H, W); lit : where both are judged."""

    def __init__(self, data: dict[str, Any], gsd: float) -> None:
        height = data["elevation"].astype(float)
        south, east = np.gradient(height, gsd, axis=(-2, -1))
        normal = np.stack([-east, south, np.ones_like(height)], -1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        sun = data["sun_direction_enu"]
        view = data["camera_position_enu"] / np.linalg.norm(data["camera_position_enu"], axis=-1, keepdims=True)
        mu0, mu = (np.einsum("phwk,pk->phw", normal, d) for d in (sun, view))
        cosg = (sun * view).sum(-1)[:, None, None] + 0 * mu0
        elevation = np.degrees(np.arcsin(sun[:, 2]))[:, None, None]
        self.lit = (mu0 > 0.05) & (mu > 0.05) & (elevation > data["sun_horizon_deg"] + CLEAR_DEG)
        self.lit &= data["valid"].astype(bool)
        mu0, mu = np.maximum(mu0, 1e-3), np.maximum(mu, 1e-3)
        lommel = mu0 / (mu0 + mu)
        columns = np.stack([mu0, cosg, np.ones_like(mu0), lommel, lommel * cosg, lommel * cosg**2, mu0 * cosg], -1)
        image = data["image"].astype(float)
        level = np.maximum(image.mean((-2, -1), keepdims=True), 1e-6)
        use = self.lit & (data["split"] != 2)[:, None, None]
        rows, target = (columns / level[..., None])[use][::5], (image / level)[use][::5]
        solved = np.linalg.lstsq(rows, target, rcond=None)[0]
        self.level = columns @ solved
        self.left = image - self.level


__all__ = ["strength"]
