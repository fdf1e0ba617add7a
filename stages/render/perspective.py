"""Views of a terrain through a camera: rays, light and reflectance of every pixel, band by band of image lines."""

from __future__ import annotations

import dataclasses
import math
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from rasterio.transform import Affine

from schemas.errors import GeometryError
from stages.common.arrays import Floats, Floats32
from stages.physics.cameras.base import Camera
from stages.physics.cameras.distortion import NONE
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.formation.chain import Observation, State
from stages.physics.formation.geometry import Angles
from stages.physics.maps.grid import CSM_CENTRE, Grid
from stages.physics.maps.window import Window
from stages.physics.photometry import masked_radiance_factor
from stages.physics.terrain.further_light import Horizon
from stages.physics.terrain.shading import (
    BACKPLANES,
    HALO_PX,
    Light,
    form_window,
    further_radiance,
    image_deviation,
)
from stages.physics.terrain.sun_visibility import visible_share
from stages.physics.terrain.surface import Surface
from stages.render.ray_points import HitAngles, hit_angles, sample_maps
from stages.render.raycast import HIT, MISS, HeightField, Hits, build_height_field, cast
from stages.render.viewpoint import pixel_footprint

MOST_SAMPLES = 8  # rays per pixel and axis; beyond, the terrain itself is averaged first
RAYS_AT_ONCE = 1 << 17  # arrays of them stay in a processor's cache
BLOCK_PX = 512  # of further light at once
LATTICE = 33  # rays per axis of the first look
LARGEST_GROUND = 1 << 25  # pixels of a surface that are kept for later views, for each of MOST_GROUNDS resolutions
MOST_GROUNDS = 3


@dataclass(frozen=True)
class Ground:
    """A window of a surface at the resolution that an image's pixels need: all that depends on no Sun and no camera.

    factor : pixels of the surface along one of ``grid``; maps : (C, h, w) coefficients or (C, 1, 1)
    horizons : towards each Sun, (h, w), rad; kept as long as the Sun's own horizon is
    """

    window: Window
    factor: int
    grid: Grid
    field: HeightField
    maps: Floats32
    horizons: WeakKeyDictionary[Horizon, Floats32] = dataclasses.field(default_factory=WeakKeyDictionary)

    def horizon(self, towards: Horizon | None) -> Floats32 | None:
        """(h, w), rad; None where nothing casts shadows."""
        if towards is not None and towards not in self.horizons:
            self.horizons[towards] = self.coarse(towards.window(*self.window))
        return None if towards is None else self.horizons[towards]

    def coarse(self, values: Floats32) -> Floats32:
        """(..., h, w) on ``grid`` from values on the window's own pixels."""
        return values if self.factor == 1 else coarsen(values, self.factor)


