"""`lunargr render`: images of a reflectance map, or of a DEM with one reflectance, for any Sun and camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lunargr_cli.console import Console
from lunargr_cli.options import (
    BodyOption,
    Json,
    Overwrite,
    Quiet,
    Resume,
    Seed,
    Shard,
    configure,
    make_output,
    parse_shard,
    read_list,
    read_parameters,
)
from lunargr_cli.view_options import (
    CONVERGENCE,
    Altitude,
    BackplanesInTif,
    Bounce,
    Camera,
    Convergence,
    Dem,
    Detail,
    EarthAzimuth,
    EarthElevation,
    Earthshine,
    Export,
    Extend,
    Fov,
    LookAt,
    Model,
    Parameters,
    PngOnly,
    Position,
    Quaternion,
    RenderOutput,
    Rig,
    RockAbundance,
    Roll,
    Samples,
    Sensor,
    Shadows,
    Size,
    SolarDistance,
    Source,
    Spin,
    Stereo,
    SubsolarLatitude,
    SubsolarLongitude,
    SunAzimuth,
    SunElevation,
    Time,
    Trajectory,
    Velocity,
    View,
)
from schemas.errors import ConfigError
from stages import render
from stages.common.brightness import NAMES
from stages.render import Config, StereoConfig, Summary

NAME, ORDER = "render", 60
SMOOTH = 2.0  # image pixels to a DEM pixel, from which on a view looks smooth
Options = Mapping[str, Any]  # of a call, by name


def command(
    source: Source = None,
    output: RenderOutput = Path("render.exr"),
    dem: Dem = None,
    model: Model = None,
    parameters: Parameters = None,
    view: View = None,
    sun_azimuth_deg: SunAzimuth = None,
    sun_elevation_deg: SunElevation = None,
    subsolar_longitude_deg: SubsolarLongitude = None,
    subsolar_latitude_deg: SubsolarLatitude = None,
    solar_distance_au: SolarDistance = None,
    time: Time = None,
    position: Position = None,
    look_at: LookAt = None,
    quaternion: Quaternion = None,
    roll_deg: Roll = None,
    fov_deg: Fov = None,
    size_px: Size = None,
    camera: Camera = None,
    sensor: Sensor = None,
    velocity: Velocity = None,
    spin_deg: Spin = None,
    detail: Detail = None,
    rock_abundance: RockAbundance = Config.rock_abundance,
    samples: Samples = None,
    trajectory: Trajectory = None,
    export: Export = None,
    rig: Rig = None,
    stereo: Stereo = None,
    altitude: Altitude = None,
    convergence: Convergence = CONVERGENCE,
    seed: Seed = Config.seed,
    extend: Extend = None,
    shadows: Shadows = Config.shadows,
    bounce: Bounce = Config.bounce,
    earthshine: Earthshine = Config.earthshine,
    earth_azimuth_deg: EarthAzimuth = None,
    earth_elevation_deg: EarthElevation = None,
    backplanes_in_tif: BackplanesInTif = Config.backplanes_in_tif,
    png_only: PngOnly = Config.png_only,
    body: BodyOption = None,
    shard: Shard = None,
    resume: Resume = False,
    json_file: Json = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Render a reflectance map for any Sun and camera: EXR with backplanes, PNG preview, GeoTIFF.

    \b
    lunargr render svbrdf.h5 --sun-azimuth 90 --sun-elevation 30 -o morning.exr
    lunargr render svbrdf.h5 --view pinhole --position 3.6,25.8,60000 --look-at 3.6,26.1 --fov 15 \\
        --time 1971-07-31T12:00:00 -o oblique.exr
    lunargr render --dem dem.tif --model hapke --parameters w=0.25 --sun-azimuth 90 --sun-elevation 30 -o hapke.exr
    lunargr render svbrdf.h5 --trajectory descent.csv --sun-azimuth 90 --sun-elevation 30 -o views/
    """
    given = dict(locals())
    path = find_source(given)
    config, mode = configure(Config, given, **_converted(given)), _mode(given)
    console, to = Console(quiet), make_output(given)
    if mode == "stereo":
        low, high = read_list("--convergence", convergence, (2,)) or StereoConfig.convergence_deg
        drawn = StereoConfig(stereo or 0, altitude, (low, high), seed=seed)
        manifest = render.run_stereo(path, to, config, drawn, console.progress)
        console.say(f"{manifest}: {stereo} stereo pairs")
    elif trajectory is not None:
        _show(render.run_trajectory(path, trajectory, to, config, console.progress), config, console)
    else:
        _show([render.run(path, to, config, console.progress)], config, console)


def find_source(given: Options) -> Path:
    """The map or DEM. Raises ConfigError."""
    source, dem = given["source"], given["dem"]
    if (source is None) == (dem is None):
        raise ConfigError("expected a reflectance map (svbrdf.h5) or --dem DEM, one of the two.")
    if given["parameters"] and dem is None:
        raise ConfigError("--parameters: expected together with --dem; an svbrdf.h5 holds its own coefficients.")
    return source or dem


