"""Stereo pairs with truth for learned matching: two cameras and two Suns over the same ground, and every correspondence.

The ground is cut into square tiles, each wholly in one split; a pair looks at the middle of its tile's inner part, so
that no ground seen in training is seen in the test.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.errors import ConfigError, GeometryError
from stages.common.arrays import Floats, Floats32
from stages.common.progress import Progress, show_nothing
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.terrain.surface import Surface
from stages.render.config import SUN, Config, StereoConfig, check, check_rig
from stages.render.dataset import World, make_world, project, ray_directions, write_text
from stages.render.files import MANIFEST, SIDES, pair_files, pair_names, view_files
from stages.render.pictures import read_exr, write_exr
from stages.render.renderer import Renderer
from stages.render.viewpoint import look_at, pinhole_view
from stages.render.views import render_camera

SPLITS = (("train", 0.8), ("validation", 0.1), ("test", 0.1))
TILE_FOOTPRINTS = 2.0  # edge of a tile in footprints seen from straight above
ROOM = 1.5  # the part of a tile that a view may cover, in footprints: oblique views reach further
SAME_PLACE = 1e-3  # of the distance: a farther surface there hides the point
TRIES = 200


def render_stereo(source: Path, folder: Path, config: Config, stereo: StereoConfig, progress: Progress) -> Path:
    """See :func:`stages.render.run_stereo`."""
    _check(config, stereo)
    manifest = folder / MANIFEST
    names = pair_names(stereo.count)
    view_config = replace(config, view="pinhole", position=(0.0, 0.0, 0.0), rig=None)
    check(view_config, drawn_sun=True)
    rng = np.random.default_rng(stereo.seed)
    pairs: list[dict[str, Any]] = []
    with Renderer(source, config=config) as renderer:
        world = make_world(renderer.surface.grid)
        places = _Places(renderer.surface, config, stereo, rng)
        for number, name in enumerate(names):
            progress(number, stereo.count, "pairs")
            pairs.append(_render_pair(name, renderer, places, config.rig, view_config, world, folder))
        document = {
            "source": source.name,
            "pixel_centre": 0.5,
            "unit": "m",
            "gsd": places.footprint / config.size_px[0],
            "tile": places.tile,
            "seed": stereo.seed,
            "pairs": pairs,
        }
        write_text(manifest, json.dumps(document, indent=1))
    progress(stereo.count, stereo.count, "pairs")
    return manifest


def _check(config: Config, stereo: StereoConfig) -> None:
    if stereo.count < 1:
        raise ConfigError(f"`stereo`: expected at least 1 pair, found {stereo.count}.")
    check_rig(config)
    low, high = stereo.convergence_deg
    if not 0 < low <= high <= 90:
        raise ConfigError(f"`convergence`: expected LOW,HIGH degrees in 0..90, found {low:g},{high:g}.")
    if stereo.altitude is not None and not stereo.altitude > 0:
        raise ConfigError(f"`altitude`: expected metres above 0, found {stereo.altitude:g}.")
    if any(getattr(config, name) is not None for name in SUN):
        raise ConfigError("`stereo`: expected no Sun; each picture gets one of its own.")


class _Places:
    """Where pairs may look: tiles of ground with their splits, in order of a shuffle."""

    def __init__(self, surface: Surface, config: Config, stereo: StereoConfig, rng: np.random.Generator) -> None:
        grid = surface.grid
        self.surface, self.stereo, self.rng = surface, stereo, rng
        width = 2 * math.tan(math.radians(config.fov_deg) / 2)
        shorter = min(grid.height, grid.width) * grid.gsd
        self.altitude = stereo.altitude if stereo.altitude is not None else shorter / 8 / width
        self.footprint = self.altitude * width * max(1.0, config.size_px[1] / config.size_px[0])
        self.tile = TILE_FOOTPRINTS * self.footprint
        rows, cols = (int(n * grid.gsd / self.tile) for n in (grid.height, grid.width))
        if rows * cols < len(SPLITS):
            raise ConfigError(
                f"`stereo`: expected ground for {len(SPLITS)} tiles of {self.tile:.4g} m, one per split, found {rows} x {cols}; lower `altitude` or `fov_deg`."
            )
        self.corners = [(r, c) for r in range(rows) for c in range(cols)]
        self.splits = _split_tiles(len(self.corners), rng)
        self.drawn = 0

    def next_sun(self) -> dict[str, Any]:
        """Settings of a Sun."""
        azimuth, elevation = self.rng.uniform(0, 360), self.rng.uniform(*self.stereo.sun_elevation_deg)
        return {"sun_azimuth_deg": azimuth, "sun_elevation_deg": elevation}

    def next(self) -> tuple[str, int, Floats]:
        """Split, number of the tile and a place on the ground, (3,) body-fixed, m. Raises GeometryError."""
        grid, px = self.surface.grid, self.tile / self.surface.grid.gsd
        for _ in range(TRIES):
            tile = self.drawn % len(self.corners)
            self.drawn += 1
            slack = (1 - ROOM / TILE_FOOTPRINTS) / 2
            down, across = 0.5 + self.rng.uniform(-slack, slack, 2)
            row, col = (self.corners[tile][0] + down) * px, (self.corners[tile][1] + across) * px
            r, c = min(int(row), grid.height - 1), min(int(col), grid.width - 1)
            height = float(self.surface.elevation[r : r + 1, c : c + 1][0, 0])
            if math.isfinite(height):
                return self.splits[tile], tile, grid.local_frames(r, c).up[0] * (grid.radius + height)
        raise GeometryError(f"{self.surface.path}: expected known ground in its tiles, found none in {TRIES} tries.")


def _split_tiles(count: int, rng: np.random.Generator) -> list[str]:
    """A split per tile: shares as in SPLITS, at least one tile of each."""
    counts = [max(1, round(share * count)) for _, share in SPLITS[1:]]
    names = [name for (name, _), n in zip(SPLITS[1:], counts, strict=True) for _ in range(n)]
    names = ["train"] * (count - len(names)) + names
    return [names[k] for k in rng.permutation(count)]


def _render_pair(
    name: str, renderer: Renderer, places: _Places, rig: float | None, config: Config, world: World, folder: Path
) -> dict[str, Any]:
    """Both pictures, the correspondences, and the pair's entry in the manifest."""
    split, tile, target = places.next()
    convergence, cameras = _draw_cameras(target, places, rig, config)
    suns = [places.next_sun(), places.next_sun()] if rig is None else [places.next_sun()] * 2
    views, exrs = [], []
    for side, camera, sun in zip(SIDES, cameras, suns, strict=True):
        view_config = replace(config, **sun)
        files = view_files(folder, f"{name}_{side}", config)
        render_camera(renderer, camera, files, view_config, f"{name}_{side}", show_nothing)
        views.append({"image": files[0].name, "preview": files[1].name, "camera": camera.to_document(), **sun})
        exrs.append(read_exr(files[0]))
    depths = exrs[0]["depth"], exrs[1]["depth"]
    matches = correspondences(cameras[0], cameras[1], depths, world)
    path = pair_files(folder, name, config)[-1]
    with write_exr(path, depths[0].shape[0], depths[0].shape[1], list(matches)) as writer:
        writer.write(matches)
    ground = np.isfinite(depths[0])
    overlap = float(np.mean(matches["visible"][ground])) if ground.any() else 0.0
    return {
        "pair_id": name,
        "split": split,
        "tile": tile,
        "baseline": float(np.linalg.norm(cameras[0].centre - cameras[1].centre)),
        "convergence_deg": convergence,
        "overlap": overlap,
        "left": views[0],
        "right": views[1],
        "matches": path.name,
    }


