"""Many views of one map: what stays the same between them is read and computed once."""

from __future__ import annotations

import contextlib
import math
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import ConfigError, GeometryError
from schemas.files.user_files import check_keys
from stages.common.arrays import Floats, Floats32
from stages.common.memory import keep_freed_memory
from stages.physics.bodies.ephemeris import AU
from stages.physics.bodies.spheres import find_body
from stages.physics.cameras import Camera, camera_from_document
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.detector import read_sensor
from stages.physics.detector.readout import photograph
from stages.physics.relief.detail import Detail
from stages.physics.terrain.shading import BACKPLANES, Light
from stages.render.chart import axes_about
from stages.render.config import CAMERA, RATES, SUN, Config, check
from stages.render.extended import apply_sensor
from stages.render.grounds import Grounds
from stages.render.motion import set_in_motion
from stages.render.perspective import render_view
from stages.render.scene import Scene, make_scene
from stages.render.setup import camera_place, camera_sun, find_camera, make_light, named_sun, open_source
from stages.render.sight import no_ground

MOST_SUNS = 4  # whose horizons are kept
PLANES = ("image", *BACKPLANES, "invented")  # of a frame


@dataclass(frozen=True)
class Frame:
    """One view. Arrays are (lines, samples) float32; where there is no ground, all but ``image`` are NaN.

    image : I/F, mean over each pixel; NaN where the map is unknown, 0 in space
    incidence_deg, emission_deg, phase_deg : degree; shadow : hidden share of the Sun's disc; depth : m along the ray
    longitude_deg, latitude_deg : degree, of the ground at the pixel's centre
    invented : m that ``detail`` adds to the map's heights
    camera : as :meth:`Renderer.view` was given it; where it moves, all but ``dn`` are of the middle of the exposure; dn : uint16, of the sensor, None without one
    """

    camera: Camera
    image: Floats32
    incidence_deg: Floats32
    emission_deg: Floats32
    phase_deg: Floats32
    shadow: Floats32
    depth: Floats32
    longitude_deg: Floats32
    latitude_deg: Floats32
    invented: Floats32
    dn: NDArray[np.uint16] | None = None


