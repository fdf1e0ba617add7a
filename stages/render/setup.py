"""The terrain, the light and the camera that a configuration asks for."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.errors import ConfigError, GeometryError
from schemas.provenance import raster_record
from stages.common.brightness import QUANTITIES
from stages.physics.bodies.ephemeris import AU
from stages.physics.bodies.spheres import Body
from stages.physics.cameras import Camera
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.images.frame_geometry import open_camera_for
from stages.physics.light.earth import EARTH_DISTANCE
from stages.physics.light.sun_disc import SUN_RADIUS
from stages.physics.maps.grid import check_same_body
from stages.physics.terrain.further_light import BelowHorizon, Bounce, Earthshine, Horizon
from stages.physics.terrain.shading import Light
from stages.physics.terrain.sun import Sun, check_sun_is_up, elevation_range, find_sun, place_over
from stages.physics.terrain.sun_visibility import SunHorizon
from stages.physics.terrain.surface import Surface, open_surface, open_terrain
from stages.render.config import LARGEST_VIEW, SUN, Config
from stages.render.files import inputs
from stages.render.sight import ground_height
from stages.render.viewpoint import look_at, pinhole_view, place, rotation_from_quaternion

# of an image with detail, for whoever takes it for a photograph's model
INVENTED = (
    "relief below the pixels of the elevation model is invented: craters (Trask 1966, Neukum et al. 2001), rocks (Golombek & Rapp 1997), "
    "fractal roughness; the channel 'invented' holds its height in metres"
)


@contextlib.contextmanager
def open_source(source: Path, config: Config, body: Body) -> Iterator[Surface]:
    """The terrain and reflectance to render. Raises LunargrError."""
    opened = open_terrain if config.terrain_only else open_surface
    with opened(source, config.model, config.parameters, body) as surface:
        check_same_body(source, surface.grid.radius, config.body)
        yield surface


def make_light(
    surface: Surface,
    config: Config,
    body: Body,
    relief: tuple[float, float],
    camera_sun: NDArray[np.float64] | None = None,
) -> Light:
    """The light over a surface. Raises LunargrError.

    relief : lowest and highest elevation, m; camera_sun : (3,), body-fixed, m, stands in for a Sun that nobody named
    """
    if camera_sun is not None and all(getattr(config, name) is None for name in SUN):
        sun = Sun(camera_sun, SUN_RADIUS * AU / float(np.linalg.norm(camera_sun)))
    else:
        sun = named_sun(surface, config, body)
    span = relief[1] - relief[0]
    earthshine = _earthshine(surface, config, body, sun, span) if config.earthshine else None
    horizon: Horizon | None = None
    if earthshine is not None and elevation_range(sun, surface.grid)[1] < 0:
        horizon = BelowHorizon()  # by night the Earth shines alone
    else:
        check_sun_is_up(sun, surface.grid, span)
        horizon = SunHorizon(surface.elevation, surface.grid, sun, span) if config.shadows else None
    bounce = Bounce(surface, sun, horizon) if config.bounce else None
    extensions: list = []
    if config.extend:
        from stages.effects import load_extension

        # the diagnosed images are not this one: their own values must not be taken for it
        extensions = load_extension(Path(config.extend), ["rendered"])
    position = None
    if config.position is not None:
        position = place(*_three(config.position, "`position`"), surface.grid.radius)
    return Light(sun, horizon, position, extensions, earthshine, bounce)


def _earthshine(surface: Surface, config: Config, body: Body, sun: Sun, relief: float) -> Earthshine:
    """The Earth's light over a surface of the Moon. relief : m, highest above lowest point. Raises LunargrError."""
    if body.name != "moon":
        raise ConfigError(f"`earthshine`: expected the Moon, which alone the Earth lights, found `body` {body.name}.")
    grid = surface.grid
    if config.earth_azimuth_deg is not None and config.earth_elevation_deg is not None:
        if not -90.0 <= config.earth_elevation_deg <= 90.0:
            raise GeometryError(
                f"`earth_elevation_deg`: expected degrees in -90..90, found {config.earth_elevation_deg:g}."
            )
        position = place_over(grid, config.earth_azimuth_deg, config.earth_elevation_deg, EARTH_DISTANCE)
    elif config.time is not None:
        from stages.physics.bodies.ephemeris import earth_position

        position = earth_position(config.time)
    else:
        raise ConfigError(
            "`earthshine`: expected `time`, or `earth_azimuth_deg` and `earth_elevation_deg`; found neither."
        )
    earthshine = Earthshine.over(surface, sun, position, relief, config.shadows)
    check_sun_is_up(earthshine.disc, grid, relief, "Earth")
    return earthshine


