"""What to render, what came out, and the files behind one `output`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from schemas.errors import ConfigError
from schemas.later import without
from stages.common.sun_given import sun_given

VIEWS = ("ortho", "pinhole")
EXPORTS = ("colmap", "nerfstudio")
SUN = (
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "subsolar_longitude_deg",
    "subsolar_latitude_deg",
    "solar_distance_au",
    "time",
)
RATES = ("velocity", "spin_deg")  # of a camera that moves
CAMERA = (
    "position",
    "look_at",
    "quaternion",
    "roll_deg",
    "fov_deg",
    "size_px",
    *RATES,
)  # of a view, in place of a camera model

# What each kind of view does not look at: set all the same, it would be ignored.
_ATTITUDE = ("look_at", "quaternion", "roll_deg", "fov_deg", "size_px")
IGNORED = {
    "`view` ortho": (*_ATTITUDE, *RATES, "samples", "sensor", "detail", "rock_abundance", "png_only", "rig"),
    "`camera`": (*_ATTITUDE, "position", "backplanes_in_tif", "png_only", "rig"),
    "a trajectory": ("position", "quaternion", "roll_deg", *RATES, "backplanes_in_tif"),
    "`camera` in a trajectory": ("fov_deg", "size_px"),
    "`view` pinhole": ("backplanes_in_tif", "png_only", "rig"),
    "`quaternion`": ("look_at", "roll_deg"),
}

LARGEST_RIG = 1e6  # m
LARGEST_VIEW = 1 << 30  # pixels; an EXR of them has 4 GB a channel


@dataclass(frozen=True)
class Config:
    """What to render. The Sun by exactly one of its three descriptions; angles in degrees.

    position : longitude, latitude, metres above the sphere; in an ortho view the place that light is reflected to
    look_at : longitude, latitude (and metres above the sphere; the ground's own height where that is absent)
    quaternion : w, x, y, z, camera axes (right, down, forward) to body-fixed, instead of look_at
    camera : path of a camera model (JSON), instead of position, attitude, fov and size; of a trajectory instead of fov and size
    velocity : m/s towards east, north and up; spin_deg : deg/s about the camera's axes: for a sensor's exposure and lines
    sensor : a preset's name or a JSON file: DN beside the I/F, with noise drawn from ``seed`` and the view's name
    detail : seed of invented relief where a camera view has several pixels to one of the map; None for none
    rock_abundance : share of the ground that rocks cover, in invented relief
    samples : rays per pixel and axis (None: as many as the pixel's footprint asks for)
    model, parameters : a reflectance that is the same everywhere, where the source holds none
    rig : m from a left camera to a right one beside it: two views of each row of a trajectory, or how stereo pairs are drawn
    export : with a trajectory: also data sets of its views, of EXPORTS; png_only : no EXR; shard : every n-th view
    bounce : light that sunlit terrain throws on other terrain, once, between diffuse facets
    earthshine : the Earth's light, from its place at ``time``, or at an azimuth and elevation over the map's middle
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
    velocity: tuple[float, ...] | None = None
    spin_deg: tuple[float, ...] | None = None
    camera: str | None = None
    sensor: str | None = None
    seed: int = 0
    detail: int | None = None
    rock_abundance: float = 0.01
    samples: int | None = None
    shadows: bool = True
    bounce: bool = False
    earthshine: bool = False
    earth_azimuth_deg: float | None = None
    earth_elevation_deg: float | None = None
    model: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    terrain_only: bool = False
    extend: str | None = None
    body: str | None = None
    backplanes_in_tif: bool = False
    rig: float | None = None
    export: tuple[str, ...] = ()
    png_only: bool = False
    shard: tuple[int, int] = (0, 1)


@dataclass(frozen=True)
class StereoConfig:
    """How pairs are drawn; ranges are uniform.

    altitude : m above the ground (None: an eighth of the map's shorter side in a picture)
    convergence_deg : between both lines of sight at the ground; off_nadir_deg : of their mean; roll_deg : to either side
    sun_elevation_deg : of both Suns, each with any azimuth
    """

    count: int
    altitude: float | None = None
    convergence_deg: tuple[float, float] = (4.0, 30.0)
    off_nadir_deg: float = 8.0
    roll_deg: float = 20.0
    sun_elevation_deg: tuple[float, float] = (12.0, 65.0)
    seed: int = 0


@dataclass(frozen=True)
class Summary:
    """What was rendered, for the line at the end.

    size_px : samples, lines; known_share, shadow_share : of the pixels, 0..1; mean : I/F; samples : rays per pixel and axis
    skipped : the view was there already, and was not looked at
    clipped : pixels where the model's I/F was below 0 and is drawn as 0
    pixels_per_post : image pixels along one pixel of the map, in the middle of a camera view
    image_units : of the images that the map was learned from, 'iof' or 'dn'
    """

    view_id: str
    files: tuple[Path, ...]
    size_px: tuple[int, int]
    known_share: float = math.nan
    mean: float = math.nan
    shadow_share: float = math.nan
    incidence_deg: tuple[float, float] = (math.nan, math.nan)
    samples: int = 0
    skipped: bool = False
    clipped: int = 0
    pixels_per_post: float = math.nan
    image_units: str = "iof"


def check(config: Config, trajectory: bool = False, drawn_sun: bool = False) -> None:
    """Refuse options that cannot go together. drawn_sun : the Sun is none of them. Raises ConfigError."""
    if config.model is not None:
        with without("torch"):
            from stages.physics.photometry import get_model

            get_model(config.model)
    if config.view not in VIEWS:
        raise ConfigError(f"`view`: expected one of {', '.join(VIEWS)}; found '{config.view}'.")
    if config.samples is not None and not 1 <= config.samples <= 32:
        raise ConfigError(f"`samples`: expected rays per pixel and axis in 1..32, found {config.samples}.")
    if config.solar_distance_au is not None and not 0.05 <= config.solar_distance_au <= 100:
        raise ConfigError(f"`solar_distance_au`: expected 0.05 .. 100 au, found {config.solar_distance_au:g}.")
    if not 0 < config.size_px[0] * config.size_px[1] <= LARGEST_VIEW:
        raise ConfigError(
            f"`size_px`: expected a view of at most {LARGEST_VIEW:,} pixels, found {config.size_px[0]} x {config.size_px[1]}."
        )
    angles = (config.earth_azimuth_deg, config.earth_elevation_deg)
    if any(v is not None for v in angles) and (None in angles or not config.earthshine):
        raise ConfigError("the Earth: expected `earthshine` with both `earth_azimuth_deg` and `earth_elevation_deg`.")
    if config.export and not trajectory:
        raise ConfigError("`export`: expected together with `trajectory`; a single view makes no data set.")
    if not (trajectory or config.camera or drawn_sun):  # rows and camera models may know their Sun
        sun_given(*(getattr(config, name) for name in SUN if name != "solar_distance_au"))
    for kind in config.export:
        if kind not in EXPORTS or config.export.count(kind) > 1:
            raise ConfigError(f"`export`: expected any of {', '.join(EXPORTS)}, each once; found '{kind}'.")
    kind = "a trajectory" if trajectory else "`camera`" if config.camera else f"`view` {config.view}"
    refuse_ignored(config, kind)
    check_rig(config)
    check_detail(config)
    for name in RATES:
        rate = getattr(config, name)
        if rate is not None and config.sensor is None:
            raise ConfigError(f"`{name}`: expected with a `sensor`, whose exposure or lines it smears; found none.")
        if rate is not None and len(rate) != 3:
            raise ConfigError(f"`{name}`: expected three numbers, found {len(rate)}.")
    if kind != "`view` pinhole":
        return
    if config.position is None:
        raise ConfigError("`view` pinhole: expected `position` LON,LAT,ALT or `camera` FILE; found neither.")
    if config.quaternion is not None:
        refuse_ignored(config, "`quaternion`")


def check_rig(config: Config) -> None:
    """Raises ConfigError for a baseline that cannot be."""
    if config.rig is not None and not 0 < config.rig < LARGEST_RIG:
        raise ConfigError(f"`rig`: expected metres between both cameras, found {config.rig:g}.")


def check_detail(config: Config) -> None:
    """Raises ConfigError for invented relief that cannot be."""
    if not 1e-4 <= config.rock_abundance <= 0.5:
        raise ConfigError(f"`rock_abundance`: expected a share in 0.0001..0.5, found {config.rock_abundance:g}.")
    if config.detail is None:
        if config.rock_abundance != Config.rock_abundance:
            raise ConfigError("`rock_abundance`: expected with `detail`, which draws the rocks; found none.")
        return
    for name in ("extend", "bounce", "earthshine"):
        if getattr(config, name):
            raise ConfigError(f"`{name}`: expected without `detail`, which it does not know; leave one of them out.")


def check_trajectory(config: Config) -> None:
    """Refuse options that cannot go together in a trajectory. Raises ConfigError."""
    check(replace(config, view="pinhole"), trajectory=True)
    if config.camera:
        refuse_ignored(config, "`camera` in a trajectory")
    if config.export and config.shard[1] > 1:
        raise ConfigError(
            "`export`: expected without `shard`; render the shards, then export with `resume` and no `shard`."
        )
    if config.export and config.png_only:
        raise ConfigError("`export`: expected EXR files, which hold the depths; drop `png_only`.")


def refuse_ignored(config: Config, kind: str) -> None:
    """Refuse what is set but has no meaning with a kind of view of IGNORED. Raises ConfigError."""
    default = Config()
    for name in IGNORED[kind]:
        if getattr(config, name) != getattr(default, name):
            raise ConfigError(f"`{name}`: expected without {kind}, which does not use it; leave one of them out.")
