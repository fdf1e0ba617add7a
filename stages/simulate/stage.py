"""simulate: the ground, then each image, then the truth, all in blocks of rows."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.transform import Affine
from rasterio.windows import Window

from schemas.files.outputs import atomic_folder, atomic_path
from schemas.provenance import SIDECAR, folder_record
from stages.common.progress import Progress
from stages.physics.bodies.ephemeris import AU
from stages.physics.maps.grid import Grid, local_metric_crs, unit_vectors
from stages.simulate import sensor
from stages.simulate.hidden import Hidden
from stages.simulate.orbits import RADIUS, Pass, plan_passes
from stages.simulate.radiance import Scene, View, blur, point_spread, radiance
from stages.simulate.recipe import Config
from stages.simulate.reflectance import MARGIN, Truth, log_albedo
from stages.simulate.terrain import Terrain
from stages.simulate.write import NODATA_FLOAT, ImageFile, ImageTruth, open_geotiff, table_row, write_table, write_truth

GROUND_ROWS = 512  # DEM rows made at once
IN_MEMORY = 6e8  # bytes of truth kept in memory; more is mapped from a temporary file
WINDOW_PIXELS = 12e6  # DEM pixels rendered at once


@dataclass
class Summary:
    """What was made."""

    folder: Path
    images: list[ImageTruth]
    covered: list[float]  # share of the scene that each image covers
    dem_valid: float  # share of the DEM with data
    craters: int
    hidden: Hidden

    def table(self) -> list[dict[str, str]]:
        """A row for each image."""
        rows = []
        for i, share in zip(self.images, self.covered, strict=True):
            shot = i.shot
            rows.append(
                {
                    "image": shot.image_id,
                    "start (UTC)": shot.start_time,
                    "GSD m": f"{shot.gsd:.2f}",
                    "inc deg": f"{shot.incidence_deg:.1f}",
                    "Sun az deg": f"{shot.sun_azimuth_deg:.1f}",
                    "em deg": f"{shot.emission_deg:.1f}",
                    "phase deg": f"{shot.phase_deg:.1f}",
                    "% of scene": f"{100 * share:.0f}",
                    "mean I/F": f"{i.mean_iof:.4f}",
                    "SNR": f"{i.mean_iof / i.noise_iof:.0f}",
                }
            )
        return rows


def scene_files(config: Config) -> list[str]:
    """The files of a scene, within its folder."""
    images = [_image_name(shot) for shot in plan_passes(config)]
    return ["dem.tif", "images.csv", "truth.h5", "truth.tif", SIDECAR, *images]


def _image_name(shot: Pass) -> str:
    return f"images/{shot.image_id}.tif"


def work(folder: Path, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.simulate.run`."""
    hidden = config.hidden_effects()
    truth = Truth(config)
    shots = plan_passes(config)
    names = [_image_name(shot) for shot in shots]
    with atomic_folder(folder, SIDECAR) as staging:  # all of it or nothing: images without their truth are of no use
        summary = _make_scene(staging, config, shots, names, hidden, truth, progress)
    return replace(summary, folder=folder)


def _make_scene(
    folder: Path,
    config: Config,
    shots: Sequence[Pass],
    names: Sequence[str],
    hidden: Hidden,
    truth: Truth,
    progress: Progress,
) -> Summary:
    """Every file of the scene, in ``folder``."""
    terrain = Terrain(config)
    grid = scene_grid(config, config.dem_gsd, config.dem_size)
    with _truth_arrays(folder, config.dem_size) as (elevation, log_geometry, log_free):
        scene = Scene(grid, elevation, log_geometry, log_free, truth)
        _make_ground(config, terrain, scene, progress)
        dem_valid = _write_dem(folder / "dem.tif", config, scene, hidden)
        images, covered, rows = [], [], []
        for k, (shot, name) in enumerate(zip(shots, names, strict=True)):
            progress(k, len(shots), "images")
            image, share = _make_image(folder / name, config, scene, shot, k, hidden)
            images.append(image)
            covered.append(share)
            rows.append(table_row(config, shot, name, hidden))
        progress(len(shots), len(shots), "images")
        working = scene_grid(config, config.gsd, config.size_px)
        write_truth(folder / "truth.h5", config, scene, working, terrain.craters, images, hidden)
    write_table(folder / "images.csv", rows)
    files = [folder / name for name in ("dem.tif", "images.csv", "truth.tif")]
    with atomic_path(folder / SIDECAR) as partial:
        images_made = [folder / name for name in names]
        partial.write_text(folder_record("simulate", asdict(config), config.seed, files, images_made))
    return Summary(folder, images, covered, dem_valid, len(terrain.craters), hidden)


def scene_grid(config: Config, gsd: float, size: int) -> Grid:
    """A square grid about the scene's centre in a local stereographic projection."""
    half = config.extent / 2
    crs = local_metric_crs(config.longitude_deg, config.latitude_deg, RADIUS)
    return Grid(crs.to_wkt(), Affine(gsd, 0, -half, 0, -gsd, half), size, size, RADIUS)


