"""ingest: a DEM on a metric grid at the working GSD, and where crops of each image may be centred.

Everything streams in blocks: memory does not grow with the DEM.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.transform import Affine
from rasterio.warp import Resampling, calculate_default_transform
from rasterio.windows import Window

from schemas import (
    SCENE,
    ArtefactError,
    ArtefactWriter,
    ConfigError,
    GeometryError,
    InputError,
    open_artefact,
    read_config,
)
from schemas.hdf5 import sha256, silence_hdf5
from stages.physics import rasters
from stages.physics.bodies import Body, find_body
from stages.physics.frames import Frame, load_frames, read_frames, write_frames
from stages.physics.grid import Grid, check_body, local_metric_crs, read_grid, require_crs
from stages.physics.positions import blocks, valid_positions
from stages.physics.sources import open_source

Progress = Callable[[int, int, str], None]

# A map whose pixels are within this of square and of the working GSD counts as metric: no resampling, only means.
METRIC_TOLERANCE = 0.01
LARGEST_REACH = math.radians(30)  # a local stereographic map's scale is 7 % too large there
ANY_RELIEF = 0.006  # of the radius: Olympus Mons; Vesta's and Phobos' shapes go beyond, their DEMs' datum does not
STRIP_PX = 4096  # a raster whose blocks are wider is one in strips
STRIPS = 96 << 20  # bytes of strips that stay in GDAL's cache
LOWEST = 16  # rows of such a piece
MINIMUM_COVERAGE = 0.5  # share of a coarse pixel that must be valid before its mean counts


@dataclass(frozen=True)
class Config:
    """gsd : m, None for the DEM's own; crop : px; block : px, the unit of streaming."""

    gsd: float | None = None
    crop: int = 128
    body: str = "moon"
    block: int = 1024
    skip_outside: bool = False
    shard: tuple[int, int] = (0, 1)


@dataclass(frozen=True)
class Summary:
    """What ingest found, for the table at the end."""

    grid: Grid
    dem_valid_share: float
    elevation_range: tuple[float, float]
    frames: tuple[Frame, ...]
    valid_area_km2: tuple[float, ...]
    resampled: bool
    skipped: tuple[str, ...]


