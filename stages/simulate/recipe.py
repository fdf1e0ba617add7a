"""The recipe of a scene: every number of the simulation, as a JSON file with the same keys."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError
from stages.physics.detector import Sensor, read_sensor
from stages.simulate.hidden import Hidden, parse_hidden

Range = tuple[float, float]


@dataclass
class Config:
    """A scene. Lengths in metres, angles in degrees (``_deg``); ranges are (low, high).

    The defaults are a mare-highland border like the Taurus-Littrow valley seen by a narrow-angle camera in orbit.
    """

    # place and size
    seed: int = 1
    size_px: int = 1536  # edge of the scene at the working GSD
    gsd: float = 5.0  # the GSD that the pipeline will work at
    dem_gsd: float = 2.5  # the GSD that the truth is made and the DEM is given at
    longitude_deg: float = 30.77
    latitude_deg: float = 20.19
    base_elevation: float = -2600.0

    # terrain
    relief: float = 30.0  # standard deviation of the longest octave of the fractal relief
    relief_wavelength: float = 7000.0
    hurst: float = 0.92
    crater_density: float = 1.0  # of the lunar equilibrium density
    crater_transition: float = 200.0  # diameter below which craters are in equilibrium (a surface of some 3 Gyr)
    crater_largest: float = 1100.0
    boulders_per_km2: float = 40.0
    dem_error: float = 0.05  # white error of the DEM's heights
    dem_holes: int = 3

    # truth reflectance
    model: str = "hapke"
    parameters: dict[str, float] = field(default_factory=dict)  # where they differ from the model's defaults
    albedo_parameter: str = ""  # the parameter that the albedo map multiplies; '' = the model's own
    geometry_contrast: float = 1.0  # strength of what follows the terrain: fresh walls and rims, steep slopes
    free_contrast: float = 1.0  # strength of what does not: rays, patches, texture

    # images
    images: int = 16
    units: str = "iof"
    image_gsd: Range = (2.8, 4.4)
    altitude: Range = (50e3, 100e3)
    oblique_share: float = 0.3
    oblique_deg: Range = (12.0, 35.0)
    incidence_deg: Range = (20.0, 80.0)
    swath: Range = (0.5, 0.9)  # width of the strips, of the scene's edge
    image_holes: int = 1

    # sensor
    psf_sigma_px: float = 0.55  # optics, Gaussian, in image pixels, beside the pixel's own area
    full_well: float = 30000.0  # electrons at twice the image's mean
    read_noise: float = 60.0  # electrons
    sensor: str = ""  # a preset or a JSON file: its DN, in place of the three keys above
    registration_error: float = 0.0  # standard deviation of the planted shift of each image

    # hidden effects, which truth.h5 alone records
    hidden: list[dict[str, Any]] = field(default_factory=lambda: [{"effect": "dark_bias"}])

    def sensor_model(self) -> Sensor | None:
        """The sensor that the recipe names. Raises InputError, RegistryError."""
        return read_sensor(self.sensor) if self.sensor else None

    def hidden_effects(self) -> Hidden:
        """The hidden effects with their parameters."""
        return parse_hidden(self.hidden)

    @property
    def factor(self) -> int:
        """DEM pixels along a working pixel."""
        return max(1, round(self.gsd / self.dem_gsd))

    @property
    def extent(self) -> float:
        """m, of the scene's side"""
        return self.size_px * self.gsd

    @property
    def dem_size(self) -> int:
        """px, of the DEM's side"""
        return self.size_px * self.factor


_POSITIVE = ("gsd", "dem_gsd", "relief_wavelength", "hurst", "crater_transition", "crater_largest", "full_well")
_NOT_NEGATIVE = (
    "relief",
    "crater_density",
    "boulders_per_km2",
    "dem_error",
    "dem_holes",
    "geometry_contrast",
    "free_contrast",
    "image_holes",
    "psf_sigma_px",
    "read_noise",
    "registration_error",
)
LARGEST = 1e6  # of any length in metres or number of electrons
_MOST = {
    "hurst": 2.0,
    "crater_density": 100.0,
    "boulders_per_km2": 1e5,
    "geometry_contrast": 100.0,
    "free_contrast": 100.0,
}
LARGEST_DEM = 32768  # pixels a side: the truth is made in memory
_COUNTS = {
    "size_px": (64, LARGEST_DEM),
    "images": (1, 10000),
    "seed": (0, 2**63 - 1),
    "dem_holes": (0, 10000),
    "image_holes": (0, 10000),
}
_RANGES: dict[str, Range] = {
    "image_gsd": (0.1, 1e4),
    "altitude": (1e3, 1e7),
    "oblique_deg": (0.0, 60.0),
    "incidence_deg": (0.0, 88.0),
    "swath": (0.05, 3.0),
}


