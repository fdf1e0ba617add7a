"""render: images of a terrain with its reflectance, for any Sun and camera, with backplanes."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.errors import ConfigError, GeometryError
from schemas.hdf5 import check_output
from stages.physics.bodies import Body, find_body
from stages.physics.cameras.base import Camera, camera_from_document, read_document
from stages.physics.light import SunHorizon
from stages.physics.mapview import BACKPLANES, Light, shade_block
from stages.physics.perspective import apply_sensor, make_scene, render_view
from stages.physics.pictures import Preview, write_exr, write_geotiff, write_png
from stages.physics.sun import check_sun_is_up, find_sun
from stages.physics.surface import Surface, open_surface, open_terrain
from stages.physics.trajectory import ViewRow, read_trajectory
from stages.physics.view import look_at, pinhole_view, place, rotation_from_quaternion

Progress = Callable[[int, int, str], None]
Floats32 = NDArray[np.float32]

VIEWS = ("ortho", "pinhole")
BAND_ROWS = 256  # an ortho view passes through memory in bands this high
BAND_COLUMNS = 1024
UNITS = {"image": "1", "shadow": "1", "depth": "m", "elevation": "m"}


@dataclass(frozen=True)
class Config:
    """What to render. The Sun by exactly one of its three descriptions; angles in degrees.

    position : longitude, latitude, metres above the sphere; in an ortho view the place that light is reflected to
    look_at : longitude, latitude (and metres above the sphere; the ground's own height where that is absent)
    quaternion : w, x, y, z, camera axes (right, down, forward) to body-fixed, instead of look_at
    camera : path of a camera model (JSON), instead of position, attitude, fov and size
    samples : rays per pixel and axis (None: as many as the pixel's footprint asks for)
    model, parameters : a reflectance that is the same everywhere, where the source holds none
    terrain_only : of svbrdf.h5 use the terrain, with ``model``
    """

    view: str = "ortho"
    sun_azimuth_deg: float | None = None
    sun_elevation_deg: float | None = None
    subsolar_longitude_deg: float | None = None
    subsolar_latitude_deg: float | None = None
    solar_distance_au: float | None = None
    time: str | None = None
    position: tuple[float, ...] | None = None
    look_at: tuple[float, ...] | None = None
    quaternion: tuple[float, ...] | None = None
    roll_deg: float = 0.0
    fov_deg: float = 20.0
    size_px: tuple[int, int] = (1024, 1024)
    camera: str | None = None
    samples: int | None = None
    shadows: bool = True
    model: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    terrain_only: bool = False
    extension: str | None = None
    body: str = "moon"
    backplanes_in_tif: bool = False


@dataclass(frozen=True)
class Summary:
    """What was rendered, for the line at the end."""

    view_id: str
    files: tuple[Path, ...]
    size_px: tuple[int, int]
    known_share: float
    mean: float
    shadow_share: float
    incidence_deg: tuple[float, float]
    samples: int
    skipped: bool = False


def run(
    source: Path, output: Path, config: Config, overwrite: bool = False, progress: Progress | None = None
) -> Summary:
    """Render one view of ``source`` (svbrdf.h5, scene.h5 or a DEM). Raises LunargrError.

    output : NAME.exr writes NAME.exr, NAME.png and, for ortho views, NAME.tif; NAME.tif and NAME.png leave the EXR out
    """
    _check(config)
    body = find_body(config.body)
    files = output_files(output, config.view)
    for path in files:
        check_output(path, _inputs(source, config), overwrite)
    with _open(source, config, body) as surface:
        relief = surface.height_range()
        light = _light(surface, config, body, relief)
        if config.view == "ortho":
            return _render_map(surface, light, relief, files, config, progress)
        camera = _camera(surface, config, body)
        return _render_camera(surface, camera, light, relief, files, config, output.stem, progress)


def run_trajectory(
    source: Path,
    table: Path,
    folder: Path,
    config: Config,
    *,
    shard: tuple[int, int] = (0, 1),
    resume: bool = False,
    overwrite: bool = False,
    suffix: str = ".exr",
    progress: Progress | None = None,
) -> list[Summary]:
    """Render the views of a trajectory table into a folder, one EXR and PNG per row. Raises LunargrError.

    resume : leave alone what is there already; shard : only every n-th view
    """
    config = replace(config, view="pinhole")
    _check(config, trajectory=True)
    body = find_body(config.body)
    views = read_trajectory(table)[shard[0] :: shard[1]]
    outputs = {view.view_id: output_files(folder / f"{view.view_id}{suffix}", "pinhole") for view in views}
    done = {v.view_id for v in views if resume and all(p.exists() for p in outputs[v.view_id])}
    for view in views:
        if view.view_id not in done:
            for path in outputs[view.view_id]:
                check_output(path, [table, *_inputs(source, config)], overwrite or resume)
    results: list[Summary] = []
    with _open(source, config, body) as surface:
        relief = surface.height_range()
        lights: dict[str, Light] = {}  # a Sun that stays serves many views with one horizon
        for number, view in enumerate(views):
            if progress:
                progress(number, len(views), "views")
            if view.view_id in done:
                results.append(
                    Summary(
                        view.view_id,
                        tuple(outputs[view.view_id]),
                        config.size_px,
                        1.0,
                        math.nan,
                        math.nan,
                        (math.nan, math.nan),
                        0,
                        True,
                    )
                )
                continue
            own = _with_row(config, view)
            key = repr([getattr(own, k) for k in _SUN])
            try:
                if key not in lights:
                    lights = {key: _light(surface, own, body, relief)}
                camera = _camera(surface, own, body)
                light = replace(lights[key], camera_position=_camera_place(camera))
                results.append(
                    _render_camera(surface, camera, light, relief, outputs[view.view_id], own, view.view_id, None)
                )
            except GeometryError as error:
                raise GeometryError(f"{table.name}, {view.view_id}: {error}") from None
    if progress:
        progress(len(views), len(views), "views")
    return results


_SUN = (
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "subsolar_longitude_deg",
    "subsolar_latitude_deg",
    "solar_distance_au",
    "time",
)


def _with_row(config: Config, view: ViewRow) -> Config:
    """The command's options with what a row of the table says in their place; a row's Sun replaces the whole Sun."""
    own = replace(
        config,
        position=view.position,
        look_at=view.look_at if view.look_at is not None or view.quaternion is not None else config.look_at,
        quaternion=view.quaternion,
        roll_deg=view.roll_deg,
        fov_deg=view.fov_deg if view.fov_deg is not None else config.fov_deg,
    )
    if view.sun:
        own = replace(own, **{**dict.fromkeys(_SUN), **view.sun})  # type: ignore[arg-type]
    return own


def _inputs(source: Path, config: Config) -> list[Path]:
    return [source, *(Path(p) for p in (config.camera, config.extension) if p)]


def output_files(output: Path, view: str) -> list[Path]:
    """The files behind one --output. Raises ConfigError."""
    suffix = output.suffix.lower()
    png, tif = output.with_suffix(".png"), output.with_suffix(".tif")
    if suffix in (".exr", ""):
        exr = output.with_suffix(".exr")
        return [exr, png, tif] if view == "ortho" else [exr, png]
    if suffix in (".tif", ".tiff"):
        if view != "ortho":
            raise ConfigError(f"{output}: a pinhole view has no map grid for a GeoTIFF; name a .exr or .png file.")
        return [output, png]
    if suffix == ".png":
        return [output]
    raise ConfigError(f"{output}: expected a name that ends in .exr, .tif or .png; choose another --output.")


def _check(config: Config, trajectory: bool = False) -> None:
    if config.view not in VIEWS:
        raise ConfigError(f"--view: expected one of {', '.join(VIEWS)}; found '{config.view}'.")
    if config.samples is not None and not 1 <= config.samples <= 32:
        raise ConfigError(f"--samples: expected rays per pixel and axis in 1..32, found {config.samples}.")
    if config.view == "ortho" or config.camera or trajectory:
        return
    if config.position is None:
        raise ConfigError("--view pinhole: expected --position LON,LAT,ALT or --camera FILE; found neither.")
    if config.look_at is not None and config.quaternion is not None:
        raise ConfigError("--view pinhole: expected --look-at or --quaternion, found both.")


@contextlib.contextmanager
def _open(source: Path, config: Config, body: Body):
    opened = open_terrain if config.terrain_only else open_surface
    with opened(source, config.model, config.parameters, body) as surface:
        yield surface


def _light(surface: Surface, config: Config, body: Body, relief: tuple[float, float]) -> Light:
    sun = find_sun(
        surface.grid,
        Body(body.name, surface.grid.radius),
        azimuth_deg=config.sun_azimuth_deg,
        elevation_deg=config.sun_elevation_deg,
        subsolar_longitude_deg=config.subsolar_longitude_deg,
        subsolar_latitude_deg=config.subsolar_latitude_deg,
        time=config.time,
        distance_au=config.solar_distance_au,
    )
    span = relief[1] - relief[0]
    check_sun_is_up(sun, surface.grid, span)
    horizon = SunHorizon(surface.elevation, surface.grid, sun, span) if config.shadows else None
    extensions: list = []
    if config.extension:
        from stages.effects import load_extension

        # the diagnosed images are not this one: their own values must not be taken for it
        extensions = load_extension(Path(config.extension), ["rendered"])
    position = None
    if config.position is not None:
        position = place(*_three(config.position, "--position"), surface.grid.radius)
    return Light(sun, horizon, position, extensions)


def _three(values: Sequence[float], option: str) -> tuple[float, float, float]:
    if len(values) != 3:
        raise ConfigError(
            f"{option}: expected LON,LAT,ALT (degrees, degrees, metres above the sphere), found {len(values)} numbers."
        )
    return values[0], values[1], values[2]


def _camera(surface: Surface, config: Config, body: Body) -> Camera:
    """The camera of a view: a model from a file, or a pinhole at a place. Raises LunargrError."""
    if config.camera:
        return camera_from_document(read_document(Path(config.camera)), config.camera)
    grid = surface.grid
    lon, lat, altitude = _three(config.position or (), "--position")
    position = place(lon, lat, altitude, grid.radius)
    if config.quaternion is not None:
        rotation = rotation_from_quaternion(config.quaternion)
    else:
        target = config.look_at if config.look_at is not None else (lon, lat)
        if len(target) not in (2, 3):
            raise ConfigError(f"--look-at: expected LON,LAT or LON,LAT,ALT, found {len(target)} numbers.")
        height = target[2] if len(target) == 3 and math.isfinite(target[2]) else _ground_height(surface, *target[:2])
        rotation = look_at(position, place(target[0], target[1], height, grid.radius), config.roll_deg)
    return pinhole_view(position, rotation, config.fov_deg, config.size_px, grid.radius)


def _ground_height(surface: Surface, longitude_deg: float, latitude_deg: float) -> float:
    """Height of the nearest pixel, 0 off the map or where it is unknown."""
    row, col = (float(v) for v in surface.grid.rowcol_of_lonlat(longitude_deg, latitude_deg))
    if not (-0.5 <= row < surface.grid.height - 0.5 and -0.5 <= col < surface.grid.width - 0.5):
        return 0.0
    r, c = round(row), round(col)
    value = float(surface.elevation[r : r + 1, c : c + 1][0, 0])
    return value if math.isfinite(value) else 0.0


def _camera_place(camera: Camera) -> NDArray[np.float64]:
    return camera.position(np.array([camera.lines / 2]))[0]


class _Tally:
    """Shares and means gathered from bands."""

    def __init__(self) -> None:
        self.pixels = self.known = 0
        self.total = self.dark = 0.0
        self.low, self.high = math.inf, -math.inf

    def add(self, band: Mapping[str, Floats32]) -> None:
        image, known = band["image"], np.isfinite(band["image"])
        self.pixels += image.size
        self.known += int(known.sum())
        self.total += float(image[known].sum(dtype=np.float64))
        self.dark += float(np.nansum(np.where(known, band["shadow"], np.nan), dtype=np.float64))
        incidence = band["incidence_deg"][np.isfinite(band["incidence_deg"])]
        if incidence.size:
            self.low, self.high = min(self.low, float(incidence.min())), max(self.high, float(incidence.max()))

    def summary(self, view_id: str, files: Sequence[Path], size: tuple[int, int], samples: int) -> Summary:
        n = max(self.known, 1)
        return Summary(
            view_id,
            tuple(files),
            size,
            self.known / max(self.pixels, 1),
            self.total / n,
            self.dark / n,
            (self.low, self.high),
            samples,
        )


def _metadata(surface: Surface, config: Config, light: Light) -> dict[str, object]:
    """What a file must say about how it came to be."""
    told = {k: v for k, v in asdict(config).items() if v not in (None, {}, False)}
    return {
        "source": surface.path.name,
        "model": surface.model.name,
        "quantity": "radiance factor I/F = pi r, including cos(incidence)",
        "sun_position_mcmf": " ".join(f"{v:.6e}" for v in light.sun.position),
        "config": " ".join(f"{k}={v}" for k, v in sorted(told.items())),
    }


def _render_map(
    surface: Surface,
    light: Light,
    relief: tuple[float, float],
    files: Sequence[Path],
    config: Config,
    progress: Progress | None,
) -> Summary:
    grid = surface.grid
    channels = ["image", *BACKPLANES, "elevation"]
    bands = channels if config.backplanes_in_tif else ["image"]
    named = {path.suffix.lower(): path for path in files}
    wanted = channels if ".exr" in named else list(dict.fromkeys([*bands, "shadow", "incidence_deg"]))
    preview, tally = Preview(grid.height, grid.width), _Tally()
    metadata = _metadata(surface, config, light)
    with contextlib.ExitStack() as stack:
        exr = tif = None
        if ".exr" in named:
            exr = stack.enter_context(write_exr(named[".exr"], grid.height, grid.width, channels, metadata))
        for suffix in (".tif", ".tiff"):
            if suffix in named:
                units = [UNITS.get(b, "degree") for b in bands]
                tif = stack.enter_context(write_geotiff(named[suffix], grid, bands, metadata, units))
        for row in range(0, grid.height, BAND_ROWS):
            if progress:
                progress(row, grid.height, "rows")
            height = min(BAND_ROWS, grid.height - row)
            band = {c: np.empty((height, grid.width), np.float32) for c in wanted}
            for col in range(0, grid.width, BAND_COLUMNS):
                block = shade_block(surface, light, row, col, height, min(BAND_COLUMNS, grid.width - col))
                if light.camera_position is None:
                    block["depth"] = relief[1] - block["elevation"]  # from a plane of sight through the highest point
                for name in wanted:
                    band[name][:, col : col + BAND_COLUMNS] = block[name]
            if exr:
                exr.write(band)
            if tif:
                tif.write(np.stack([band[b] for b in bands]))
            preview.add(band["image"])
            tally.add(band)
        if tally.known == 0:
            raise GeometryError(
                f"{surface.path}: expected valid coefficients and elevations, found none; nothing to render."
            )
        write_png(named[".png"], preview.image())
    if progress:
        progress(grid.height, grid.height, "rows")
    return tally.summary(files[0].stem, files, (grid.width, grid.height), 1)


def _render_camera(
    surface: Surface,
    camera: Camera,
    light: Light,
    relief: tuple[float, float],
    files: Sequence[Path],
    config: Config,
    view_id: str,
    progress: Progress | None,
) -> Summary:
    light = replace(light, camera_position=_camera_place(camera))
    scene = make_scene(surface, camera, light, relief, config.samples)
    channels = ["image", *BACKPLANES]
    planes = {c: np.empty((camera.lines, camera.samples), np.float32) for c in channels}
    done = 0
    tally = _Tally()
    for band in render_view(surface, camera, light, scene):
        rows = len(band["image"])
        for name in channels:
            planes[name][done : done + rows] = band[name]
        done += rows
        if progress:
            progress(done, camera.lines, "lines")
    planes["image"] = apply_sensor(planes["image"], light, scene.grid)
    tally.add(planes)
    if not np.isfinite(planes["depth"]).any():
        raise GeometryError(
            f"the view misses {surface.path.name}: no pixel sees valid ground; check the camera's place, --look-at (or --quaternion) and --fov."
        )
    metadata = _metadata(surface, config, light)
    named = {path.suffix.lower(): path for path in files}
    with contextlib.ExitStack() as stack:
        if ".exr" in named:
            exr = stack.enter_context(write_exr(named[".exr"], camera.lines, camera.samples, channels, metadata))
            exr.write(planes)
        write_png(named[".png"], planes["image"])
    return tally.summary(view_id, files, (camera.samples, camera.lines), scene.samples)
