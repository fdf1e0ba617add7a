"""What a scene's random draws came to: sizes of effects with values per image, as an ideal diagnosis would give them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, laplace

from hidden.departures import equivalents
from hidden.laws import LAWS
from hidden.scene import Scene, Truth


def drawn(scene: Scene, truth: Truth, seed: int) -> dict[str, float]:
    """Effect -> its first parameter in this world, where that is a mean size and not the value itself.

    What all images have in common belongs to the ground (shifts) or to the model (gains): deviations from the mean count.
    """
    rng = np.random.default_rng((seed, 5))
    dems = [scene.given_dem(site, truth, rng) for site in range(scene.layout.sites)]
    frames = [scene._frame(rng, truth) for _ in range(scene.layout.images)]
    out: dict[str, float] = {}
    if "dem_smoothing" in truth.effect:  # what every DEM is smoothed by counts in
        out["dem_smoothing"] = truth.dem_smoothing**2 + truth.effect["dem_smoothing"]["sigma2_px2"]
    if "misregistration" in truth.effect:
        shifts = np.array([pose.error for pose, _ in frames])
        out["misregistration"] = float(np.sqrt(shifts.var(0, ddof=1).sum()))
    if "image_gain" in truth.effect:
        gains = np.array([camera.gain for _, camera in frames])
        out["image_gain"] = float(gains.std(ddof=1) / gains.mean())
    if "column_pattern" in truth.effect:
        half = scene.layout.size / 2
        seen = [camera.response(pose.first[1] + np.linspace(-half, half, 101)) for pose, camera in frames]
        first, last = (f(pose.first[1] for pose, _ in frames) for f in (min, max))
        columns = frames[0][1].response(np.arange(first - half, last + half))
        out["column_pattern"] = float(columns.std() / np.mean(seen))
    out |= _on_the_dem(scene, truth, dems)
    if (
        "interreflection" in truth.effect
    ):  # planted between facets of normal albedo; 1 is the catalogue's, of RADF at 30, 0, 30
        law, across = LAWS[truth.law], np.cos(np.radians(30))
        normal, oblique = (float(law(np.array([x]), np.ones(1), x, np.ones(1))[0]) / x for x in (1.0, across))
        out["interreflection"] = truth.effect["interreflection"]["strength"] * (normal / oblique) ** 2
    samples = [s for site in range(scene.layout.sites) for s in scene.lit_samples(site, truth)]
    return out | equivalents(truth.effect, samples)


def _on_the_dem(scene: Scene, truth: Truth, dems: list[np.ndarray]) -> dict[str, float]:
    """What albedo that follows the fine ground is per standard deviation of the same quantity of the given DEM, by least squares."""
    lay = scene.layout
    inner = slice(lay.margin, lay.margin + lay.size)
    border = slice(lay.border, lay.border + lay.size)

    def given(name: str, dem: np.ndarray) -> np.ndarray:
        if name == "elevation_albedo":
            return dem[inner, inner]
        south, east = np.gradient(dem, lay.gsd)
        if name == "slope_albedo":
            return np.hypot(south, east)[inner, inner]
        return laplace(gaussian_filter(dem, 2.0))[inner, inner]

    out = {}
    for name in ("slope_albedo", "elevation_albedo", "curvature_albedo"):
        if name in truth.effect:
            fine = np.stack([scene._terrain_fields(s)[name] for s in range(lay.sites)])
            count = lay.size + 2 * lay.border
            mean = fine.reshape(len(fine), count, lay.sub, count, lay.sub).mean((2, 4))[:, border, border]
            planted = truth.effect[name]["per_std"] * (mean - fine.mean()) / fine.std()
            seen = np.stack([given(name, d) for d in dems])
            seen = (seen - seen.mean()) / seen.std()
            out[name] = float((planted * seen).sum() / (seen * seen).sum())
    return out
