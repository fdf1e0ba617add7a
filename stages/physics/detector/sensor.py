"""A sensor's numbers: a JSON file or a preset, and the exposure that they give."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError, RegistryError

PRESETS = Path(__file__).parent / "presets"
SUN_TEMPERATURE = 5772.0  # K, nominal (IAU 2015, resolution B3)
HC_OVER_K = 0.014387769  # m K, second radiation constant (CODATA 2018)
TWO_C = 2 * 299792458.0  # m/s
LARGEST_KERNEL = 255  # px
Kernel = tuple[tuple[float, ...], ...]
_RADIOMETRY = ("f_number", "pixel_um", "wavelength_nm", "bandwidth_nm", "quantum_efficiency")


@dataclass(frozen=True)
class Exposure:
    """electrons : e- per unit of I/F; seconds : NaN where the sensor's radiometry is not known"""

    electrons: float
    seconds: float


@dataclass(frozen=True)
class Sensor:
    """The keys of a sensor file; those left out do nothing.

    full_well : e-; gain : e-/DN (absent: the full well fills all DN); bits : of a DN; offset_dn : DN without light
    exposure_s : s; auto_level : share of full scale that the image's 99.5th percentile takes (0.7 where neither is given); with both, the
        time is kept and a filter or the gain gives the level
    line_time_s : s from one line's exposure to that of the next (rolling shutter)
    quantum_efficiency, transmission : 0..1, of detector and optics; f_number; pixel_um; wavelength_nm, bandwidth_nm : of the band
    read_noise : e-; dark_signal : e-/s; dsnu : its relative standard deviation from pixel to pixel
    prnu : relative standard deviation of the response from pixel to pixel; column_pattern : rms of smooth waves over the columns
    psf_sigma_px : of a Gaussian, or psf_kernel : (odd, odd) weights by lines and samples, or a file of them (.npy, or text), brought to sum 1
    vignetting : share of the light that the corners lose, growing with the square of the distance
    seed : of the fixed patterns; source : where the numbers come from
    """

    full_well: float
    gain: float | None = None
    bits: int = 12
    offset_dn: float = 0.0
    exposure_s: float | None = None
    auto_level: float | None = None
    quantum_efficiency: float | None = None
    transmission: float = 1.0
    f_number: float | None = None
    pixel_um: float | None = None
    wavelength_nm: float | None = None
    bandwidth_nm: float | None = None
    read_noise: float = 0.0
    dark_signal: float = 0.0
    dsnu: float = 0.0
    prnu: float = 0.0
    column_pattern: float = 0.0
    psf_sigma_px: float = 0.0
    psf_kernel: Kernel | None = None
    line_time_s: float = 0.0
    vignetting: float = 0.0
    seed: int = 0
    source: str = ""

    @property
    def electrons_per_dn(self) -> float:
        """e-/DN"""
        return self.gain or self.full_well / (self.top - self.offset_dn)

    @property
    def top(self) -> int:
        """The largest DN."""
        return 2**self.bits - 1

    @property
    def full_scale(self) -> float:
        """e- at which the full well or the converter ends."""
        return min(self.full_well, (self.top - self.offset_dn) * self.electrons_per_dn)

    def rate(self, distance_au: float) -> float:
        """e-/s per unit of I/F; NaN where a key is missing.

        Focal-plane irradiance of an extended source, pi L t / (4 N^2) (Slater 1980), under a Sun that radiates as a black body
        of 5772 K: within some 10 % of the true spectrum in the visible.
        """
        f_number, pixel, wavelength, bandwidth, efficiency = (getattr(self, name) for name in _RADIOMETRY)
        if None in (f_number, pixel, wavelength, bandwidth, efficiency):
            return math.nan
        wavelength = 1e-9 * wavelength
        photons = TWO_C / wavelength**4 / math.expm1(HC_OVER_K / (wavelength * SUN_TEMPERATURE))  # /s m2 sr m
        from stages.physics.light.sun_disc import SUN_RADIUS  # here: it loads torch

        irradiance = math.pi * photons * (math.sin(SUN_RADIUS) / distance_au) ** 2  # /s m2 m
        optics = self.transmission * efficiency / (4 * f_number**2)
        return irradiance * 1e-9 * bandwidth * (1e-6 * pixel) ** 2 * optics

    def expose(self, level: float, distance_au: float = 1.0) -> Exposure:
        """level : I/F that automatic exposure brings to ``auto_level``"""
        rate = self.rate(distance_au)
        if self.exposure_s is not None and self.auto_level is None:
            return Exposure(rate * self.exposure_s, self.exposure_s)
        share = 0.7 if self.auto_level is None else self.auto_level
        electrons = share * self.full_scale / max(level, 1e-6)
        return Exposure(electrons, electrons / rate if self.exposure_s is None else self.exposure_s)


def preset_names() -> list[str]:
    """The sensors that come with lunargr."""
    return sorted(path.stem for path in PRESETS.glob("*.json"))


def sensor_file(given: str) -> Path | None:
    """The user's own file of a sensor, None for a preset's name. Raises RegistryError for what is neither."""
    if given in preset_names():
        return None
    if Path(given).suffix != ".json" and not Path(given).exists():
        raise RegistryError(f"{RegistryError.unknown('sensor', given, preset_names())} Or name a JSON file.")
    return Path(given)


