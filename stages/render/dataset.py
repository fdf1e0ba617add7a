"""A rendered trajectory as a data set for other programs: COLMAP's text model, nerfstudio's transforms.json.

The world's axes are east, north and up at the middle of the map, in metres from the reference sphere there: positions
in body-fixed metres would leave single-precision programs a tenth of a metre. world.json says how to go back.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.errors import ConfigError, InputError
from schemas.files.companions import companions_of
from schemas.files.locks import claim
from schemas.files.outputs import atomic_path
from stages.common.arrays import Floats, Floats32, Mask
from stages.physics.cameras import Camera
from stages.physics.cameras.distortion import FISHEYE, NONE, RADTAN, distort_arrays, undistort_arrays
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.maps.grid import Grid
from stages.render.motion import Moving
from stages.render.pictures import read_exr, stretch

EXPORT_PASSES = 3  # over all views: for a common white, for the pictures, for the data set's own tables
POINTS_PER_SIDE = 24  # of each view, on which the sparse points are picked
SAME_PLACE = 2e-3  # of the distance: a point that another view sees this near is the same
COLMAP_MODELS = {NONE: ("PINHOLE", 0), RADTAN: ("FULL_OPENCV", 8), FISHEYE: ("OPENCV_FISHEYE", 4)}  # and coefficients
GL_AXES = np.diag([1.0, -1.0, -1.0])  # nerfstudio's cameras look along -z, with y up


@dataclass(frozen=True)
class View:
    """One rendered view. depth in its EXR is the distance along each pixel's ray, m."""

    view_id: str
    camera: Pinhole
    exr: Path


@dataclass(frozen=True)
class World:
    """origin : (3,), body-fixed, m; axes : (3, 3), rows east, north, up in body-fixed coordinates"""

    origin: Floats
    axes: Floats

    def pose(self, camera: Pinhole) -> tuple[Floats, Floats]:
        """(3, 3) camera (right, down, forward) -> world, and (3,) place, m."""
        return self.axes @ camera.rotation, self.axes @ (camera.centre - self.origin)


def make_world(grid: Grid) -> World:
    """Over the middle of a map."""
    axes = grid.local_frames((grid.height - 1) / 2, (grid.width - 1) / 2).axes[0]
    return World(axes[2] * grid.radius, axes)


def export_views(
    views: Sequence[View], grid: Grid, folder: Path, kind: str, report: Callable[[int], None] = lambda done: None
) -> None:
    """Write the data set of ``views`` into ``folder``/colmap or ``folder``/nerfstudio. Raises InputError.

    report : called with the number of views done, each counted EXPORT_PASSES times in the end
    """
    missing = [view.exr.name for view in views if not view.exr.exists()]
    if missing:
        raise InputError(
            f"{folder}: expected every view's EXR, found {missing[0]} missing (of {len(missing)}); render all views first, without `png_only`."
        )
    target, world = folder / kind, make_world(grid)
    told = target / "world.json"
    with claim(told), companions_of(told):
        (target / "images").mkdir(exist_ok=True)
        limit = _white(_counted(views, report, 0))
        for view in _counted(views, report, len(views)):
            _write_image(target / "images" / f"{view.view_id}.png", read_exr(view.exr)["image"], limit)
        write = _write_colmap if kind == "colmap" else _write_nerfstudio
        write(views, world, target, lambda done: report(2 * len(views) + done))
        _write_world(told, world, grid)


def _counted(views: Sequence[View], report: Callable[[int], None], before: int) -> Iterator[View]:
    for number, view in enumerate(views):
        report(before + number)
        yield view


def z_depth(camera: Pinhole, distance: NDArray) -> Floats:
    """Distances along rays -> distances along the optical axis, (lines, samples), NaN where nothing was seen."""
    x, y = _ray_slopes(camera)
    return distance / np.sqrt(1 + x * x + y * y)


def ray_directions(camera: Pinhole) -> Floats:
    """(lines, samples, 3) unit vectors of the pixels' rays in the camera: right, down, forward."""
    x, y = _ray_slopes(camera)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _ray_slopes(camera: Pinhole) -> tuple[Floats, Floats]:
    """Right and down per unit forward of the pixels' rays, (lines, samples) each."""
    sample, line = np.meshgrid(np.arange(camera.samples) + 0.5, np.arange(camera.lines) + 0.5)
    x = (sample - camera.principal_point_px[0]) / camera.focal_px[0]
    y = (line - camera.principal_point_px[1]) / camera.focal_px[1]
    return undistort_arrays(*camera.distortion, x, y)


def _white(views: Iterable[View]) -> float:
    """One white for all views, so that the same ground is as bright in each."""
    sample = [image[np.isfinite(image)][::97] for image in (read_exr(v.exr)["image"] for v in views)]
    values = np.concatenate(sample)
    return max(float(np.percentile(values, 99.5)), 1e-6) if values.size else 1.0