class Renderer:
    """A map, its terrain's horizons and its pyramids, kept open for views through cameras. Close it, or use it in a ``with``.

    source : svbrdf.h5, or scene.h5 or a DEM with ``model`` and ``parameters``
    sensor : a preset's name or a JSON file, for ``Frame.dn``
    config, settings : what every view starts from, fields of :class:`Config` such as ``samples`` or ``fov_deg``
    Raises LunargrError.
    """

    def __init__(
        self, source: str | Path, sensor: str | Path | None = None, *, config: Config | None = None, **settings: Any
    ) -> None:
        check_keys(settings, [f.name for f in fields(Config)], "Renderer")
        self.config = replace(Config(view="pinhole") if config is None else config, **settings)
        if sensor is not None:
            self.config = replace(self.config, sensor=str(sensor))
        if config is None:  # a command has checked its own
            check(replace(self.config, position=self.config.position or (0.0, 0.0, 0.0)), drawn_sun=True)
        self.sensor = None if self.config.sensor is None else read_sensor(self.config.sensor)
        keep_freed_memory()  # page faults of new arrays would cost as much as the rays
        self._body = find_body("moon" if self.config.body is None else self.config.body)
        with contextlib.ExitStack() as stack:
            self.surface = stack.enter_context(open_source(Path(source), self.config, self._body))
            self.relief = self.surface.height_range()
            self._open = stack.pop_all()
        detail = None
        if self.config.detail is not None:
            detail = Detail(self.surface.elevation, self.surface.grid, self.config.detail, self.config.rock_abundance)
        self._grounds = Grounds(self.surface, detail)
        self._lights: OrderedDict[str, Light] = OrderedDict()

    def close(self) -> None:
        """Close the map's file."""
        self._open.close()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def view(self, camera: Camera | Mapping[str, Any], sun: Mapping[str, Any] | None = None, seed: int = 0) -> Frame:
        """The view of a camera.

        camera : a camera, the document of one (keys as in a pinhole JSON), or ``position`` (longitude, latitude in degrees,
            metres above the sphere) with any of ``look_at``, ``quaternion``, ``roll_deg``, ``fov_deg``, ``size_px`` of :class:`Config`;
            ``velocity`` and ``spin_deg`` move it while the sensor takes its picture
        sun : ``sun_azimuth_deg`` and ``sun_elevation_deg``, ``subsolar_longitude_deg`` and ``subsolar_latitude_deg``, or ``time``;
            None for that of the settings, or of the camera
        seed : of the sensor's noise
        Raises LunargrError.
        """
        config = self.config
        if sun is not None:
            config = replace(config, **{**dict.fromkeys(SUN), **read_settings(sun, SUN, "sun")})
        if isinstance(camera, Mapping):
            camera = self.camera(camera)
        light = self.light(config, camera)
        _, bands = self.bands(camera, light, config.samples)
        planes = joined(bands)
        if not np.isfinite(planes["depth"]).any():
            raise GeometryError(no_ground(self.surface))
        dn = None if self.sensor is None else self.photograph(planes, light, seed)
        return Frame(camera, **{name: planes[name] for name in PLANES}, dn=dn)

    def photograph(
        self, planes: Mapping[str, Floats32], light: Light, seed: int, view_id: str = ""
    ) -> NDArray[np.uint16]:
        """(lines, samples) DN of the sensor; planes : of :meth:`bands`, I/F; seed, view_id : of the noise"""
        image = planes.get("exposed", planes["image"])
        assert self.sensor is not None
        rng = np.random.default_rng([seed, zlib.crc32(view_id.encode())])
        return photograph(self.sensor, image, float(np.linalg.norm(light.sun.position)) / AU, rng)

    def camera(self, given: Mapping[str, Any]) -> Camera:
        """The camera of a document or of a pose, see :meth:`view`. Raises LunargrError."""
        if "type" in given or "name_model" in given:
            moves = {name: value for name, value in given.items() if name in RATES}
            camera = camera_from_document({k: v for k, v in given.items() if k not in moves}, "camera")
            return self.in_motion(camera, replace(self.config, **read_settings(moves, RATES, "camera")))
        config = replace(self.config, **read_settings(given, CAMERA, "camera"))
        check(config, drawn_sun=True)
        return self.find_camera(config)

    def find_camera(self, config: Config) -> Camera:
        """The camera of a configuration, in motion where that names rates. Raises LunargrError."""
        return self.in_motion(find_camera(self.surface, config), config)

    def in_motion(self, camera: Camera, config: Config) -> Camera:
        """A camera that moves by the rates of a configuration while the sensor takes its picture. Raises ConfigError."""
        given = [name for name in RATES if getattr(config, name) is not None]
        if not given:
            return camera
        if self.sensor is None or not (self.sensor.exposure_s or self.sensor.line_time_s):
            raise ConfigError(f"`{given[0]}`: expected a sensor with 'exposure_s' or 'line_time_s', found none.")
        if not isinstance(camera, Pinhole):
            raise ConfigError(f"`{given[0]}`: expected a pinhole camera, found another, which has its own motion.")
        up = camera.centre / np.linalg.norm(camera.centre)
        velocity = np.asarray(config.velocity or (0.0, 0.0, 0.0)) @ axes_about(up)
        spin = camera.rotation @ np.radians(config.spin_deg or (0.0, 0.0, 0.0))
        return set_in_motion(camera, velocity, spin, self.sensor)

    def light(self, config: Config, camera: Camera | None = None) -> Light:
        """The light that a configuration asks for, seen from the camera; Suns that come back are kept. Raises LunargrError."""
        key = repr([getattr(config, name) for name in SUN])
        own = None if camera is None else camera_sun(camera)
        if own is not None:
            key += own.tobytes().hex()
        light = self._lights.pop(key, None) or make_light(self.surface, config, self._body, self.relief, own)
        self._lights[key] = light
        while len(self._lights) > MOST_SUNS:
            self._lights.popitem(last=False)
        return light if camera is None else replace(light, camera_position=camera_place(camera))

    def sun(self, config: Config) -> Floats:
        """(3,) body-fixed, m, the Sun that a configuration names. Raises LunargrError."""
        return named_sun(self.surface, config, self._body).position

    def bands(
        self, camera: Camera, light: Light, samples: int | None, errors: bool = False
    ) -> tuple[Scene, Iterable[dict[str, Floats32]]]:
        """What a camera sees, and its channels by name in bands of image lines. Raises GeometryError.

        samples : rays per pixel and axis, see :class:`Config`; errors : with ``image_std``
        """
        scene = make_scene(self._grounds, camera, light, self.relief, samples, errors)
        bands: Iterable[dict[str, Floats32]] = render_view(self.surface, camera, light, scene)
        if any(effect.slot == "sensor" for effect in light.extensions):  # these need the whole image
            whole = joined(bands)
            named = [name for name in ("image", "exposed") if name in whole]
            bands = [whole | {name: apply_sensor(whole[name], light, scene.layers[0].ground.grid) for name in named}]
        return scene, bands


def read_settings(values: Mapping[str, Any], names: Sequence[str], where: str) -> dict[str, Any]:
    """Checked fields of :class:`Config` from a caller's or a message's own. Raises InputError for others than ``names``, ConfigError."""
    check_keys(values, names, where)
    return {name: _read(name, value, where) for name, value in values.items()}


def _read(name: str, value: Any, where: str) -> Any:
    if name == "time":
        if isinstance(value, str):
            return value
        raise ConfigError(f"{where}: '{name}': expected a UTC time as text, found {value!r:.60}.")
    many = name in ("position", "look_at", "quaternion", "size_px", *RATES)
    numbers = list(value) if many and isinstance(value, (list, tuple)) else [value]
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in numbers):
        raise ConfigError(f"{where}: '{name}': expected finite numbers, found {value!r:.60}.")
    if name == "size_px" and not (len(numbers) == 2 and all(v == int(v) and v > 0 for v in numbers)):
        raise ConfigError(f"{where}: '{name}': expected [W, H] in pixels, found {value!r:.60}.")
    kind = int if name == "size_px" else float
    return tuple(map(kind, numbers)) if many else float(value)


def joined(bands: Iterable[dict[str, Floats32]]) -> dict[str, Floats32]:
    """All lines at once, each (lines, samples)."""
    parts = list(bands)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