def run(
    dem: Path,
    images: Path | None,
    output: Path,
    config: Config,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Summary:
    """Write ``scene.h5``. Raises InputError, GeometryError or ConfigError; then nothing is written.

    dem : a raster, or a scene whose grid and elevations are taken as they are. Shards are cut in two steps: of a raster
    without images, its rows; of a scene with images, the images.
    """
    if config.crop < 16 or config.crop % 2:
        raise ConfigError(f"--crop: expected an even number of pixels, at least 16; found {config.crop}.")
    body = find_body(config.body)
    frames = read_frames(images, body) if images else []
    index, count = config.shard
    with _open_terrain(dem, images, config, body) as terrain:
        first, last = (len(frames) * k // count for k in (index, index + 1))
        mine, skipped = _check_frames(frames[first:last], terrain.grid, config.skip_outside)
        if frames and not mine and count == 1:
            raise InputError(
                "no image touches the DEM; check that images and DEM show the same place (longitudes, body, CRS)."
            )
        sizes = {"frame": len(mine), "y": terrain.grid.height, "x": terrain.grid.width, "window": 4}
        with ArtefactWriter(
            output,
            SCENE,
            sizes,
            config=terrain.config,
            inputs=[dem] + ([images] if images else []),
            attributes=terrain.attributes | {"crop_px": np.int32(config.crop)},
            overwrite=overwrite,
        ) as writer:
            _write_grid(writer, terrain.grid)
            known, low, high = terrain.write(writer, progress)
            writer.file.attrs["elevation_low_m"], writer.file.attrs["elevation_high_m"] = low, high
            writer.file.attrs["dem_valid_px"] = known
            for name in ("valid", "valid_position", "frame_window"):  # also where there is no image at all
                writer.dataset(name)
            areas = [
                _write_validity(
                    frame,
                    k,
                    len(mine),
                    terrain.grid,
                    (low, high),
                    terrain.file or writer.file,
                    writer,
                    config,
                    progress,
                )
                for k, frame in enumerate(mine)
            ]
            if frames and count == 1 and not any(areas):
                raise _no_positions(images, config, terrain.grid.gsd)
            writer.write("valid_area_m2", np.array(areas))
            write_frames(writer, [_with_digests(frame) for frame in mine])
    return summarise(output, tuple(skipped))


def summarise(scene: Path, skipped: tuple[str, ...] = ()) -> Summary:
    """What a scene holds, for the table at the end."""
    with open_artefact(scene, SCENE) as file:
        grid = read_grid(file, scene)
        low, high, known = (file.attrs[k] for k in ("elevation_low_m", "elevation_high_m", "dem_valid_px"))
        return Summary(
            grid,
            float(known) / (grid.height * grid.width),
            (float(low), float(high)),
            tuple(load_frames(file, scene)),
            tuple(float(a) / 1e6 for a in file["valid_area_m2"][...]),
            bool(read_config(file)["resampled"]),
            skipped,
        )


@dataclass(frozen=True)
class Terrain:
    """Where the scene's elevations come from. ``write`` gives the number of valid pixels, and the extremes."""

    grid: Grid
    config: dict[str, Any]
    attributes: dict[str, Any]
    write: Callable[[ArtefactWriter, Progress | None], tuple[int, float, float]]
    file: h5py.File | None = None  # where they can be read at once; views cannot be, while they are written


@contextlib.contextmanager
def _open_terrain(dem: Path, images: Path | None, config: Config, body: Body) -> Iterator[Terrain]:
    index, count = config.shard
    if is_artefact(dem):
        if images is None:
            raise ConfigError(f"{dem}: a scene already; add --images, or give a DEM that GDAL reads.")
        with open_artefact(dem, SCENE, need=()) as file:
            grid = read_grid(file, dem)
            if abs(grid.radius - body.radius) > 1e-6 * body.radius:
                raise ConfigError(f"{dem}: its body has a radius of {grid.radius:g} m; give the same --body.")
            if config.gsd is not None and abs(config.gsd - grid.gsd) > 1e-3 * grid.gsd:
                raise ConfigError(f"{dem}: a grid at {grid.gsd:g} m; leave --gsd away, or give the DEM itself.")
            own = ("crop", "skip_outside", "shard", "block")
            stored = read_config(file) | {k: v for k, v in asdict(config).items() if k in own}
            names = ("gsd_m", "body_radius_m", "elevation_source")
            yield Terrain(
                grid, stored, {k: file.attrs[k] for k in names}, partial(_take_elevation, dem, file, count > 1), file
            )
        return
    if images is not None and count > 1:
        raise ConfigError(
            "--shard: the DEM comes first, then its images. Run 'lunargr ingest DEM --shard I/N' without --images and merge; "
            "then give that scene in place of the DEM, with --images and --shard."
        )
    with rasters.open_raster(dem, "a DEM") as dataset:
        crs = require_crs(str(dem), dataset.crs, dataset.transform)
        check_body(str(dem), crs, body)
        plan = plan_grid(dem, dataset, config.gsd, body.radius)
        attributes = {"gsd_m": plan.grid.gsd, "body_radius_m": body.radius, "elevation_source": dem.name}
        if count > 1:
            bands = math.ceil(plan.grid.height / config.block)
            rows = [min(plan.grid.height, config.block * (bands * k // count)) for k in (index, index + 1)]
            attributes["shard_rows"] = np.array(rows, np.int64)
        stored = asdict(config) | {"resampled": plan.factor is None}
        yield Terrain(plan.grid, stored, attributes, partial(_write_elevation, dem, dataset, plan, config))


def count_bands(dem: Path, config: Config) -> int:
    """Rows of blocks of a raster's grid: more shards than these have nothing to do."""
    with rasters.open_raster(dem, "a DEM") as dataset:
        require_crs(str(dem), dataset.crs, dataset.transform)
        plan = plan_grid(dem, dataset, config.gsd, find_body(config.body).radius)
    return math.ceil(plan.grid.height / config.block)


def image_names(images: Path, config: Config) -> list[str]:
    """The images of a table."""
    return [frame.image_id for frame in read_frames(images, find_body(config.body))]


def source_files(images: Path, config: Config) -> list[Path]:
    """The images and camera models that a table names."""
    return [p for f in read_frames(images, find_body(config.body)) for p in (f.path, f.camera) if p is not None]


def check_positions(parts: Sequence[Path], images: Path, config: Config) -> None:
    """What one run checks at its end, for shards: that any crop fits anywhere. Raises GeometryError."""
    gsd = math.nan
    for part in parts:
        with open_artefact(part, SCENE) as file:
            if file["valid_area_m2"][...].any():
                return
            gsd = float(file.attrs["gsd_m"])
    raise _no_positions(images, config, gsd)


def _no_positions(images: Path | None, config: Config, gsd: float) -> GeometryError:
    return GeometryError(
        f"{images}: a crop of {config.crop} px ({config.crop * gsd:g} m) is larger than any valid region of any image; "
        "choose a smaller --crop or a finer --gsd."
    )


def is_artefact(path: Path) -> bool:
    """Whether a file is one of our own and not a raster."""
    silence_hdf5()
    if not (path.is_file() and h5py.is_hdf5(path)):
        return False
    with h5py.File(path, "r") as file:
        return "lunargr_schema" in file.attrs


@dataclass(frozen=True)
class Plan:
    """How the DEM reaches its grid: an integer ``factor``, or None for a reprojection."""

    grid: Grid
    factor: int | None
    resampling: Resampling
    radius_is_elevation: bool


def plan_grid(dem: Path, dataset: DatasetReader, gsd: float | None, radius: float) -> Plan:
    """Area means where the DEM's grid is metric and divides the GSD, otherwise a local metric grid."""
    east, north = rasters.pixel_size_at(dataset, radius, dataset.height / 2, dataset.width / 2)
    native = max(east, north)
    if gsd is not None and not (math.isfinite(gsd) and gsd > 0):
        raise ConfigError(f"--gsd: expected a positive number of metres, found {gsd}.")
    if not (math.isfinite(native) and native > 0):
        raise GeometryError(f"{dem}: its georeference puts the DEM off the body; check its CRS and transform.")
    wanted = native if gsd is None else gsd
    if wanted < 0.5 * native:
        raise ConfigError(
            f"--gsd: expected at least half the DEM's own {native:g} m, found {wanted:g}; detail cannot be invented."
        )
    holds_radii = _holds_radii(dem, dataset, radius)
    t = dataset.transform
    if dataset.crs.is_projected and t.b == t.d == 0 and t.a > 0 > t.e and _is_metre(dataset):
        step = abs(t.a)
        factor = max(1, round(wanted / step))
        # At the centre and near the corners: an equirectangular map is true on one parallel only.
        places = [(v, u) for v in (0.1, 0.5, 0.9) for u in (0.1, 0.5, 0.9)]
        true = np.array(
            [rasters.pixel_size_at(dataset, radius, v * dataset.height, u * dataset.width) for v, u in places]
        )
        true_square = (
            bool((np.abs(true[:, 0] - true[:, 1]) <= METRIC_TOLERANCE * native).all())
            and abs(-t.e - t.a) <= 1e-3 * step
        )
        true_scale = bool((np.abs(true - step) <= 2 * METRIC_TOLERANCE * step).all())
        fits = gsd is None or abs(wanted - factor * step) <= 1e-3 * wanted
        if true_square and true_scale and fits:
            height, width = dataset.height // factor, dataset.width // factor
            if min(height, width) < 1:
                raise ConfigError(f"--gsd: {wanted:g} m is coarser than the whole DEM; choose a finer one.")
            transform = t @ Affine.scale(factor)
            return Plan(
                Grid(dataset.crs.to_wkt(), transform, height, width, radius), factor, Resampling.average, holds_radii
            )
    whole = Grid(dataset.crs.to_wkt(), t, dataset.height, dataset.width, radius)
    lon, lat = (float(v) for v in whole.lonlat(dataset.height / 2 - 0.5, dataset.width / 2 - 0.5))
    reach = np.hypot(dataset.height * north, dataset.width * east) / 2 / radius
    if not reach < LARGEST_REACH:
        raise GeometryError(
            f"{dem}: expected a region that one local map can hold (up to {math.degrees(2 * LARGEST_REACH):.0f} deg across), "
            f"found {math.degrees(2 * reach):.0f} deg; cut a region out first (gdal_translate -projwin)."
        )
    crs = local_metric_crs(lon, lat, radius)
    transform, width, height = calculate_default_transform(
        dataset.crs, crs, dataset.width, dataset.height, *dataset.bounds, resolution=wanted
    )
    # Pixel corners at whole multiples of the GSD: two runs on overlapping DEMs then differ by whole pixels only.
    transform = Affine(
        wanted, 0, wanted * round(transform.c / wanted), 0, -wanted, wanted * round(transform.f / wanted)
    )
    coarser = wanted > 1.5 * native
    return Plan(
        Grid(crs.to_wkt(), transform, height, width, radius),
        None,
        Resampling.average if coarser else Resampling.cubic,
        holds_radii,
    )


def _is_metre(dataset: DatasetReader) -> bool:
    return abs((dataset.crs.linear_units_factor[1] if dataset.crs.is_projected else 0) - 1) < 1e-6


def _holds_radii(dem: Path, dataset: DatasetReader, radius: float) -> bool:
    """Whether the DEM counts from the body's centre; and whether its numbers can be metres at all."""
    size = 256
    windows = [
        Window(c, r, min(size, dataset.width - c), min(size, dataset.height - r))
        for r in np.unique(np.linspace(0, max(0, dataset.height - size), 5).astype(int))
        for c in np.unique(np.linspace(0, max(0, dataset.width - size), 5).astype(int))
    ]
    samples = [rasters.read_window(dataset, w) for w in windows]
    finite = np.concatenate([s[np.isfinite(s)] for s in samples])
    if not finite.size and not _any_valid(dataset):
        raise InputError(f"{dem}: expected elevations, found only nodata; is this the right band and file?")
    if not finite.size:
        return False
    unit = (dataset.units[0] or "").strip().lower()
    if unit in ("km", "kilometre", "kilometer", "kilometers", "kilometres"):
        raise InputError(
            f"{dem}: expected elevations in metres, found units '{unit}'; convert it (gdal_calc.py --calc='A*1000')."
        )
    middle = float(np.median(finite))
    if abs(middle) > 0.5 * radius:
        if abs(middle - radius) > 0.05 * radius:
            raise InputError(
                f"{dem}: expected metres above the sphere or radii near {radius:g} m, found values near {middle:g}; check units and --body."
            )
        return True
    kilometres_radius = (
        abs(middle - radius / 1000) < 0.05 * radius / 1000 and float(np.ptp(finite)) < 0.02 * radius / 1000
    )
    if kilometres_radius:
        raise InputError(
            f"{dem}: expected metres, found values near {middle:g}, the body's radius in kilometres; multiply by 1000."
        )
    east, north = rasters.pixel_size_at(dataset, radius, dataset.height / 2, dataset.width / 2)
    rise = np.concatenate(
        [np.abs(np.diff(s, axis=1)).ravel() for s in samples if s.shape[1] > 1] or [np.array([np.nan])]
    )
    rise = rise[np.isfinite(rise)]
    if rise.size > 100:
        slope = math.degrees(math.atan(float(np.sqrt(np.mean(rise**2))) / min(east, north)))
        if slope > 80:
            raise InputError(
                f"{dem}: expected elevations in metres, found an rms slope of {slope:.1f} deg; are the units smaller than metres?"
            )
        if 0 < slope < 0.02:
            raise InputError(
                f"{dem}: expected elevations in metres, found an rms slope of {slope:.4f} deg; are they in kilometres?"
            )
    return False


def _any_valid(dataset: DatasetReader) -> bool:
    return any(np.isfinite(rasters.read_window(dataset, window)).any() for _, window in dataset.block_windows(1))


def area_mean(fine: NDArray, factor: int) -> NDArray[np.float32]:
    """Mean over factor x factor pixels, NaN where less than half is valid.

    fine : (H * factor, W * factor), NaN = nodata -> (H, W)
    """
    if factor == 1:
        return fine.astype(np.float32)
    height, width = fine.shape[0] // factor, fine.shape[1] // factor
    cells = fine[: height * factor, : width * factor].reshape(height, factor, width, factor)
    valid = np.isfinite(cells)
    count = valid.sum(axis=(1, 3))
    total = np.where(valid, cells, 0).sum(axis=(1, 3))
    enough = count >= MINIMUM_COVERAGE * factor * factor
    return np.where(enough, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _write_grid(writer: ArtefactWriter, grid: Grid) -> None:
    writer.write_crs(grid.crs_wkt, grid.transform)
    writer.write("x", grid.xy(0, np.arange(grid.width))[0])
    writer.write("y", grid.xy(np.arange(grid.height), 0)[1])


def _write_elevation(
    dem: Path, dataset: DatasetReader, plan: Plan, config: Config, writer: ArtefactWriter, progress: Progress | None
) -> tuple[int, float, float]:
    grid = plan.grid
    elevation, dem_valid = writer.dataset("elevation"), writer.dataset("dem_valid")
    first, last = writer.file.attrs.get("shard_rows", (0, grid.height))
    todo = [b for b in _pieces(dataset, grid, config) if first <= b[0] < last]
    seen, low, high = 0, math.inf, -math.inf
    for number, (row, col, height, width) in enumerate(todo):
        if progress:
            progress(number, len(todo), "DEM blocks")
        if plan.factor:
            values = _read_means(dataset, plan, plan.factor, (row, col, height, width))
        else:
            values, valid = rasters.warp(dataset, grid.window(row, col, height, width), plan.resampling)
            values[~valid] = np.nan
            if plan.radius_is_elevation:
                values = (values.astype(np.float64) - grid.radius).astype(np.float32)
        good = np.isfinite(values)
        elevation[row : row + height, col : col + width] = values
        dem_valid[row : row + height, col : col + width] = good
        if good.any():
            seen += int(good.sum())
            low, high = min(low, float(values[good].min())), max(high, float(values[good].max()))
    if progress:
        progress(len(todo), len(todo), "DEM blocks")
    if not seen and config.shard[1] == 1:
        raise InputError(f"{dem}: expected elevations, found only nodata on the grid at {grid.gsd:g} m.")
    return seen, low, high


def _pieces(dataset: DatasetReader, grid: Grid, config: Config) -> Iterator[tuple[int, int, int, int]]:
    """(row, col, height, width) of what is worked on at a time; no piece reaches over a multiple of ``config.block``.

    A DEM stored in strips as wide as itself is worked on in low pieces: GDAL's cache can then hold their strips until the
    last piece of the row is done, where it would otherwise read the whole DEM again for every piece.
    """
    height, (_, strip) = config.block, dataset.block_shapes[0]
    if strip > STRIP_PX:
        rows_of_dem = STRIPS // (strip * np.dtype(dataset.dtypes[0]).itemsize)
        height = min(height, max(LOWEST, int(rows_of_dem * grid.height / dataset.height)))
    for top in range(0, grid.height, config.block):
        rows = min(config.block, grid.height - top)
        for row in range(0, rows, height):
            for col in range(0, grid.width, config.block):
                yield top + row, col, min(height, rows - row), min(config.block, grid.width - col)


def _read_means(dataset: DatasetReader, plan: Plan, n: int, piece: tuple[int, int, int, int]) -> NDArray[np.float32]:
    """Means of n x n pixels over a piece of the grid; however large n is, only so much is read at a time."""
    row, col, height, width = piece
    values = np.empty((height, width), np.float32)
    step = max(1, rasters.LARGEST_WINDOW // (width * n * n))
    for r in range(0, height, step):
        h = min(step, height - r)
        block = rasters.read_window(dataset, Window(col * n, (row + r) * n, width * n, h * n))
        if plan.radius_is_elevation:
            block -= plan.grid.radius
        values[r : r + h] = area_mean(block, n)
    return values


def _take_elevation(
    scene: Path, file: h5py.File, view: bool, writer: ArtefactWriter, progress: Progress | None
) -> tuple[int, float, float]:
    """The elevations of another scene; a shard, of which there may be hundreds, only looks into it."""
    for name in ("elevation", "dem_valid"):
        whole = (slice(None), slice(None))
        if view:
            writer.link(name, [(whole, file[name], whole)])
            continue
        target = writer.dataset(name)
        for row in range(0, target.shape[0], 256):
            target[row : row + 256] = file[name][row : row + 256]
    if "dem_valid_px" not in file.attrs:
        raise ArtefactError(
            f"{scene}: expected the extremes of its elevations, found none; run 'lunargr ingest' again."
        )
    return (
        int(file.attrs["dem_valid_px"]),
        float(file.attrs["elevation_low_m"]),
        float(file.attrs["elevation_high_m"]),
    )


def _check_frames(frames: Sequence[Frame], grid: Grid, skip_outside: bool) -> tuple[list[Frame], list[str]]:
    """Every image must be readable, lie on the DEM and be lit. Raises InputError or GeometryError."""
    kept, skipped = [], []
    for frame in frames:
        # The DEM is not read yet: camera images are looked for at the heights that relief can have on any body.
        relief = ANY_RELIEF * grid.radius
        with open_source(frame, grid, None, (-relief, relief)) as source:
            if source.box() is None:
                if not skip_outside:
                    raise InputError(
                        f"{frame.path}: image '{frame.image_id}' does not touch the DEM; remove it from the table or add --skip-outside."
                    )
                skipped.append(frame.image_id)
                continue
        kept.append(frame)
    return kept, skipped


def _write_validity(
    frame: Frame,
    index: int,
    count: int,
    grid: Grid,
    heights: tuple[float, float],
    dem: h5py.File,
    writer: ArtefactWriter,
    config: Config,
    progress: Progress | None,
) -> float:
    """Write one image's masks; returns the ground area of its valid positions, m2."""
    valid, position = writer.dataset("valid"), writer.dataset("valid_position")
    dem_valid = dem["dem_valid"]
    used: tuple[int, int, int, int] | None = None
    with open_source(frame, grid, dem["elevation"], heights) as source:
        row0, col0, height, width = source.box() or (0, 0, 0, 0)
        todo = list(blocks(height, width, config.block))
        for number, (r, c, h, w) in enumerate(todo):
            if progress:
                progress(
                    index * 1000 + 1000 * number // max(1, len(todo)), count * 1000, f"image masks ({frame.image_id})"
                )
            r, c = row0 + r, col0 + c
            seen = source.read(r, c, h, w).valid & dem_valid[r : r + h, c : c + w].astype(bool)
            if seen.any():
                valid[index, r : r + h, c : c + w] = seen
                rows, cols = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
                used = _union(used, (r + rows[0], c + cols[0], r + rows[-1] + 1, c + cols[-1] + 1))
    if used is None:
        writer.dataset("frame_window")[index] = (row0, col0, 0, 0)
        return 0.0
    r0, c0, r1, c1 = used
    writer.dataset("frame_window")[index] = (r0, c0, r1 - r0, c1 - c0)
    area = 0.0
    for r, c, h, w in blocks(r1 - r0, c1 - c0, config.block):
        r, c = r0 + r, c0 + c
        eroded = valid_positions(valid[index], grid.height, grid.width, (r, c, h, w), config.crop)
        if eroded.any():
            position[index, r : r + h, c : c + w] = eroded
            pixel = grid.local_frames(r + h / 2, c + w / 2).pixel_size[0]
            area += float(eroded.sum()) * float(pixel[0] * pixel[1])
    _check_sun(frame, grid, (r0 + r1) / 2, (c0 + c1) / 2)
    if progress and index == count - 1:
        progress(count * 1000, count * 1000, "image masks")
    return area


def _with_digests(frame: Frame) -> Frame:
    """What the files held that the masks were made from. Raises InputError."""
    try:
        return replace(frame, sha256=sha256(frame.path), camera_sha256=sha256(frame.camera) if frame.camera else "")
    except OSError as error:
        raise InputError(
            f"{error.filename}: image '{frame.image_id}' cannot be read any more ({error.strerror}); bring it back."
        ) from None


def _union(box: tuple[int, int, int, int] | None, other: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    if box is None:
        return other
    return min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3])


def _check_sun(frame: Frame, grid: Grid, row: float, col: float) -> None:
    local = grid.local_frames(row, col)
    sun = frame.sun_position() - grid.radius * local.up[0]
    sine = float(local.up[0] @ sun / np.linalg.norm(sun))
    if sine <= 0:
        raise GeometryError(
            f"image '{frame.image_id}': the Sun stands {-math.degrees(math.asin(sine)):.1f} deg below the horizon at the image's centre; "
            "check its sub-solar longitude and latitude (degrees east)."
        )
