"""A hidden scene: several sites, several images of each, and everything that may be hidden in them."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numba
import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from hidden.departures import FORMS, factor
from hidden.faults import FAULTS
from hidden.laws import LAWS, roughness
from hidden.layers import SUN_RADIUS_DEG, Ground
from hidden.sensor import Detector, Pose, shoot
from hidden.terrain import make_terrain, measured_relief, patches, red_noise, units

RADIUS = 1737400.0
SHARED = Path(os.environ.get("LUNARGR_SHARED", Path(__file__).parents[4] / "shared"))
DISTANCE = 400.0  # crop sizes: the traced camera is at infinity


@dataclass(frozen=True)
class Layout:
    """Size and geometry of a scene; the defaults are a small one for tests."""

    seed: int = 1
    sites: int = 3
    images: int = 10
    size: int = 64
    margin: int = 24  # px of known DEM around a crop
    sub: int = 3  # fine cells per DEM px
    gsd: float = 5.0
    slope_deg: float = 9.0
    sun_elevations: tuple[float, float] = (8.0, 65.0)
    emissions: tuple[float, float] = (0.0, 35.0)
    opposition: int = 2  # images with phase below 10 deg
    border: int = 8
    per_site: int = 0  # images of a site, in turn; 0 for all of them
    rotation_deg: float = 4.0  # of detectors against the map, at most
    relief: str = ""  # a DEM under LUNARGR_SHARED's data/, whose shape the ground takes


@dataclass
class Truth:
    """What the world is like beyond the nominal model; the defaults are a world with nothing hidden."""

    effect: dict[str, Any] = field(default_factory=dict)  # effect id -> its parameters, as planted
    texture: float = 0.03  # rms of the albedo texture
    texture_power: float = 2.6
    texture_kind: str = "red"  # or "patches", "units"
    dem_noise_deg: float = 0.6  # rms slope of the DEM's noise
    dem_noise_px: float = 1.5  # sigma of its correlation
    dem_smoothing: float = 0.3  # sigma, px
    seam: float = 0.15  # step along a line, m
    misregistration: float = 0.3  # px, rms length
    dem_samples: bool = False  # heights at the pixels' centres, not means over their areas
    snr: float = 70.0
    veil: float = 0.0  # broad correlated noise of each image, rms, relative to its mean
    veil_px: float = 12.0  # sigma of its correlation
    drift: float = 0.0  # rms by which reflectance, and its phase curve, vary smoothly over a site
    law: str = "linear"  # of reflectance
    units: str = "iof"


def _unit(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])


class Scene:
    """Traced once; planting an effect reuses the layers that it does not change."""

    def __init__(self, layout: Layout, cache: Path | None = None) -> None:
        self.layout = layout
        self.cache = cache
        key = hashlib.sha1(json.dumps(layout.__dict__, sort_keys=True).encode()).hexdigest()[:12]
        self.key = f"scene-{key}"
        rng = np.random.default_rng(layout.seed)
        self.heights = [self._terrain(rng) for _ in range(layout.sites)]
        self.suns, self.views = self._geometry(rng)
        self._grounds: dict[int, Ground] = {}
        self._layers: dict[tuple, Any] = {}
        self._exact: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def _terrain(self, rng: np.random.Generator) -> np.ndarray:
        lay = self.layout
        size, cell = (lay.size + 2 * lay.margin) * lay.sub + 1, lay.gsd / lay.sub
        if lay.relief:
            return measured_relief(rng, SHARED / "data" / lay.relief, size, cell, lay.slope_deg)
        return make_terrain(rng, size, cell, lay.slope_deg)

    def _geometry(self, rng):
        lay = self.layout
        count = lay.images
        elevation = np.linspace(*lay.sun_elevations, count) + rng.uniform(-2, 2, count)
        azimuth = (np.arange(count) * 137.5 + rng.uniform(0, 360) + rng.uniform(-15, 15, count)) % 360
        suns = [_unit(a, e) for a, e in zip(azimuth, elevation, strict=True)]
        views = [_unit(rng.uniform(0, 360), 90 - rng.uniform(*lay.emissions)) for _ in range(count)]
        high = np.argsort(elevation)[::-1]
        for k in high[: lay.opposition]:
            views[k] = _unit(azimuth[k] + rng.uniform(-5, 5), elevation[k] + rng.uniform(2, 9))
        return suns, views

    def ground(self, site: int) -> Ground:
        if site not in self._grounds:
            lay = self.layout
            first = (lay.margin - lay.border) * lay.sub
            count = (lay.size + 2 * lay.border) * lay.sub
            self._grounds[site] = Ground(self.heights[site], lay.gsd / lay.sub, first, count, 1000 * lay.seed + site)
        return self._grounds[site]

    def layer(self, kind: str, site: int, image: int, *extra):
        """A traced layer, from memory, from disk or from Mitsuba."""
        key = (kind, site, image, *extra)
        if key in self._layers:
            return self._layers[key]
        name = hashlib.sha1(repr(key).encode()).hexdigest()[:16]
        path = None if self.cache is None else self.cache / self.key / f"{name}.npy"
        if path is not None and path.exists():
            data = np.load(path).astype(np.float32)
        else:
            ground, sun, seed = self.ground(site), self.suns[image], 7919 * site + 31 * image + self.layout.seed
            if kind == "direct":
                radius, ridge = extra if extra else (SUN_RADIUS_DEG, None)
                data = np.stack(ground.direct(sun, seed, radius, ridge))
            elif kind == "bounced":
                data = np.stack(ground.bounced(sun, seed))
            elif kind == "facing":
                data = ground.facing(np.array(extra))
            else:
                data = (ground.normal @ self.views[image]).reshape(ground.count, ground.count)
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                partial = path.with_suffix(f".{os.getpid()}.npy")  # several processes may trace at once
                np.save(partial, data.astype(np.float16))
                partial.rename(path)
        self._layers[key] = data
        return data

    def given_dem(self, site: int, truth: Truth, rng) -> np.ndarray:
        """The DEM that the simulation gets: area mean of the truth, smoothed, with noise and a seam."""
        lay = self.layout
        n = lay.size + 2 * lay.margin
        corner = self.heights[site]
        centres = (corner[:-1, :-1] + corner[1:, :-1] + corner[:-1, 1:] + corner[1:, 1:]) / 4
        dem = centres.reshape(n, lay.sub, n, lay.sub)
        dem = dem[:, lay.sub // 2, :, lay.sub // 2] if truth.dem_samples else dem.mean((1, 3))
        variance = truth.dem_smoothing**2 + truth.effect.get("dem_smoothing", {}).get("sigma2_px2", 0.0)
        dem = gaussian_filter(dem, np.sqrt(variance), mode="nearest")
        dem = dem / (1 + truth.effect.get("dem_scale", {}).get("relative", 0.0))
        noise = gaussian_filter(rng.normal(size=dem.shape), truth.dem_noise_px)
        gy, gx = np.gradient(noise, lay.gsd)
        slope = np.sqrt((gx**2 + gy**2).mean())
        dem = dem + noise * np.tan(np.radians(truth.dem_noise_deg)) / slope
        row = rng.integers(n // 3, 2 * n // 3)
        dem[row:] += truth.seam
        return dem

    def _albedo(self, site: int, truth: Truth) -> np.ndarray:
        """Relative albedo on the fine grid: texture, and what was planted to follow the terrain."""
        lay, effect = self.layout, truth.effect
        rng = np.random.default_rng((lay.seed, site, 77))
        count = (lay.size + 2 * lay.border) * lay.sub
        albedo = 1 + truth.texture * self._texture(rng, count, truth)
        if truth.drift:
            albedo = albedo * (1 + truth.drift * red_noise(rng, count, 4.0, count / 4))
        names = [n for n in ("slope_albedo", "elevation_albedo", "curvature_albedo") if n in effect]
        if names:
            fields = [self._terrain_fields(s) for s in range(lay.sites)]
            for name in names:
                every = np.stack([f[name] for f in fields])
                albedo = albedo * (1 + effect[name]["per_std"] * (fields[site][name] - every.mean()) / every.std())
        if "albedo_map" in effect:
            y, x = np.mgrid[0:count, 0:count] / count
            angle, phase = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
            rays = np.cos(2 * np.pi * 1.4 * (x * np.cos(angle) + y * np.sin(angle)) + phase)
            rays = rays + 0.5 * gaussian_filter(rng.normal(size=rays.shape), count / 8) * count / 2
            albedo = albedo * (1 + effect["albedo_map"]["per_std"] * (rays - rays.mean()) / rays.std())
        return albedo

    def _texture(self, rng: np.random.Generator, count: int, truth: Truth) -> np.ndarray:
        if truth.texture_kind == "patches":
            return patches(rng, count, 8.0 * self.layout.sub)
        return units(rng, count) if truth.texture_kind == "units" else red_noise(rng, count, truth.texture_power)

    def _terrain_fields(self, site: int) -> dict[str, np.ndarray]:
        lay = self.layout
        first = (lay.margin - lay.border) * lay.sub
        count = (lay.size + 2 * lay.border) * lay.sub
        centres = (self.heights[site][:-1, :-1] + self.heights[site][1:, 1:]) / 2
        smooth = uniform_filter(centres, lay.sub)
        cell = lay.gsd / lay.sub
        gy, gx = np.gradient(smooth, cell)
        broad = gaussian_filter(centres, 2 * lay.sub)
        by, bx = np.gradient(broad, cell)
        bend = np.gradient(by, cell)[0] + np.gradient(bx, cell)[1]
        cut = slice(first, first + count)
        return {
            "slope_albedo": uniform_filter(np.hypot(gx, gy), lay.sub)[cut, cut],
            "elevation_albedo": smooth[cut, cut],
            "curvature_albedo": bend[cut, cut],
        }

    def radiance(self, site: int, image: int, truth: Truth) -> np.ndarray:
        """I/F on the fine ground."""
        effect = truth.effect
        radius = effect.get("penumbra", {}).get("radius_deg", SUN_RADIUS_DEG)
        ridge = effect.get("distant_shadow")
        if ridge is None and radius == SUN_RADIUS_DEG:
            mu0, share = self.layer("direct", site, image)
        else:
            # the ridge's height is above the mean of the known ground
            wall = ridge and (ridge["side"], ridge["distance_m"], ridge["height_m"] + float(self.heights[site].mean()))
            mu0, share = self.layer("direct", site, image, radius, wall)
        mu = np.maximum(self.layer("view", site, image), 1e-3)
        sun, view = self.suns[image], self.views[image]
        cosg = float(np.clip(sun @ view, -1, 1))
        lit = mu0 > 0
        mu0 = np.maximum(mu0, 1e-4)
        albedo = self._albedo(site, truth)
        surface = self._extended(LAWS[truth.law](mu0, mu, cosg, albedo), mu0, mu, cosg, sun, effect)
        if truth.drift:  # ages differ over a site, and with them the phase curve
            waves = np.random.default_rng((self.layout.seed, site, 78))
            bend = red_noise(waves, len(mu0), 4.0, len(mu0) / 4)
            surface = surface * np.exp(-0.5 * truth.drift * bend * (np.arccos(cosg) - 0.8))
        total = surface * share * lit
        if "interreflection" in effect:
            normal = float(LAWS[truth.law](np.ones(1), np.ones(1), 1.0, np.ones(1))[0])
            rho = normal * effect["interreflection"].get("strength", 1.0)
            for k, light in enumerate(self.layer("bounced", site, image)):
                total = total + albedo * rho * normal ** (k + 1) * light / 1.0
        if "earthshine" in effect:
            e = effect["earthshine"]
            direction = _unit(e["azimuth_deg"], e["elevation_deg"])
            total = total + e["irradiance"] * self.layer("facing", site, 0, *direction.round(6).tolist())
        return total

    @staticmethod
    def _extended(base, mu0, mu, cosg, sun, effect):
        for name in FORMS:
            if name in effect:
                base = base * factor(name, effect[name], mu0, mu, cosg, sun)
        if "macroscopic_roughness" in effect:
            base = base * roughness(mu0, mu, cosg, effect["macroscopic_roughness"]["theta_bar_deg"])
        return base

    def make(self, truth: Truth, seed: int, *, split: bool = True) -> dict[str, Any]:
        """All variables of pairs.h5, with the truth beside them."""
        lay, effect = self.layout, truth.effect
        rng = np.random.default_rng((seed, 5))
        noise_rng = np.random.default_rng((seed, 6))  # the same noise with and without the effect
        dems = [self.given_dem(s, truth, rng) for s in range(lay.sites)]
        inner = slice(lay.margin, lay.margin + lay.size)
        out: dict[str, list] = {
            k: []
            for k in (
                "elevation",
                "image",
                "sun_horizon_deg",
                "detector_sample",
                "detector_line",
                "sun_direction_enu",
                "camera_position_enu",
                "image_index",
                "site",
                "split",
            )
        }
        frames = [self._frame(rng, truth) for _ in range(lay.images)]
        for site in range(lay.sites):
            for image in self.images_of(site):
                pose, camera = frames[image]
                pose = replace(pose, error=tuple(np.array(pose.error)))
                fine = self.radiance(site, image, truth)
                measured, sample, line = shoot(noise_rng, fine, lay.sub, lay.border, lay.size, pose, camera)
                sun = self._given_sun(image, effect)
                azimuth = float(np.arctan2(sun[0], sun[1]))
                out["sun_horizon_deg"].append(np.degrees(given_horizon(dems[site], lay.gsd, azimuth))[inner, inner])
                out["elevation"].append(dems[site][inner, inner])
                out["image"].append(measured)
                out["detector_sample"].append(sample)
                out["detector_line"].append(line)
                out["sun_direction_enu"].append(sun)
                out["camera_position_enu"].append(self.views[image] * DISTANCE * lay.size * lay.gsd)
                out["image_index"].append(image)
                out["site"].append(site)
                out["split"].append(2 if split and site >= lay.sites - max(1, lay.sites // 6) else 0)
        data = {k: np.array(v) for k, v in out.items()}
        data["valid"] = np.ones(data["image"].shape, np.uint8)
        if truth.units == "dn":
            scale = rng.uniform(500, 2000, lay.images)[data["image_index"]]
            shift = rng.uniform(-5, 20, lay.images)[data["image_index"]]
            data["image"] = data["image"] * scale[:, None, None] + shift[:, None, None]
        return data

    def images_of(self, site: int) -> list[int]:
        lay = self.layout
        count = lay.per_site or lay.images
        return sorted((site * count + k) % lay.images for k in range(count))

    def lit_samples(self, site: int, truth: Truth, step: int = 7) -> list[tuple]:
        """Per image of a site (mu0, mu, cosg, sun, I/F) of every ``step``-th lit point each way."""
        out = []
        for image in self.images_of(site):
            mu0, share = self.layer("direct", site, image)
            mu = np.maximum(self.layer("view", site, image), 1e-3)
            cosg = float(np.clip(self.suns[image] @ self.views[image], -1, 1))
            use = np.zeros(mu0.shape, bool)
            use[::step, ::step] = True
            use &= (mu0 > 0.05) & (share > 0.99)
            base = LAWS[truth.law](mu0[use], mu[use], cosg, 1.0)
            out.append((mu0[use].astype(float), mu[use].astype(float), cosg, self.suns[image], base))
        return out

    def _given_sun(self, image: int, effect: dict) -> np.ndarray:
        """The metadata's Sun: truth minus the planted error."""
        sun = self.suns[image]
        azimuth, elevation = np.degrees(np.arctan2(sun[0], sun[1])), np.degrees(np.arcsin(sun[2]))
        azimuth -= effect.get("sun_azimuth", {}).get("error_deg", 0.0)
        elevation -= effect.get("sun_elevation", {}).get("error_deg", 0.0)
        return _unit(azimuth, elevation)

    def _frame(self, rng, truth: Truth) -> tuple[Pose, Detector]:
        effect = truth.effect
        size = truth.misregistration / np.sqrt(2)
        shift, extra = rng.normal(size=2), rng.normal(size=2)
        gain, wave = rng.normal(), rng.normal(size=(2, 3))
        size = np.hypot(size, effect.get("misregistration", {}).get("rms_px", 0.0) / np.sqrt(2))
        pose = Pose(
            rotation_deg=float(rng.uniform(-1, 1)) * self.layout.rotation_deg,
            offset=tuple(rng.uniform(-0.5, 0.5, 2)),
            error=tuple(shift * size),
            first=(float(rng.uniform(0, 5000)), 2500.0 + float(np.clip(extra[0], -2, 2)) * self.layout.size / 2),
        )
        camera = Detector(snr=truth.snr, veil=truth.veil, veil_px=truth.veil_px)
        if "image_gain" in effect:
            camera.gain = 1 + effect["image_gain"]["rms"] * gain
        camera.bias = effect.get("dark_bias", {}).get("iof", 0.0)
        if "nonlinearity" in effect:
            camera.gamma = effect["nonlinearity"].get("log", 0.0)
            camera.quadratic = effect["nonlinearity"].get("quadratic", 0.0)
        camera.blur_sigma = float(np.sqrt(effect.get("psf_blur", {}).get("sigma2_px2", 0.0)))
        if "echo" in effect:
            e = effect["echo"]
            camera.smear = (e["fraction"], int(e["lag_px"]), int(e.get("axis", 0)))
        if "column_pattern" in effect:
            uneven = effect["column_pattern"]["rms"]
            half = 1.5 * self.layout.size  # the ground falls on other columns in every image

            def response(sample):
                u = np.clip((sample - 2500.0) / half, -1, 1)
                shape = 0.9 * u**2 + 0.5 * np.sin(2.3 * u)
                inside = np.linspace(-1, 1, 200)
                known = 0.9 * inside**2 + 0.5 * np.sin(2.3 * inside)
                return 1 - uneven * (shape - known.mean()) / known.std()

            camera.response = response
        camera.level = effect.get("saturation", {}).get("iof", np.inf)
        if "line_jitter" in effect:
            rms = effect["line_jitter"]["rms_px"]
            norm = np.sqrt((wave**2).sum())

            def warp(u):  # slow drifts over the crop's lines, -0.5 .. 0.5
                basis = np.sqrt(2) * np.stack([np.cos(np.pi * k * (np.clip(u, -0.5, 0.5) + 0.5)) for k in (1, 2, 3)])
                return rms * wave[0] @ basis / norm, rms * wave[1] @ basis / norm

            camera.warp = warp
        camera.faults = {name: values for name, values in effect.items() if name in FAULTS}
        if "ghost" in effect:
            cy, cx = rng.uniform(-0.3, 0.3, 2) * self.layout.size
            width, share = self.layout.size / 6, effect["ghost"]["share"]
            first = pose.first

            def ghost(sample, line):
                r2 = (sample - first[1] - cx) ** 2 + (line - first[0] - cy) ** 2
                return share * np.exp(-r2 / (2 * width**2))

            camera.ghost = ghost
        return pose, camera