def _mode(given: Options) -> str:
    """'view', 'trajectory' or 'stereo'; refuses options of the others. Raises ConfigError."""
    mode = "stereo" if given["stereo"] is not None else "trajectory" if given["trajectory"] else "view"
    if mode == "stereo":
        own = ("trajectory", "camera", "position", "look_at", "quaternion", "roll_deg", "velocity", "spin_deg", "shard")
        if given["resume"] or any(given[name] is not None for name in own):
            raise ConfigError(
                "--stereo: expected without a camera's place and attitude, --trajectory, --shard and --resume; it draws its own."
            )
        if given["rig"] is not None and given["convergence"] != CONVERGENCE:
            raise ConfigError(
                "--convergence: expected without --rig, whose cameras are parallel; leave one of them out."
            )
        return mode
    if given["altitude"] is not None:
        raise ConfigError("--altitude: expected together with --stereo; a single view has its height in --position.")
    if given["convergence"] != CONVERGENCE:
        raise ConfigError("--convergence: expected together with --stereo; a single view has no second camera.")
    if mode == "view" and (given["shard"] is not None or given["resume"]):
        raise ConfigError(
            "--shard and --resume: expected together with --trajectory; a single view is one piece of work."
        )
    return mode


def _converted(given: Options) -> dict[str, Any]:
    """The settings whose options are written in another form, and those that hang on others. Raises ConfigError."""
    modes = [option for option in ("camera", "trajectory") if given[option]]
    if given["view"] == "ortho" and modes:
        raise ConfigError(f"--{modes[0]}: expected without --view ortho; leave one of them out.")
    attitude = (
        "look_at",
        "quaternion",
        "roll_deg",
        "fov_deg",
        "size_px",
        "velocity",
        "spin_deg",
        "sensor",
        "detail",
        "stereo",
    )
    seen_by_camera = modes or any(given[name] is not None for name in attitude)
    implied = "pinhole" if seen_by_camera else Config.view
    return {
        "view": implied if given["view"] is None else given["view"],
        "roll_deg": Config.roll_deg if given["roll_deg"] is None else given["roll_deg"],
        "fov_deg": Config.fov_deg if given["fov_deg"] is None else given["fov_deg"],
        "position": read_list("--position", given["position"], (3,)),
        "look_at": read_list("--look-at", given["look_at"], (2, 3)),
        "quaternion": read_list("--quaternion", given["quaternion"], (4,)),
        "velocity": read_list("--velocity", given["velocity"], (3,)),
        "spin_deg": read_list("--spin", given["spin_deg"], (3,)),
        "size_px": Config.size_px if given["size_px"] is None else _size(given["size_px"]),
        "export": tuple(given["export"].split(",")) if given["export"] else (),
        "camera": str(given["camera"]) if given["camera"] else None,
        "parameters": read_parameters(given["parameters"]),
        "terrain_only": given["dem"] is not None,
        "extend": str(given["extend"]) if given["extend"] else None,
        "shard": parse_shard(given["shard"]),
    }


def _show(results: list[Summary], config: Config, console: Console) -> None:
    """The table of what was rendered."""
    brightness = NAMES[results[0].image_units] if results else NAMES["iof"]
    console.table(
        "rendered",
        ("view", "pixels", "known", f"mean {brightness}", "shadow", "incidence", "rays/px", "files"),
        map(_row, results),
    )
    for r in results:
        if r.clipped:
            share = r.clipped / (r.known_share * r.size_px[0] * r.size_px[1])
            console.say(
                f"{r.view_id}: the model gives {brightness} below 0 in {r.clipped} pixels ({share:.2%}); they are drawn as 0."
            )
    finest = max(results, key=lambda r: r.pixels_per_post if r.pixels_per_post > SMOOTH else 0.0, default=None)
    if finest is not None and finest.pixels_per_post > SMOOTH and config.detail is None:
        console.say(
            f"{finest.view_id}: {finest.pixels_per_post:.0f} image pixels to a DEM pixel; the picture shows no detail between them (--detail invents some)."
        )


def _row(result: Summary) -> tuple[str, ...]:
    size = f"{result.size_px[0]} x {result.size_px[1]}"
    files = " ".join(p.name for p in result.files)
    if result.skipped:
        return result.view_id, size, "-", "-", "-", "-", "-", f"{files} (there already)"
    low, high = result.incidence_deg
    return (
        result.view_id,
        size,
        f"{100 * result.known_share:.1f} %",
        f"{result.mean:.5f}",
        f"{100 * result.shadow_share:.1f} %",
        f"{low:.1f}..{high:.1f} deg",
        str(result.samples**2),
        files,
    )


def _size(text: str) -> tuple[int, int]:
    """'640,480' or '640x480' -> (640, 480). Raises ConfigError."""
    width, _, height = text.replace("x", ",").partition(",")
    if not all(edge.strip().isdecimal() and len(edge.strip()) <= 10 and int(edge) > 0 for edge in (width, height)):
        raise ConfigError(f"--size: expected W,H in pixels, found '{text}'.")
    return int(width), int(height)