def named_sun(surface: Surface, config: Config, body: Body) -> Sun:
    """The Sun from its time or its direction. Raises LunargrError."""
    if config.time is not None and config.body is None and abs(body.radius - surface.grid.radius) > 0.005 * body.radius:
        raise ConfigError(
            f"`time`: expected `body` beside it, since {surface.path} (radius {surface.grid.radius:g} m) does not show the Moon."
        )
    return find_sun(
        surface.grid,
        Body(body.name, surface.grid.radius),
        azimuth_deg=config.sun_azimuth_deg,
        elevation_deg=config.sun_elevation_deg,
        subsolar_longitude_deg=config.subsolar_longitude_deg,
        subsolar_latitude_deg=config.subsolar_latitude_deg,
        time=config.time,
        distance_au=config.solar_distance_au,
    )


def _three(values: Sequence[float], option: str) -> tuple[float, float, float]:
    if len(values) != 3:
        raise ConfigError(
            f"{option}: expected LON,LAT,ALT (degrees, degrees, metres above the sphere), found {len(values)} numbers."
        )
    return values[0], values[1], values[2]


def find_camera(surface: Surface, config: Config) -> Camera:
    """The camera of a view: a model from a file, or a pinhole at a place. Raises LunargrError."""
    camera = _camera(surface, config)
    if camera.lines * camera.samples > LARGEST_VIEW:
        raise ConfigError(
            f"{config.camera or '`size_px`'}: expected a view of at most {LARGEST_VIEW:,} pixels, found "
            f"{camera.samples} x {camera.lines}; render it in smaller pieces."
        )
    return camera


def _camera(surface: Surface, config: Config) -> Camera:
    """A model from a file, with its own pose or, where a position is given, with that pose; or a pinhole from its field of view."""
    model = open_camera_for(Path(config.camera), surface.grid.radius) if config.camera else None
    if model is not None and config.position is None:
        return model
    grid = surface.grid
    lon, lat, altitude = _three(config.position or (), "`position`")
    position = place(lon, lat, altitude, grid.radius)
    if config.quaternion is not None:
        rotation = rotation_from_quaternion(config.quaternion)
    else:
        target = config.look_at if config.look_at is not None else (lon, lat)
        if len(target) not in (2, 3):
            raise ConfigError(f"`look_at`: expected LON,LAT or LON,LAT,ALT, found {len(target)} numbers.")
        height = (
            target[2]
            if len(target) == 3 and math.isfinite(target[2])
            else ground_height(surface, target[0], target[1], 0.0)
        )
        rotation = look_at(position, place(target[0], target[1], height, grid.radius), config.roll_deg)
    if model is not None:
        if not isinstance(model, Pinhole):
            raise ConfigError(
                f"{config.camera}: expected a pinhole camera for the poses of a trajectory, found a {model.kind} camera."
            )
        return replace(model, centre=position, rotation=rotation)
    return pinhole_view(position, rotation, config.fov_deg, config.size_px, grid.radius)


def camera_sun(camera: Camera) -> NDArray[np.float64] | None:
    """(3,) body-fixed, m, the Sun that a camera model brings; None where it brings none."""
    known = camera.sun_position(np.array([camera.lines / 2]))
    return None if known is None else known[0]


def camera_place(camera: Camera) -> NDArray[np.float64]:
    """(3,) body-fixed, m; of a line-scan camera while it takes its middle line."""
    return camera.position(np.array([camera.lines / 2]))[0]


def metadata(surface: Surface, config: Config, light: Light) -> dict[str, object]:
    """The attributes of a rendered file: source, model, Sun, options, and the record of the run."""
    facts = {k: v for k, v in asdict(config).items() if v not in (None, {}, False) and k != "shard"}
    invented: dict[str, object] = {} if config.detail is None else {"invented": INVENTED}
    return invented | {
        "source": surface.path.name,
        "model": surface.model.name,
        "quantity": QUANTITIES[surface.image_units],
        "sun_position_mcmf": " ".join(f"{v:.6e}" for v in light.sun.position),
        "config": " ".join(f"{k}={v}" for k, v in sorted(facts.items())),
        "record": raster_record("render", facts, inputs(surface.path, config)),
    }
