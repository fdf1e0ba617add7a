"""The settings of normalize, and what it says of its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.errors import ConfigError

ANGLES = ("dem", "file")


@dataclass(frozen=True)
class Config:
    """How images are normalised; angles in degrees.

    model, parameters : a reflectance model or a published set, the same everywhere, and values that differ from its own; None:
        the model and maps of svbrdf.h5
    standard_deg : incidence, emission and phase that all pixels are brought to
    max_incidence_deg, max_emission_deg : local angles beyond which a pixel counts as grazing and is masked
    phase_bins_deg : edges of phase bins, each of which gets a mosaic of its own
    angles : 'dem' for those of the terrain, 'file' for those that the table of images names
    level : bring images in I/F to one level where they overlap; images in DN always are
    register : None, or the freest form of displacement that is taken off each image before, as in project
    leave_out : ids of images that must not enter; geotiff : whether mosaics are written as a GeoTIFF as well
    """

    model: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    standard_deg: tuple[float, float, float] = (30.0, 0.0, 30.0)
    max_incidence_deg: float = 80.0
    max_emission_deg: float = 80.0
    phase_bins_deg: tuple[float, ...] = ()
    angles: str = "dem"
    level: bool = False
    register: str | None = None
    leave_out: tuple[str, ...] = ()
    geotiff: bool = True
    shard: tuple[int, int] = (0, 1)


@dataclass(frozen=True)
class Summary:
    """For the lines at the end.

    images : for each its id, gain, offset, relative standard deviation; covered_share : of the map, where a mosaic has values
    mean : of the mosaic; before, after : rms step in log I/F between overlapping images, None where none overlap
    image_units : 'iof' or 'dn'; angles : by plane, mean and rms of the file's angles less those of the terrain, deg, empty
        without a file
    """

    images: tuple[tuple[str, float, float, float], ...]
    covered_share: float
    mean: float
    mean_images: float
    before: float | None
    after: float | None
    image_units: str
    angles: Mapping[str, tuple[float, float]]


def check(config: Config, with_map: bool) -> None:
    """Refuse options that cannot go together. with_map : there is an svbrdf.h5. Raises ConfigError."""
    if with_map == (config.model is not None):
        raise ConfigError(
            "`model`: expected a reflectance model or an svbrdf.h5, "
            f"found {'both' if with_map else 'neither'}; 'lunargr models' lists the models."
        )
    if config.parameters and with_map:
        raise ConfigError("`parameters`: expected together with `model`; svbrdf.h5 holds its own.")
    for name in ("max_incidence_deg", "max_emission_deg"):
        if not 0 < getattr(config, name) <= 90:
            raise ConfigError(f"`{name}`: expected degrees above 0 and up to 90, found {getattr(config, name):g}.")
    if config.angles not in ANGLES:
        raise ConfigError(f"`angles`: expected one of {', '.join(ANGLES)}, found '{config.angles}'.")
    bins = config.phase_bins_deg
    if bins and (len(bins) < 2 or list(bins) != sorted(set(bins)) or bins[0] < 0 or bins[-1] > 180):
        raise ConfigError(
            f"`phase_bins_deg`: expected two or more rising angles in 0..180, found {', '.join(f'{b:g}' for b in bins)}."
        )