def write_text(path: Path, text: str) -> None:
    """A whole text file, or none."""
    with atomic_path(path) as partial:
        partial.write_text(text)


def _write_image(path: Path, image: Floats32, white: float) -> None:
    """An 8-bit picture with display gamma. image : (H, W) I/F; white : the I/F that is shown white"""
    grey, _ = stretch(image, (0.0, white))
    data = cv2.imencode(".png", cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB))[1].tobytes()
    with atomic_path(path) as partial:
        partial.write_bytes(data)


def _write_world(path: Path, world: World, grid: Grid) -> None:
    write_text(path, json.dumps(_world_document(world, grid), indent=1))


def _world_document(world: World, grid: Grid) -> dict[str, Any]:
    """How the world's axes lie in the body."""
    row, col = (grid.height - 1) / 2, (grid.width - 1) / 2
    lon, lat = (float(v) for v in grid.lonlat(row, col))
    return {
        "origin_mcmf": world.origin.tolist(),
        "axes_mcmf": dict(zip(("east", "north", "up"), world.axes.tolist(), strict=True)),
        "origin": {"longitude_deg": lon, "latitude_deg": lat, "height": 0.0},
        "body_radius": grid.radius,
        "unit": "m",
    }


def write_cameras(
    path: Path, names: Sequence[str], cameras: Sequence[Pinhole], suns: Sequence[Floats], grid: Grid
) -> None:
    """Intrinsics, pose and Sun of every view, in the body's axes and in those of the world. suns : (3,), body-fixed, m"""
    world = make_world(grid)
    views = []
    for name, camera, sun in zip(names, cameras, suns, strict=True):
        rotation, place = world.pose(camera)
        away = sun - camera.centre
        local = {
            "position_enu": place.tolist(),
            "quaternion_camera_to_enu_wxyz": to_quaternion(rotation),
            "sun_direction_enu": (world.axes @ away / np.linalg.norm(away)).tolist(),
        }
        views.append(
            {
                "view_id": name,
                **camera.to_document(),
                **motion_facts(camera),
                "sun_position_mcmf": sun.tolist(),
                **local,
            }
        )
    write_text(path, json.dumps({**_world_document(world, grid), "views": views}, indent=1))


def camera_facts(camera: Camera) -> dict[str, str]:
    """Attributes of an EXR: a pinhole's document and motion; a camera file is named by the settings."""
    facts = {"camera": camera.to_document()} if isinstance(camera, Pinhole) else {}
    return {name: json.dumps(fact) for name, fact in (facts | motion_facts(camera)).items()}


def motion_facts(camera: Camera) -> dict[str, Any]:
    """What moves during the picture: m/s and rad/s, body-fixed, s; nothing of a camera that stands still."""
    if not isinstance(camera, Moving):
        return {}
    numbers = {"velocity_mcmf": camera.velocity.tolist(), "spin_mcmf": camera.spin.tolist()}
    return {"motion": numbers | {"exposure": camera.exposure, "line_time": camera.line_time}}


def _write_nerfstudio(views: Sequence[View], world: World, target: Path, report: Callable[[int], None]) -> None:
    """transforms.json with depth maps as float32 arrays in mm, which nerfstudio's default scale makes metres."""
    (target / "depths").mkdir(exist_ok=True)
    frames: list[dict[str, Any]] = []
    for view in _counted(views, report, 0):
        rotation, place = world.pose(view.camera)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation @ GL_AXES, place
        depth = np.nan_to_num(z_depth(view.camera, read_exr(view.exr)["depth"]) * 1000).astype(np.float32)
        path = target / "depths" / f"{view.view_id}.npy"
        with atomic_path(path) as partial, partial.open("wb") as file:
            np.save(file, depth, allow_pickle=False)
        frames.append(
            {
                "file_path": f"images/{view.view_id}.png",
                "depth_file_path": f"depths/{view.view_id}.npy",
                "transform_matrix": matrix.tolist(),
                **_intrinsics(view.camera),
            }
        )
    fisheye = any(view.camera.distortion[0] == FISHEYE for view in views)
    document = {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "orientation_override": "none",
        "frames": frames,
    }
    write_text(target / "transforms.json", json.dumps(document, indent=1))


def _intrinsics(camera: Pinhole) -> dict[str, float]:
    """Raises ConfigError for distortion that nerfstudio has no words for."""
    given = camera.to_document().get("distortion", {})
    factors = {name: value for name, value in given.items() if name != "model" and value != 0}
    if camera.distortion[0] == RADTAN and {"k4", "k5", "k6"} & set(factors):
        raise ConfigError("`export`: expected distortion up to k3 for nerfstudio, found k4 to k6; export colmap alone.")
    return factors | {
        "fl_x": camera.focal_px[0],
        "fl_y": camera.focal_px[1],
        "cx": camera.principal_point_px[0],
        "cy": camera.principal_point_px[1],
        "w": camera.samples,
        "h": camera.lines,
    }