def _draw_cameras(target: Floats, places: _Places, rig: float | None, config: Config) -> tuple[float, list[Pinhole]]:
    """The angle between both lines of sight at the ground, deg, and both cameras: converging, or parallel on a rig."""
    stereo, rng = places.stereo, places.rng
    if rig is None:
        convergence = rng.uniform(*stereo.convergence_deg)
    else:
        convergence = 2 * math.degrees(math.atan(rig / 2 / places.altitude))
    cameras = []
    for sight in _lines_of_sight(target, convergence if rig is None else 0.0, stereo.off_nadir_deg, rng):
        position = target + sight * places.altitude
        roll = rng.uniform(-stereo.roll_deg, stereo.roll_deg)
        rotation = look_at(position, target, roll)
        cameras.append(pinhole_view(position, rotation, config.fov_deg, config.size_px, places.surface.grid.radius))
    if rig is not None:
        aside = 0.5 * rig * cameras[0].rotation[:, 0]
        cameras = [replace(cameras[0], centre=cameras[0].centre + way * aside) for way in (-1, 1)]
    return convergence, cameras


def _lines_of_sight(
    target: Floats, convergence_deg: float, off_nadir_deg: float, rng: np.random.Generator
) -> list[Floats]:
    """Two unit vectors from the ground to the cameras, ``convergence_deg`` apart about a mean near the zenith."""
    up = target / np.linalg.norm(target)
    across = np.cross(up, rng.normal(size=3))
    across /= np.linalg.norm(across)
    along = np.cross(up, across)
    tilt = math.radians(rng.uniform(0, off_nadir_deg))  # of the plane of both, so that the angle between them stays
    mean = math.cos(tilt) * up + math.sin(tilt) * along
    half = math.radians(convergence_deg) / 2
    return [math.cos(half) * mean + side * math.sin(half) * across for side in (-1.0, 1.0)]


def correspondences(
    left: Pinhole, right: Pinhole, depths: tuple[Floats32, Floats32], world: World
) -> dict[str, Floats32]:
    """Where the right camera sees the ground of each left pixel: ``sample``, ``line`` (first pixel's centre at 0.5) and
    ``visible`` (1 = inside its picture and not hidden); each (lines, samples) float32, NaN where the left sees no ground.

    depths : left and right, along the rays, m
    """
    rotation, place = world.pose(left)
    points = place + depths[0].ravel()[:, None].astype(float) * (ray_directions(left).reshape(-1, 3) @ rotation.T)
    known = np.isfinite(points).all(axis=1)
    points[~known] = 0.0
    inside, sample, line, distance = project(right, world, points)
    visible = np.zeros(len(points))
    inside &= known
    nearest = depths[1][line[inside].astype(int), sample[inside].astype(int)]
    # the right camera may see farther, past an edge within the pixel, but nothing nearer
    visible[inside] = nearest > distance[inside] * (1 - SAME_PLACE)
    shape = depths[0].shape
    named = {"sample": sample, "line": line, "visible": visible}
    return {k: np.where(known, v, np.nan).reshape(shape).astype(np.float32) for k, v in named.items()}