@contextlib.contextmanager
def _truth_arrays(folder: Path, size: int) -> Iterator[list[NDArray[np.float32]]]:
    """Elevation and the two albedo factors, in memory or, for large scenes, in a temporary file of the folder."""
    shape = (size, size)
    if 12 * size * size <= IN_MEMORY:
        yield [np.empty(shape, np.float32) for _ in range(3)]
        return
    with tempfile.TemporaryDirectory(prefix=".truth-", dir=folder) as scratch:
        yield [np.memmap(Path(scratch) / f"{k}.f4", np.float32, "w+", shape=shape) for k in range(3)]


def _make_ground(config: Config, terrain: Terrain, scene: Scene, progress: Progress) -> None:
    size = config.dem_size
    for first in range(0, size, GROUND_ROWS):
        progress(first, size, "terrain rows")
        count = min(GROUND_ROWS, size - first)
        ground = terrain.block(first - MARGIN, -MARGIN, count + 2 * MARGIN, size + 2 * MARGIN)
        rows = slice(first, first + count)
        scene.elevation[rows] = ground.elevation[MARGIN:-MARGIN, MARGIN:-MARGIN]
        scene.log_geometry[rows], scene.log_free[rows] = log_albedo(config, ground, first)
    progress(size, size, "terrain rows")


def _write_dem(path: Path, config: Config, scene: Scene, hidden: Hidden) -> float:
    """The DEM that the pipeline is given: the truth with its error, holes and ragged edge. Returns its valid share."""
    rng = np.random.default_rng([config.seed, 4])
    size, half, step = config.dem_size, config.extent / 2, config.dem_gsd
    holes = [
        (rng.uniform(-0.45, 0.45, 2) * config.extent, rng.uniform(0.006, 0.018, 2) * config.extent)
        for _ in range(config.dem_holes)
    ]
    phases = rng.uniform(0, 2 * np.pi, 4)
    x = (np.arange(size) + 0.5) * step - half
    scale, smooth = hidden.get("dem_scale"), hidden.get("dem_smoothing")
    relative = 1 + scale["relative"] if scale else 1.0
    kernel = point_spread(1.0, 1.0, 0.0, smooth["sigma2_px2"]) if smooth else None
    reach = len(kernel) // 2 if kernel is not None else 0
    datum = config.base_elevation
    valid = 0
    with (
        atomic_path(path) as partial,
        open_geotiff(partial, scene.grid, "float32", NODATA_FLOAT) as file,
    ):
        for first in range(0, size, GROUND_ROWS):
            count = min(GROUND_ROWS, size - first)
            low, high = max(0, first - reach), min(size, first + count + reach)
            heights = np.array(scene.elevation[low:high])
            if kernel is not None:
                heights = blur(heights, kernel)
            heights = heights[first - low : first - low + count]
            heights = np.float32(datum) + (heights - np.float32(datum)) / np.float32(relative)
            heights += np.float32(config.dem_error) * rng.standard_normal(heights.shape, dtype=np.float32)
            y = half - (np.arange(first, first + count) + 0.5)[:, None] * step
            inside = _dem_inside(config, x[None], y, phases)
            for (cx, cy), (a, b) in holes:
                inside &= ((x[None] - cx) / a) ** 2 + ((y - cy) / b) ** 2 > 1
            valid += int(inside.sum())
            file.write(np.where(inside, heights, np.float32(NODATA_FLOAT)), 1, window=Window(0, first, size, count))
        file.set_band_description(1, "elevation above the sphere")
        file.units = ("m",)
    return valid / size**2


def _dem_inside(config: Config, x: NDArray, y: NDArray, phases: NDArray) -> NDArray[np.bool_]:
    """Stereo models overlap raggedly: the edge wanders by about a hundredth of the scene."""
    half = config.extent / 2
    wander = 0.008 * config.extent

    def edge(t: NDArray, phase: float) -> NDArray:
        return half - wander * (1.1 + np.sin(9 * t / half + phase) * 0.7 + 0.3 * np.sin(41 * t / half + 2 * phase))

    return (x < edge(y, phases[0])) & (-x < edge(y, phases[1])) & (y < edge(x, phases[2])) & (-y < edge(x, phases[3]))


@dataclass(frozen=True)
class Exposure:
    """What makes one image of the ground's light.

    kernel : (n,) float32, point spread on the DEM's grid; reach : DEM px around a place that its signal comes from
    """

    config: Config
    scene: Scene
    view: View
    kernel: NDArray[np.float32]
    reach: int
    detector: sensor.Detector
    hidden: Hidden