class Grounds:
    """The grounds of a surface that views have seen, one for each resolution, grown to hold all of them up to LARGEST_GROUND pixels."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._kept: OrderedDict[int, Ground] = OrderedDict()

    def over(self, window: Window, factor: int) -> Ground:
        """A ground that holds ``window``, at blocks of ``factor`` x ``factor`` pixels. Raises GeometryError."""
        kept = self._kept.pop(factor, None)
        if kept is None or kept.window.union(window) != kept.window:
            whole = window if kept is None else kept.window.union(window)
            kept = make_ground(self._surface, whole if whole.height * whole.width <= LARGEST_GROUND else window, factor)
        self._kept[factor] = kept
        while len(self._kept) > MOST_GROUNDS:
            self._kept.popitem(last=False)
        return kept


def make_ground(surface: Surface, window: Window, factor: int) -> Ground:
    """Read a window and prepare it for rays. Raises GeometryError."""
    elevation, maps = surface.elevation[window.part], surface.read_coefficients(*window)
    grid = surface.grid.window(*window)
    if factor > 1:
        elevation = coarsen(elevation, factor)
        maps = coarsen(maps, factor) if maps.shape[1] > 1 else maps
        transform = grid.transform @ Affine.scale(factor)
        grid = Grid(grid.crs_wkt, transform, elevation.shape[0], elevation.shape[1], grid.radius)
    return Ground(window, factor, grid, build_height_field(elevation, grid), maps)


@dataclass(frozen=True)
class Scene:
    """What a camera sees of a surface in some light.

    horizon : (h, w), rad, or None
    lit : (2, h, w) I/F where extensions have shaded the ground beforehand, and where it was clipped at 0; or None
    added : (h, w) I/F that the Earth and the terrain around add, or None
    samples : rays per pixel and axis; distance : from the camera to the ground, m
    pixels_per_post : image pixels along one pixel of the map, at that distance
    deviation : (h, w) I/F, standard deviation of photographs about the ground's I/F, or None where it is not asked for
    """

    ground: Ground
    horizon: Floats32 | None
    lit: Floats32 | None
    added: Floats32 | None
    samples: int
    distance: float
    pixels_per_post: float
    deviation: Floats32 | None = None


def seen_window(
    surface: Surface, camera: Camera, relief: tuple[float, float], samples: int | None
) -> tuple[Window, int, int, float]:
    """Which window of the map a camera can see, rays per pixel and axis, coarsening factor, distance to the ground (m).

    samples : rays per pixel and axis, None for as many as the pixel's footprint asks for; relief : lowest and highest elevation, m. Raises GeometryError where the view misses the map or starts under it.
    """
    grid = surface.grid
    line = np.linspace(0, camera.lines, LATTICE)
    sample = np.linspace(0, camera.samples, LATTICE)
    lines, columns = (v.ravel() for v in np.meshgrid(line, sample, indexing="ij"))
    origins, directions = camera.rays(lines, columns)
    _check_above_ground(surface, origins, relief)
    near, far = shell_crossing(origins, directions, grid.radius + relief[0] - 1.0, grid.radius + relief[1] + 1.0)
    steps = np.linspace(0.0, 1.0, 9)
    distances = near[:, None] + (far - near)[:, None] * steps
    points = origins[:, None] + distances[..., None] * directions[:, None]
    known = np.isfinite(distances)
    if not known.any():
        raise GeometryError(
            "the camera does not see the body; check its place, `look_at` (or `quaternion`) and `fov_deg`."
        )
    points, distances = points[known], distances[known]
    lon = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    lat = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    row, col = grid.rowcol_of_lonlat(lon, lat)
    inside = np.isfinite(row) & np.isfinite(col)
    if not inside.any():
        raise GeometryError(_misses(surface))
    row, col, distances = row[inside], col[inside], distances[inside]
    # beyond the map by more than its own size is no place that a neighbouring ray leads back from
    row, col = np.clip(row, -grid.height, 2 * grid.height), np.clip(col, -grid.width, 2 * grid.width)
    pad_row, pad_col = (4 + np.ptp(places) * 1.5 / (LATTICE - 1) for places in (row, col))
    top, bottom = max(0, int(row.min() - pad_row)), min(grid.height, int(row.max() + pad_row) + 2)
    left, right = max(0, int(col.min() - pad_col)), min(grid.width, int(col.max() + pad_col) + 2)
    if bottom - top < 2 or right - left < 2:
        raise GeometryError(_misses(surface))
    on_map = (row > -0.5) & (row < grid.height) & (col > -0.5) & (col < grid.width)
    distance = float(np.median(distances[on_map] if on_map.any() else distances))
    footprint = pixel_footprint(camera, distance) / grid.gsd
    wanted = samples or min(MOST_SAMPLES, max(2, math.ceil(footprint)))
    factor = max(1, int(footprint / wanted))
    return Window(top, left, bottom - top, right - left), wanted, factor, distance


def shell_crossing(origins: Floats, directions: Floats, inner: float, outer: float) -> tuple[Floats, Floats]:
    """Distances along rays at which they enter and leave the shell between two spheres; NaN where they miss it.

    origins, directions : (n, 3), m and unit; inner, outer : radii, m; returns (n,) each, m
    """
    along = (origins * directions).sum(-1)
    closest2 = (origins * origins).sum(-1) - along**2
    with np.errstate(invalid="ignore"):
        half_outer = np.sqrt(outer**2 - closest2)
        half_inner = np.sqrt(inner**2 - closest2)
    near = np.maximum(-along - half_outer, 0.0)
    far = -along + half_outer
    enters = -along - half_inner
    far = np.where(enters > 0, enters, far)
    missed = ~(far > near)
    return np.where(missed, np.nan, near), np.where(missed, np.nan, far)


def no_ground(surface: Surface) -> str:
    """The error line of a view whose rays all miss valid ground."""
    return (
        f"the view misses {surface.path.name}: no pixel sees valid ground; "
        "check the camera's place, `look_at` (or `quaternion`) and `fov_deg`."
    )


def _misses(surface: Surface) -> str:
    grid = surface.grid
    lon, lat = grid.lonlat((grid.height - 1) / 2, (grid.width - 1) / 2)
    return (
        f"the view misses {surface.path.name}, whose middle is at longitude {float(lon):.4f}, latitude {float(lat):.4f} deg; "
        "check the camera's place, `look_at` (or `quaternion`) and `fov_deg`."
    )


def _check_above_ground(surface: Surface, origins: Floats, relief: tuple[float, float]) -> None:
    """Refuse a camera inside the ground. Raises GeometryError."""
    grid = surface.grid
    for origin in (origins[0], origins[-1]):
        altitude = float(np.linalg.norm(origin)) - grid.radius
        if altitude > relief[1]:
            continue
        lon = math.degrees(math.atan2(origin[1], origin[0]))
        lat = math.degrees(math.asin(origin[2] / np.linalg.norm(origin)))
        row, col = (float(v) for v in grid.rowcol_of_lonlat(lon, lat))
        ground = relief[0]
        if 0 <= row <= grid.height - 1 and 0 <= col <= grid.width - 1:
            r, c = min(int(row), grid.height - 2), min(int(col), grid.width - 2)
            corner = surface.elevation[r : r + 2, c : c + 2]
            if np.isfinite(corner).all():
                u, v = col - c, row - r
                ground = float(np.array([1 - v, v]) @ corner @ np.array([1 - u, u]))
        if altitude <= ground:
            raise GeometryError(
                f"the camera is under the ground: it stands {altitude:.1f} m above the sphere, the ground there at {ground:.1f} m; raise the altitude in `position`."
            )


def make_scene(
    surface: Surface,
    camera: Camera,
    light: Light,
    relief: tuple[float, float],
    samples: int | None,
    errors: bool = False,
    grounds: Grounds | None = None,
) -> Scene:
    """Read and prepare what a camera sees, with its standard deviations if ``errors``. Raises GeometryError.

    relief : lowest and highest elevation, m; samples : see :func:`seen_window`; grounds : of earlier views
    """
    window, samples, factor, distance = seen_window(surface, camera, relief, samples)
    finer = surface.grid.gsd / pixel_footprint(camera, distance)
    window = window.widened(factor, surface.elevation.shape)
    if errors or light.extensions or light.earthshine is not None or light.bounce is not None:
        grounds = None  # light that depends on the camera's place is worth computing for what it sees only
    ground = (grounds or Grounds(surface)).over(window, factor)
    around = window.padded(HALO_PX, surface.elevation.shape) if light.extensions else window
    lit, added = None, _added(surface, light, around)
    if light.extensions:
        # the sensor comes last: its effects act on the camera's image, not on the ground
        before = replace(light, extensions=[e for e in light.extensions if e.slot != "sensor"])
        lit, added = np.stack(form_window(surface, before, window, added)), None
    deviation = _blocks(window, lambda b: _deviation(surface, light, b, lit, window)) if errors else None
    # errors of neighbours are alike: the deviation of a mean is the mean of theirs
    lit, added, deviation = (None if v is None else ground.coarse(v) for v in (lit, added, deviation))
    return Scene(ground, ground.horizon(light.horizon), lit, added, samples, distance, finer, deviation)


def _added(surface: Surface, light: Light, window: Window) -> Floats32 | None:
    """(h, w) I/F that further light adds; None without such light."""
    if light.earthshine is None and light.bounce is None:
        return None
    return _blocks(window, lambda block: further_radiance(surface, light, block)[0])


def _deviation(surface: Surface, light: Light, block: Window, lit: Floats32 | None, window: Window) -> Floats32:
    """(h, w) I/F of a block of the window, standard deviation; lit : of the window, as in ``Scene``."""
    return image_deviation(surface, light, block, None if lit is None else lit[0][block.within(window).part])


def _blocks(window: Window, field: Callable[[Window], Floats32 | None]) -> Floats32:
    """(h, w) of the window, a field drawn block by block."""
    result = np.empty((window.height, window.width), np.float32)
    for r in range(0, window.height, BLOCK_PX):
        for c in range(0, window.width, BLOCK_PX):
            height, width = min(BLOCK_PX, window.height - r), min(BLOCK_PX, window.width - c)
            block = Window(window.row + r, window.col + c, height, width)
            result[block.within(window).part] = field(block)
    return result


def coarsen(values: Floats32, factor: int) -> Floats32:
    """Means of whole factor x factor blocks, over what is known (NaN where nothing is).

    values : (..., H, W); returns (..., H // factor, W // factor)
    """
    height, width = (n // factor for n in values.shape[-2:])
    blocks = values[..., : height * factor, : width * factor].reshape(*values.shape[:-2], height, factor, width, factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=(-3, -1))
    total = np.where(known, blocks, 0).sum(axis=(-3, -1), dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (total / count).astype(np.float32)


def render_view(surface: Surface, camera: Camera, light: Light, scene: Scene) -> Iterator[dict[str, Floats32]]:
    """Bands of image lines from the top down: ``image`` (I/F, mean over each pixel) and backplanes at pixel centres.

    NaN where the map is unknown; space is 0. Backplanes are NaN where there is no ground. ``image_std`` is among them where
    the scene has standard deviations: errors of the ground within a pixel are taken to be alike.
    """
    lines_at_once = max(1, RAYS_AT_ONCE // (camera.samples * scene.samples**2))
    for first in range(0, camera.lines, lines_at_once):
        count = min(lines_at_once, camera.lines - first)
        centre = _trace(camera, scene, first, count, 1)
        light_there = _light_at(light, scene, centre)
        band = dict(zip(BACKPLANES, _backplanes(centre, *light_there), strict=True))
        if scene.deviation is not None:
            band["image_std"] = sample_maps(scene.deviation[None], centre.hits)[0]
        fine = centre
        if scene.samples > 1:
            fine = _trace(camera, scene, first, count, scene.samples)
            if scene.lit is None:
                light_there = _light_at(light, scene, fine)
        radiance, clipped = _radiance(surface, scene, fine, light_there)
        band["image"] = _mean(radiance, count, camera.samples, scene.samples)
        band["clipped"] = (_mean(clipped, count, camera.samples, scene.samples) > 0).astype(np.float32)
        yield {k: v.reshape(count, camera.samples) for k, v in band.items()}


@dataclass(frozen=True)
class _Rays:
    """origins : (N, 3) or (1, 3), m; directions : (N, 3); hits : (N,)"""

    origins: Floats
    directions: Floats
    hits: Hits


def _trace(camera: Camera, scene: Scene, first: int, count: int, samples: int) -> _Rays:
    """Rays of ``count`` lines, ``samples`` x ``samples`` evenly spread over each pixel, in order of image position."""
    offset = (np.arange(samples) + 0.5) / samples + (CSM_CENTRE - 0.5)
    lines = (first + np.arange(count)[:, None] + offset).ravel()
    columns = (np.arange(camera.samples)[:, None] + offset).ravel()
    line, sample = np.meshgrid(lines, columns, indexing="ij")
    origins, directions = _rays(camera, line.ravel(), sample.ravel())
    return _Rays(origins, directions, cast(scene.ground.field, origins, directions))


def _rays(camera: Camera, line: Floats, sample: Floats) -> tuple[Floats, Floats]:
    """Like ``camera.rays``, with one origin where all rays leave one point."""
    if (
        isinstance(camera, Pinhole) and camera.distortion[0] == NONE
    ):  # by far the most common, and drawing rays should not take longer than casting them
        directions = np.empty((len(line), 3))
        _pinhole_rays(camera.focal_px, camera.principal_point_px, camera.rotation, line, sample, directions)
        return camera.centre[None], directions
    return camera.rays(line, sample)


@numba.njit(cache=True, parallel=True)
def _pinhole_rays(focal, point, rotation, line, sample, directions):
    for n in numba.prange(len(line)):
        x, y = (sample[n] - point[0]) / focal[0], (line[n] - point[1]) / focal[1]
        inverse = 1.0 / math.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            directions[n, k] = (rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2]) * inverse


def _light_at(light: Light, scene: Scene, rays: _Rays) -> tuple[HitAngles, Floats32]:
    """Angles and visible share of the Sun at the hits, (N,)."""
    angles = hit_angles(scene.ground.field, rays.origins, rays.directions, rays.hits, light.sun.position)
    if scene.horizon is None:
        return angles, np.ones(len(rays.directions), np.float32)
    horizon = sample_maps(scene.horizon[None], rays.hits)[0]
    return angles, visible_share(angles.sun_elevation, horizon, light.sun.radius)


def _radiance(
    surface: Surface, scene: Scene, rays: _Rays, light_there: tuple[HitAngles, Floats32]
) -> tuple[Floats32, Floats32]:
    """(N,) I/F along rays: NaN where unknown, 0 in space; and (N,) above 0 where the model's I/F was clipped at 0.

    light_there : of the rays' hits, as :func:`_light_at` gives it; of no use where extensions have lit the ground
    """
    if scene.lit is not None:
        image, clipped = sample_maps(scene.lit, rays.hits)
    else:
        found, visible = light_there
        cosines = (torch.from_numpy(found.cos_incidence), torch.from_numpy(found.cos_emission))
        phase = torch.from_numpy(found.phase)
        angles = Angles(*cosines, phase.cos(), phase_given=phase)
        if scene.ground.maps.shape[1] > 1:
            coefficients = sample_maps(scene.ground.maps, rays.hits)
        else:
            coefficients = np.ascontiguousarray(scene.ground.maps[:, :, 0])
        parameters = surface.model.unpack(torch.from_numpy(coefficients), dim=0)
        image = masked_radiance_factor(surface.model, parameters, angles).numpy()
        clipped = (image < 0).astype(np.float32)
        image = np.maximum(image, 0) * visible
        if scene.added is not None:
            image += sample_maps(scene.added[None], rays.hits)[0]
        image[(rays.hits.status != HIT) | ~np.isfinite(coefficients).all(axis=0)] = np.nan
    image[_in_space(scene, rays)] = 0.0
    return image, np.where(np.isfinite(image), clipped, 0)


def _in_space(scene: Scene, rays: _Rays) -> NDArray[np.bool_]:
    """Rays that pass above everything there could be on the way."""
    missed = rays.hits.status == MISS
    if not missed.any():
        return missed
    single = len(rays.origins) == 1
    origins = rays.origins if single else rays.origins[missed]
    along = (origins * rays.directions[missed]).sum(-1)
    closest2 = (origins * origins).sum(-1) - along**2
    missed[missed] = (closest2 > (scene.ground.grid.radius + scene.ground.field.lowest) ** 2) | (along > 0)
    return missed


def _mean(values: Floats32, lines: int, width: int, samples: int) -> Floats32:
    """(lines width samples^2,) of rays -> pixel means over the known ones; NaN where fewer than half are known."""
    if samples == 1:
        return values
    cells = values.reshape(lines, samples, width, samples)
    known = np.isfinite(cells)
    if known.all():
        return cells.mean(axis=(1, 3), dtype=np.float32)
    count = known.sum(axis=(1, 3))
    total = np.where(known, cells, 0).sum(axis=(1, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(2 * count >= samples**2, total / count, np.nan).astype(np.float32)


def _backplanes(rays: _Rays, angles: HitAngles, visible: Floats32) -> Floats32:
    """(planes, N) in the order of BACKPLANES."""
    out = np.empty((len(BACKPLANES), len(visible)), np.float32)
    _fill_backplanes(
        rays.origins, rays.directions, rays.hits.depth, angles.cos_incidence, angles.cos_emission, angles.phase,
        visible, out,
    )  # fmt: skip
    return out


@numba.njit(cache=True, parallel=True)
def _fill_backplanes(origins, directions, depth, cos_incidence, cos_emission, phase, visible, out):
    stride = 0 if origins.shape[0] == 1 else 1
    degree = 180.0 / math.pi
    for n in numba.prange(len(depth)):
        if depth[n] != depth[n]:
            out[:, n] = np.nan
            continue
        x = origins[n * stride, 0] + depth[n] * directions[n, 0]
        y = origins[n * stride, 1] + depth[n] * directions[n, 1]
        z = origins[n * stride, 2] + depth[n] * directions[n, 2]
        out[0, n] = math.acos(min(max(cos_incidence[n], -1.0), 1.0)) * degree
        out[1, n] = math.acos(min(max(cos_emission[n], -1.0), 1.0)) * degree
        out[2, n] = phase[n] * degree
        out[3, n] = 1.0 - visible[n] if cos_incidence[n] > 0 else 1.0
        if cos_incidence[n] != cos_incidence[n]:
            out[0, n], out[3, n] = np.nan, np.nan
        if cos_emission[n] != cos_emission[n]:
            out[1, n] = np.nan
        out[4, n] = depth[n]
        out[5, n] = math.atan2(y, x) * degree
        out[6, n] = math.atan2(z, math.hypot(x, y)) * degree


def apply_sensor(image: Floats32, light: Light, grid: Grid) -> Floats32:
    """The sensor's own effects of an extended model, on the whole image of a camera (H, W)."""
    sensor = [e for e in light.extensions if e.slot == "sensor"]
    if not sensor:
        return image
    known = np.isfinite(image)
    tensor = torch.from_numpy(np.nan_to_num(image))[None]
    line, sample = (torch.from_numpy(v.astype(np.float32))[None] for v in np.indices(image.shape))
    zero = torch.zeros_like(tensor)
    observation = Observation(
        zero, torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3), grid.gsd, grid.radius,
        detector_sample=sample, detector_line=line, frame=torch.full((1,), -1),
    )  # fmt: skip
    state = State(observation, zero, observation.sun_direction, observation.camera_position, None)
    state.image = tensor
    with torch.no_grad():
        for effect in sensor:
            effect.apply(state)
    return np.where(known, state.image[0].numpy(), np.nan).astype(np.float32)