def read_sensor(given: str) -> Sensor:
    """A preset by name, or a JSON file. Raises InputError, RegistryError."""
    from schemas.files.user_files import check_keys, read_json

    path = sensor_file(given)
    path = path or PRESETS / f"{given}.json"
    values = read_json(path, "a sensor in JSON")
    if not isinstance(values, Mapping):
        raise InputError(f"{path}: expected a JSON object of a sensor, found a {type(values).__name__}; mend it.")
    known = {f.name: f for f in dataclasses.fields(Sensor)}
    check_keys(values, list(known), str(path))
    for name, value in values.items():
        if name != "psf_kernel":
            _check_value(name, value, str(path))
    if "full_well" not in values:
        raise InputError(f"{path}: expected the key 'full_well' (electrons), found none; add it.")
    if "psf_kernel" in values:
        values = {**values, "psf_kernel": _read_kernel(values["psf_kernel"], path)}
    sensor = Sensor(**values)
    _check(sensor, str(path))
    return sensor


def _read_kernel(given: Any, where: Path) -> Kernel:
    """The weights of a point-spread function, in a sensor's file or one beside it. Raises InputError."""
    import numpy as np

    from schemas.files.user_files import check_file

    told = f"{where}: 'psf_kernel'"
    try:
        if isinstance(given, str):
            file = where.parent / given
            check_file(file, "a point-spread function")
            numbers = np.load(file, allow_pickle=False) if file.suffix == ".npy" else np.loadtxt(file, delimiter=None)
            weights = np.asarray(numbers, float)
        else:
            weights = np.array(given, float)
    except (ValueError, TypeError, OSError, EOFError) as error:
        raise InputError(
            f"{told}: expected rows of numbers, found others ({' '.join(str(error).split()):.60})."
        ) from None
    if weights.ndim != 2 or not all(n % 2 == 1 and n <= LARGEST_KERNEL for n in weights.shape):
        raise InputError(
            f"{told}: expected an odd number of rows and columns, {LARGEST_KERNEL} at most, found shape {weights.shape}; mend it."
        )
    total = float(weights.sum())
    if not (np.isfinite(weights).all() and (weights >= 0).all() and total > 0):
        raise InputError(f"{told}: expected weights of at least 0 with a sum above 0, found others; mend it.")
    return tuple(map(tuple, (weights / total).tolist()))


# key -> lowest and highest value
_LIMITS: dict[str, tuple[float, float]] = {
    "full_well": (1, 1e9), "gain": (1e-6, 1e6), "bits": (1, 16), "offset_dn": (0, 65535), "exposure_s": (1e-9, 1e6),
    "auto_level": (1e-3, 10), "quantum_efficiency": (1e-6, 1), "transmission": (1e-6, 1), "f_number": (0.1, 1000),
    "pixel_um": (0.1, 1000), "wavelength_nm": (100, 1e5), "bandwidth_nm": (0.01, 1e5), "read_noise": (0, 1e6),
    "dark_signal": (0, 1e9), "dsnu": (0, 10), "prnu": (0, 0.5), "column_pattern": (0, 0.5), "psf_sigma_px": (0, 50),
    "line_time_s": (0, 10), "vignetting": (0, 1), "seed": (0, 2**63 - 1),
}  # fmt: skip


def _check_value(name: str, value: Any, where: str) -> None:
    if name == "source":
        if not isinstance(value, str):
            raise InputError(f"{where}: 'source': expected text, found {value!r:.60}; mend it.")
        return
    low, high = _LIMITS[name]
    whole = name in ("bits", "seed")
    good = isinstance(value, int if whole else (int, float)) and not isinstance(value, bool)
    if not (good and low <= value <= high):
        kind = "a whole number" if whole else "a number"
        raise InputError(f"{where}: '{name}': expected {kind} in {low:g}..{high:g}, found {value!r:.60}; mend it.")


def _check(sensor: Sensor, where: str) -> None:
    """Refuse keys that do not go together. Raises ConfigError."""
    if sensor.psf_kernel is not None and sensor.psf_sigma_px:
        raise ConfigError(f"{where}: expected 'psf_sigma_px' or 'psf_kernel', found both; keep one.")
    if sensor.offset_dn >= sensor.top:
        raise ConfigError(
            f"{where}: 'offset_dn': expected less than {sensor.top}, found {sensor.offset_dn:g}; mend it."
        )
    missing = [name for name in _RADIOMETRY if getattr(sensor, name) is None]
    metered = sensor.auto_level is not None
    needs = "exposure_s" if sensor.exposure_s is not None and not metered else ""
    if sensor.dark_signal and sensor.exposure_s is None:
        needs = "dark_signal"
    if needs and missing:
        raise ConfigError(
            f"{where}: '{needs}': expected with {', '.join(missing)}, which give the electrons in a second; add them."
        )
    if sensor.dsnu and not sensor.dark_signal:
        raise ConfigError(f"{where}: 'dsnu': expected with 'dark_signal', which it is a share of; add it.")