@numba.njit(cache=True)
def _march(dem, gsd, right, down):
    rows, columns = dem.shape
    out = np.empty((rows, columns))
    for r in range(rows):
        for c in range(columns):
            best, k = -1e9, 1
            while True:
                y, x = r + down * k * 0.5, c + right * k * 0.5
                if y < 0 or x < 0 or y > rows - 1 or x > columns - 1:
                    break
                i, j = min(int(y), rows - 2), min(int(x), columns - 2)
                v, u = y - i, x - j
                top = dem[i, j] * (1 - u) + dem[i, j + 1] * u
                low = dem[i + 1, j] * (1 - u) + dem[i + 1, j + 1] * u
                if k > 1:  # half a pixel away lies the pixel's own slope
                    best = max(best, (top * (1 - v) + low * v - dem[r, c]) / (k * 0.5 * gsd))
                k += 1
            out[r, c] = np.arctan(best) if best > -1e8 else -np.pi / 2
    return out


def given_horizon(dem: np.ndarray, gsd: float, azimuth: float) -> np.ndarray:
    """Horizon of the given DEM, rad, marched in half pixels with bilinear heights."""
    return _march(dem, gsd, float(np.sin(azimuth)), float(-np.cos(azimuth)))


def write_pairs(
    path: Path, data: dict[str, Any], layout: Layout, *, units: str = "iof", without: tuple[str, ...] = ()
) -> Path:
    """pairs.h5 as a foreign program would write it: only what the schema asks for."""
    count = len(data["image"])
    frames = int(data["image_index"].max()) + 1
    with h5py.File(path, "w") as file:
        for name in ("elevation", "image", "sun_horizon_deg", "detector_sample", "detector_line"):
            if name not in without:
                file.create_dataset(name, data=data[name].astype(np.float32), chunks=(1, *data[name].shape[1:]))
        file["valid"] = data["valid"].astype(np.uint8)
        for name in ("sun_direction_enu", "camera_position_enu"):
            file[name] = data[name].astype(float)
        for name in ("image_index", "site"):
            file[name] = data[name].astype(np.int32)
        file["split"] = data["split"].astype(np.uint8)
        file["tile"] = data["site"].astype(np.int32)
        file["longitude_deg"] = np.zeros(count)
        file["latitude_deg"] = np.zeros(count)
        file.create_dataset("image_id", data=[f"image-{k:03d}" for k in range(frames)], dtype=h5py.string_dtype())
        file["image"].attrs["units"] = "1" if units == "iof" else "dn"
        file.attrs["gsd_m"] = layout.gsd
        file.attrs["body_radius_m"] = RADIUS
    return path


__all__ = ["Layout", "Scene", "Truth", "write_pairs"]