def make_config(values: dict[str, Any], where: str = "recipe") -> Config:
    """A checked Config from recipe keys; missing keys take their defaults. Raises ConfigError."""
    fields = {f.name: f for f in dataclasses.fields(Config)}
    for key in values:
        if key not in fields:
            raise ConfigError(f"{where}: unknown key '{key}'; the keys are: {', '.join(fields)}.")
    default = Config()
    clean: dict[str, Any] = {}
    for key, value in values.items():
        like = getattr(default, key)
        try:
            clean[key] = _coerce(value, like)
        except (TypeError, ValueError, OverflowError, AttributeError):
            raise ConfigError(
                f"{where}: '{key}': expected a value like {json.dumps(like)}, found {value!r}; mend it."
            ) from None
    if clean.get("sensor"):
        clean.setdefault("units", "dn")
    config = Config(**clean)
    _check(config, where)
    return config


def _coerce(value: Any, like: Any) -> Any:
    """A recipe's value as the type of the default ``like``. Raises TypeError, ValueError."""
    if isinstance(value, bool):
        raise TypeError
    if isinstance(like, int):
        if isinstance(value, str) or not math.isfinite(value) or int(value) != value:
            raise ValueError
        return int(value)
    if isinstance(like, float):
        number = float(value)
        if not math.isfinite(number):
            raise ValueError
        return number
    if isinstance(like, tuple):
        low, high = (float(v) for v in value)
        return (low, high)
    if isinstance(like, dict):
        return {str(k): float(v) for k, v in value.items()}
    if not isinstance(value, type(like)):  # lists and texts
        raise TypeError
    return value


def _check(config: Config, where: str) -> None:
    for key in (*_POSITIVE, *_NOT_NEGATIVE, "base_elevation"):
        value, most = getattr(config, key), _MOST.get(key, LARGEST)
        _require(abs(value) <= most, where, key, f"at most {most:g}", f"{value:g}")
        _require(value > 0 or key not in _POSITIVE, where, key, "a number above 0", f"{value:g}")
        _require(value >= 0 or key == "base_elevation", where, key, "a number of at least 0", f"{value:g}")
    for key, (low, high) in _RANGES.items():
        first, last = getattr(config, key)
        expected = f"low <= high within {low:g}..{high:g}"
        _require(low <= first <= last <= high, where, key, expected, f"{first:g}, {last:g}")
    for key, (least, most) in _COUNTS.items():
        value = getattr(config, key)
        _require(least <= value <= most, where, key, f"{least} .. {most}", str(value))
    if config.dem_size > LARGEST_DEM:
        raise ConfigError(
            f"{where}: 'size_px': expected at most {LARGEST_DEM // config.factor} pixels at {config.factor} DEM pixels a pixel, "
            f"found {config.size_px}."
        )
    _require(config.units in ("iof", "dn"), where, "units", "'iof' or 'dn'", f"'{config.units}'")
    _require(0 <= config.oblique_share <= 1, where, "oblique_share", "0..1", f"{config.oblique_share:g}")
    if abs(config.latitude_deg) > 89 or abs(config.longitude_deg) > 360:
        raise ConfigError(
            f"{where}: expected a place with |latitude| <= 89, found {config.longitude_deg:g}, {config.latitude_deg:g}; mend it."
        )
    if abs(config.gsd / config.dem_gsd - config.factor) > 1e-9 * config.factor:
        raise ConfigError(
            f"{where}: expected 'gsd' to be a whole multiple of 'dem_gsd', found {config.gsd:g} and {config.dem_gsd:g}; mend it."
        )
    # the Sun climbs no higher than this at the place
    highest = max(0.0, abs(config.latitude_deg) - 1.6)
    if config.incidence_deg[1] < highest + 3:
        raise ConfigError(
            f"{where}: 'incidence_deg': at latitude {config.latitude_deg:g} incidence is never below {highest:.1f} deg, "
            f"found a range up to {config.incidence_deg[1]:g}; raise it or move the scene."
        )
    config.hidden_effects()
    sensor = config.sensor_model()
    if sensor is not None:
        _require(config.units == "dn", where, "units", "'dn' with 'sensor'", f"'{config.units}'")
        _require(sensor.psf_kernel is None, where, "sensor", "optics as 'psf_sigma_px'", "'psf_kernel'")
        _require(sensor.line_time_s == 0, where, "sensor", "one exposure for the image", "'line_time_s'")


def _require(good: bool, where: str, key: str, expected: str, found: str) -> None:
    if not good:
        raise ConfigError(f"{where}: '{key}': expected {expected}, found {found}; mend it.")


def read_recipe(path: Path) -> dict[str, Any]:
    """The keys of a recipe file. Raises InputError."""
    from schemas.files.user_files import read_json  # here: it loads h5py, which the command's help does without

    values = read_json(path, "a recipe in JSON ('lunargr simulate' with `print_recipe` writes one)")
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected a JSON object of recipe keys, found {type(values).__name__}; mend it.")
    return values


def recipe_json(config: Config) -> str:
    """The content of a recipe file."""
    return json.dumps(dataclasses.asdict(config), indent=1)