def _write_colmap(views: Sequence[View], world: World, target: Path, report: Callable[[int], None]) -> None:
    """sparse/0 with cameras.txt, images.txt and points3D.txt: true ground points with all views that see them."""
    folder = target / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    points = list(_tracks(views, world, report))
    seen: list[list[tuple[float, float, int]]] = [[] for _ in views]
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, (place, track) in enumerate(points, start=1):
        entries = []
        for k, sample, line in track:
            entries.append(f"{k + 1} {len(seen[k])}")
            seen[k].append((sample, line, number))
        lines.append(f"{number} {place[0]:.4f} {place[1]:.4f} {place[2]:.4f} 128 128 128 0 {' '.join(entries)}")
    cameras, images = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"], ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    numbers: dict[str, int] = {}  # intrinsics -> camera: views that share a camera name it together
    for k, view in enumerate(views):
        c = view.camera
        code, coefficients = c.distortion
        model, count = COLMAP_MODELS[code]
        intrinsics = (*c.focal_px, *c.principal_point_px, *coefficients[:count])
        told = f"{model} {c.samples} {c.lines} {' '.join(f'{v:.9g}' for v in intrinsics)}"
        if told not in numbers:
            numbers[told] = len(numbers) + 1
            cameras.append(f"{numbers[told]} {told}")
        rotation, place = world.pose(c)
        pose = (*to_quaternion(rotation.T), *(-rotation.T @ place))
        images.append(f"{k + 1} {' '.join(f'{v:.12g}' for v in pose)} {numbers[told]} {view.view_id}.png")
        images.append(" ".join(f"{x:.4f} {y:.4f} {point}" for x, y, point in seen[k]))
    for name, table in (("cameras", cameras), ("images", images), ("points3D", lines)):
        write_text(folder / f"{name}.txt", "\n".join(table) + "\n")


def _tracks(
    views: Sequence[View], world: World, report: Callable[[int], None]
) -> Iterator[tuple[Floats, list[tuple[int, float, float]]]]:
    """Ground points of every view, (3,) in the world's axes, m, with (view, sample, line) of all views that see them."""
    depths = [read_exr(view.exr)["depth"] for view in views]
    for k, view in enumerate(_counted(views, report, 0)):
        points, sample, line = _grid_points(view.camera, depths[k], world)
        tracks = [[(k, s, ln)] for s, ln in zip(sample, line, strict=True)]
        for other, other_view in enumerate(views):
            if other == k:
                continue
            inside, x, y, distance = project(other_view.camera, world, points)
            depth = depths[other][y[inside].astype(int), x[inside].astype(int)]
            same = np.abs(depth - distance[inside]) < SAME_PLACE * distance[inside]
            for n in np.flatnonzero(inside)[same]:
                tracks[n].append((other, float(x[n]), float(y[n])))
        yield from zip(points, tracks, strict=True)


def _grid_points(camera: Pinhole, depth: Floats32, world: World) -> tuple[Floats, Floats, Floats]:
    """(n, 3) ground points of a coarse grid of pixels, in the world's axes, and their samples and lines (n,)."""
    step = max(1, math.ceil(max(camera.lines, camera.samples) / POINTS_PER_SIDE))
    line, sample = (v.ravel() for v in np.mgrid[step // 2 : camera.lines : step, step // 2 : camera.samples : step])
    known = np.isfinite(depth[line, sample])
    line, sample = line[known], sample[known]
    rotation, place = world.pose(camera)
    return (
        place + depth[line, sample, None] * (ray_directions(camera)[line, sample] @ rotation.T),
        sample + 0.5,
        line + 0.5,
    )


def project(camera: Pinhole, world: World, points: Floats) -> tuple[Mask, Floats, Floats, Floats]:
    """Whether each of (n, 3) world points falls on the image, its sample and line, and its distance, m."""
    rotation, place = world.pose(camera)
    local = (points - place) @ rotation
    ahead = local[:, 2] > 0
    z = np.where(ahead, local[:, 2], 1.0)
    x, y = distort_arrays(*camera.distortion, local[:, 0] / z, local[:, 1] / z)
    x = camera.focal_px[0] * x + camera.principal_point_px[0]
    y = camera.focal_px[1] * y + camera.principal_point_px[1]
    inside = ahead & (x >= 0) & (y >= 0) & (x < camera.samples) & (y < camera.lines)
    return inside, x, y, np.linalg.norm(local, axis=1)


def to_quaternion(rotation: Floats) -> tuple[float, float, float, float]:
    """(3, 3) rotation -> w, x, y, z with w >= 0."""
    from scipy.spatial.transform import Rotation  # slow to import, and of no use to a view without a data set

    x, y, z, w = (float(v) for v in Rotation.from_matrix(rotation).as_quat(canonical=True))
    return w, x, y, z