def _make_image(
    path: Path, config: Config, scene: Scene, shot: Pass, number: int, hidden: Hidden
) -> tuple[ImageTruth, float]:
    """Render, blur, resample, expose and write one image, in bands of rows."""
    rng = np.random.default_rng([config.seed, 6, number])
    step = config.dem_gsd
    view = View(
        shot,
        unit_vectors(shot.sun.longitude_deg, shot.sun.latitude_deg) * shot.sun.distance_au * AU,
        unit_vectors(shot.spacecraft_longitude_deg, shot.spacecraft_latitude_deg) * (RADIUS + shot.spacecraft_altitude),
    )
    image = sensor.image_grid(config, scene.grid, shot, number)
    extra = hidden.get("psf_blur")
    detector = sensor.make_detector(config, shot, hidden, expected_iof(scene, shot), rng)
    model = detector.model
    optics = config.psf_sigma_px if model is None else model.psf_sigma_px
    kernel = point_spread(step, shot.gsd, optics, extra["sigma2_px2"] if extra else 0.0)
    echo = hidden.get("echo")
    reach = len(kernel) // 2 + 4 + (int(echo["lag_px"] * shot.gsd / step) + 2 if echo else 0)
    exposure = Exposure(config, scene, view, kernel, reach, detector, hidden)
    band = int(max(64, min(image.height, WINDOW_PIXELS * (step / shot.gsd) ** 2 / image.width)))
    total, count = 0.0, 0
    with atomic_path(path) as partial:
        out = ImageFile(partial, image, config.units, number % 2 == 1, shot)
        with out.file:
            for first in range(0, image.height, band):
                rows = min(band, image.height - first)
                lattice = sensor.Lattice.fit(image, first, rows, scene.grid)
                inside = sensor.footprint(config, shot, lattice.x, lattice.y, number)
                signal = np.zeros(inside.shape, np.float32)
                if inside.any():
                    signal = _signal(exposure, lattice, inside)
                    total += float(signal[inside].sum(dtype=np.float64))
                    count += int(inside.sum())
                # drawn for every pixel: the noise is then the same however the image is cut into bands
                signal = sensor.read_out(signal, config, shot, detector, lattice, rng)
                out.write(first, signal, inside, detector)
    mean = total / max(count, 1)
    read_noise = config.read_noise if model is None else model.read_noise
    noise = np.sqrt(max(mean, 0) * detector.electrons + read_noise**2) / detector.electrons
    return ImageTruth(shot, detector, mean, float(noise)), count * shot.gsd**2 / config.extent**2


def _signal(exposure: Exposure, lattice: sensor.Lattice, inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The noise-free signal, I/F, of a band of an image; lattice and inside : (rows, columns) of the band."""
    scene, view, detector, hidden = exposure.scene, exposure.view, exposure.detector, exposure.hidden
    size, reach = exposure.config.dem_size, exposure.reach
    row, col = sensor.move(exposure.config, view.shot, detector, lattice, scene.grid.gsd)
    r0, r1 = int(row[inside].min()) - reach, int(row[inside].max()) + reach + 1
    c0, c1 = int(col[inside].min()) - reach, int(col[inside].max()) + reach + 1
    r0, c0, r1, c1 = max(0, r0), max(0, c0), min(size, r1), min(size, c1)
    window = (r0, c0, r1 - r0, c1 - c0)
    wanted = _wanted(row[inside], col[inside], window, reach)
    light = blur(radiance(scene, view, window, wanted, hidden), exposure.kernel)
    signal = sensor.resample(light, row, col, window)
    late = None
    if echo := hidden.get("echo"):
        # lines run across the track: the echo of what was read ``lag`` pixels earlier
        lag = echo["lag_px"] * view.shot.gsd / scene.grid.gsd
        heading = np.radians(view.shot.strip.heading_deg)
        late = sensor.resample(light, row + lag * np.sin(heading), col - lag * np.cos(heading), window)
    return sensor.respond(signal, late, lattice, view.shot, detector, hidden)


def _wanted(row: NDArray, col: NDArray, window: tuple[int, int, int, int], reach: int) -> NDArray[np.bool_]:
    """Which DEM pixels of a window the image needs, on a coarse mesh grown by the reach of the optics."""
    mesh = 32
    height, width = -(-window[2] // mesh), -(-window[3] // mesh)
    cells = np.zeros((height, width), np.uint8)
    # cut off, not floored, which takes NumPy ten times as long: below 0 either ends in the first cell
    r = np.clip(((row - window[0]) / mesh).astype(np.int32), 0, height - 1)
    c = np.clip(((col - window[1]) / mesh).astype(np.int32), 0, width - 1)
    cells[r, c] = 1
    grow = 2 * -(-reach // mesh) + 1
    grown = cv2.dilate(cells, np.ones((grow, grow), np.uint8)) > 0
    return np.repeat(np.repeat(grown, mesh, 0), mesh, 1)[: window[2], : window[3]]


def expected_iof(scene: Scene, shot: Pass) -> float:
    """I/F of level ground in this image: what auto-exposure aims at."""
    from stages.physics.photometry import evaluate

    angles = np.radians([shot.incidence_deg, shot.emission_deg, shot.phase_deg])
    return float(evaluate(scene.truth.model.name, scene.truth.constants, *angles))
