"""`lunargr render`: images of a reflectance map, or of a DEM with one reflectance, for any Sun and camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import (
    BodyOption,
    Json,
    Overwrite,
    Quiet,
    Resume,
    Seed,
    Shard,
    complete_model,
    configure,
    parse_shard,
    read_list,
    read_parameters,
)
from schemas.errors import ConfigError
from schemas.files.outputs import Output
from stages import render
from stages.common.brightness import NAMES
from stages.render import Config, StereoConfig, Summary

NAME, ORDER = "render", 60
CONVERGENCE = ",".join(f"{edge:g}" for edge in StereoConfig.convergence_deg)


def command(
    source: Annotated[
        Path | None, typer.Argument(metavar="[SVBRDF.h5]", help="Reflectance map from 'lunargr infer'.")
    ] = None,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="NAME.exr writes EXR, PNG and, for ortho views, GeoTIFF; NAME.tif or NAME.png leaves out the EXR. A folder with --trajectory.",
        ),
    ] = Path("render.exr"),
    dem: Annotated[
        Path | None,
        typer.Option(
            "--dem",
            metavar="DEM",
            help="Render this DEM (any GDAL format, or scene.h5) with one reflectance everywhere.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            autocompletion=complete_model,
            help="Reflectance model for --dem; 'lunargr models' lists them.",
        ),
    ] = None,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--parameters",
            metavar="NAME=VALUE,...",
            help="Model parameters for --dem, such as w=0.3,theta_deg=20; the others take their defaults.",
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            metavar="ortho|pinhole",
            help="ortho: the map's own grid (default); pinhole: a camera, as options of a camera imply.",
        ),
    ] = None,
    sun_azimuth_deg: Annotated[
        float | None,
        typer.Option(
            "--sun-azimuth", metavar="DEG", help="Azimuth of the Sun at the map centre, clockwise from north."
        ),
    ] = None,
    sun_elevation_deg: Annotated[
        float | None, typer.Option("--sun-elevation", metavar="DEG", help="Elevation of the Sun at the map centre.")
    ] = None,
    subsolar_longitude_deg: Annotated[
        float | None,
        typer.Option(
            "--subsolar-longitude",
            metavar="DEG",
            help="East longitude of the sub-solar point, instead of azimuth and elevation.",
        ),
    ] = None,
    subsolar_latitude_deg: Annotated[
        float | None, typer.Option("--subsolar-latitude", metavar="DEG", help="Latitude of the sub-solar point.")
    ] = None,
    solar_distance_au: Annotated[
        float | None,
        typer.Option("--solar-distance", metavar="AU", help="Distance of the Sun; sets the penumbra (default: 1)."),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(
            "--time", metavar="UTC", help="Time, instead of a direction of the Sun, such as 2010-11-09T13:06:40."
        ),
    ] = None,
    position: Annotated[
        str | None,
        typer.Option(
            metavar="LON,LAT,ALT",
            help="Camera position: degrees, and metres above the reference sphere. In ortho views: the point from which the ground is seen.",
        ),
    ] = None,
    look_at: Annotated[
        str | None,
        typer.Option(
            "--look-at", metavar="LON,LAT[,ALT]", help="Ground point at the image centre (default: straight down)."
        ),
    ] = None,
    quaternion: Annotated[
        str | None,
        typer.Option(
            metavar="W,X,Y,Z",
            help="Rotation from camera axes (right, down, forward) to body-fixed, instead of --look-at.",
        ),
    ] = None,
    roll_deg: Annotated[
        float | None, typer.Option("--roll", metavar="DEG", help="Turn the camera clockwise about its line of sight.")
    ] = None,
    fov_deg: Annotated[
        float | None,
        typer.Option(
            "--fov", metavar="DEG", help=f"Field of view across the image's width (default: {Config.fov_deg:g})."
        ),
    ] = None,
    size_px: Annotated[
        str | None,
        typer.Option(
            "--size", metavar="W,H", help=f"Image size in pixels (default: {','.join(map(str, Config.size_px))})."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Camera model (pinhole JSON, ALE/CSM ISD, ...) in place of the options above."
        ),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(metavar="N", help="N x N rays per pixel (default: one per DEM pixel and axis, 2 to 8)."),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Table with one view per row (docs/render.md); --output then names a folder."),
    ] = None,
    export: Annotated[
        str | None,
        typer.Option(
            "--export",
            metavar="colmap|nerfstudio",
            help="With --trajectory: also write the views as a COLMAP or Nerfstudio data set.",
        ),
    ] = None,
    stereo: Annotated[
        int | None,
        typer.Option(
            "--stereo", metavar="N", help="Write N stereo pairs with dense correspondences into the folder --output."
        ),
    ] = None,
    altitude: Annotated[
        float | None, typer.Option(metavar="M", help="With --stereo: height of both cameras above the ground.")
    ] = None,
    convergence: Annotated[
        str,
        typer.Option(metavar="LOW,HIGH", help="With --stereo: range of the angle between both lines of sight, deg."),
    ] = CONVERGENCE,
    seed: Seed = StereoConfig.seed,
    extend: Annotated[
        Path | None,
        typer.Option("--extend", metavar="FILE", help="diagnosis.h5: add the effects that it names."),
    ] = None,
    shadows: Annotated[
        bool, typer.Option("--shadows/--no-shadows", help="Cast shadows with the Sun's disc.")
    ] = Config.shadows,
    bounce: Annotated[
        bool, typer.Option("--bounce", help="Add light that sunlit terrain scatters onto other terrain, once.")
    ] = Config.bounce,
    earthshine: Annotated[
        bool,
        typer.Option(
            "--earthshine", help="Add light from the Earth, at --time or from --earth-azimuth and --earth-elevation."
        ),
    ] = Config.earthshine,
    earth_azimuth_deg: Annotated[
        float | None,
        typer.Option(
            "--earth-azimuth", metavar="DEG", help="Azimuth of the Earth at the map centre, clockwise from north."
        ),
    ] = None,
    earth_elevation_deg: Annotated[
        float | None, typer.Option("--earth-elevation", metavar="DEG", help="Elevation of the Earth at the map centre.")
    ] = None,
    backplanes_in_tif: Annotated[
        bool, typer.Option("--backplanes", help="Ortho views: also write the backplanes into the GeoTIFF.")
    ] = Config.backplanes_in_tif,
    png_only: Annotated[
        bool, typer.Option("--png-only", help="With --trajectory: write no EXR files.")
    ] = Config.png_only,
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
    path = source or dem
    if path is None or (source and dem):
        raise ConfigError("render: expected a reflectance map (svbrdf.h5) or --dem DEM, one of the two.")
    if parameters and dem is None:
        raise ConfigError("--parameters: expected together with --dem; an svbrdf.h5 holds its own coefficients.")
    attitude = (look_at, quaternion, roll_deg, fov_deg, size_px)
    modes = [name for name, given in (("--camera", camera), ("--trajectory", trajectory)) if given]
    if view == "ortho" and modes:
        raise ConfigError(f"{modes[0]}: expected without --view ortho; leave one of them out.")
    seen_by_camera = modes or stereo is not None or any(option is not None for option in attitude)
    converted = {
        "view": view or ("pinhole" if seen_by_camera else Config.view),
        "roll_deg": Config.roll_deg if roll_deg is None else roll_deg,
        "fov_deg": Config.fov_deg if fov_deg is None else fov_deg,
        "position": read_list("--position", position, (3,)),
        "look_at": read_list("--look-at", look_at, (2, 3)),
        "quaternion": read_list("--quaternion", quaternion, (4,)),
        "size_px": Config.size_px if size_px is None else _size(size_px),
        "camera": str(camera) if camera else None,
        "parameters": read_parameters(parameters),
        "terrain_only": dem is not None,
        "extend": str(extend) if extend else None,
        "shard": parse_shard(shard),
    }
    config = configure(Config, locals(), **converted)
    console, to = Console(quiet), Output(output, overwrite, resume, json=json_file)
    if stereo is None and altitude is not None:
        raise ConfigError("--altitude: expected together with --stereo; a single view has its height in --position.")
    if stereo is None and convergence != CONVERGENCE:
        raise ConfigError("--convergence: expected together with --stereo; a single view has no second camera.")
    if stereo is not None:
        own = (trajectory, camera, position, look_at, quaternion, roll_deg, shard, resume or None)
        if any(option is not None for option in own):
            raise ConfigError(
                "--stereo: expected without a camera's place and attitude, --trajectory, --shard and --resume; it draws its own."
            )
        low, high = read_list("--convergence", convergence, (2,)) or StereoConfig.convergence_deg
        drawn = StereoConfig(stereo, altitude, (low, high), seed=seed)
        manifest = render.run_stereo(path, to, config, drawn, console.progress)
        console.say(f"{manifest}: {stereo} stereo pairs")
        return
    if trajectory is not None:
        _show(render.run_trajectory(path, trajectory, to, config, console.progress), console)
        return
    if shard is not None or resume:
        raise ConfigError(
            "--shard and --resume: expected together with --trajectory; a single view is one piece of work."
        )
    _show([render.run(path, to, config, console.progress)], console)


def _show(results: list[Summary], console: Console) -> None:
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
