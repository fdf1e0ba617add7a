"""The options of `lunargr render`, some of which `lunargr serve` takes too."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.options import complete_model
from stages.render import Config, StereoConfig

CONVERGENCE = ",".join(f"{edge:g}" for edge in StereoConfig.convergence_deg)

# What is rendered
Source = Annotated[Path | None, typer.Argument(metavar="[SVBRDF.h5]", help="Reflectance map from 'lunargr infer'.")]
RenderOutput = Annotated[
    Path,
    typer.Option(
        "--output",
        "-o",
        help="NAME.exr writes EXR, PNG and, for ortho views, GeoTIFF; NAME.tif and NAME.png no EXR. A folder with --trajectory.",
    ),
]
Dem = Annotated[
    Path | None,
    typer.Option(
        "--dem",
        metavar="DEM",
        help="Render this DEM (any GDAL format, or scene.h5) with one reflectance everywhere.",
    ),
]
Model = Annotated[
    str | None,
    typer.Option(
        "--model",
        autocompletion=complete_model,
        help="Reflectance model for --dem; 'lunargr models' lists them.",
    ),
]
Parameters = Annotated[
    list[str] | None,
    typer.Option(
        "--parameters",
        metavar="NAME=VALUE,...",
        help="Model parameters for --dem, such as w=0.3,theta_deg=20; the others take their defaults.",
    ),
]
Extend = Annotated[
    Path | None,
    typer.Option("--extend", metavar="FILE", help="diagnosis.h5: add the effects that it names."),
]
# The Sun, and other light
SunAzimuth = Annotated[
    float | None,
    typer.Option("--sun-azimuth", metavar="DEG", help="Azimuth of the Sun at the map centre, clockwise from north."),
]
SunElevation = Annotated[
    float | None, typer.Option("--sun-elevation", metavar="DEG", help="Elevation of the Sun at the map centre.")
]
SubsolarLongitude = Annotated[
    float | None,
    typer.Option(
        "--subsolar-longitude",
        metavar="DEG",
        help="East longitude of the sub-solar point, instead of azimuth and elevation.",
    ),
]
SubsolarLatitude = Annotated[
    float | None, typer.Option("--subsolar-latitude", metavar="DEG", help="Latitude of the sub-solar point.")
]
SolarDistance = Annotated[
    float | None,
    typer.Option("--solar-distance", metavar="AU", help="Distance of the Sun; sets the penumbra (default: 1)."),
]
Time = Annotated[
    str | None,
    typer.Option("--time", metavar="UTC", help="Time, instead of a direction of the Sun, such as 2010-11-09T13:06:40."),
]
Shadows = Annotated[bool, typer.Option("--shadows/--no-shadows", help="Cast shadows with the Sun's disc.")]
Bounce = Annotated[
    bool, typer.Option("--bounce", help="Add light that sunlit terrain scatters onto other terrain, once.")
]
Earthshine = Annotated[
    bool,
    typer.Option(
        "--earthshine", help="Add light from the Earth, at --time or from --earth-azimuth and --earth-elevation."
    ),
]
EarthAzimuth = Annotated[
    float | None,
    typer.Option(
        "--earth-azimuth", metavar="DEG", help="Azimuth of the Earth at the map centre, clockwise from north."
    ),
]
EarthElevation = Annotated[
    float | None, typer.Option("--earth-elevation", metavar="DEG", help="Elevation of the Earth at the map centre.")
]
# A camera
View = Annotated[
    str | None,
    typer.Option(
        "--view",
        metavar="ortho|pinhole",
        help="ortho: the map's own grid (default); pinhole: a camera, as options of a camera imply.",
    ),
]
Position = Annotated[
    str | None,
    typer.Option(
        metavar="LON,LAT,ALT",
        help="Camera position: degrees, and metres above the reference sphere. In ortho views: the point from which the ground is seen.",
    ),
]
LookAt = Annotated[
    str | None,
    typer.Option(
        "--look-at", metavar="LON,LAT[,ALT]", help="Ground point at the image centre (default: straight down)."
    ),
]
Quaternion = Annotated[
    str | None,
    typer.Option(
        metavar="W,X,Y,Z",
        help="Rotation from camera axes (right, down, forward) to body-fixed, instead of --look-at.",
    ),
]
Roll = Annotated[
    float | None, typer.Option("--roll", metavar="DEG", help="Turn the camera clockwise about its line of sight.")
]
Fov = Annotated[
    float | None,
    typer.Option("--fov", metavar="DEG", help=f"Field of view across the image's width (default: {Config.fov_deg:g})."),
]
Size = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="W,H", help=f"Image size in pixels (default: {','.join(map(str, Config.size_px))})."
    ),
]
Camera = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Camera model (pinhole JSON, ALE/CSM ISD, ...) in place of the options above."),
]
Sensor = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|NAME",
        help="Camera views: also write DN as NAME_dn.tif, by a sensor JSON or a preset (mardi, mastcam_34).",
    ),
]
Velocity = Annotated[
    str | None,
    typer.Option(
        metavar="E,N,U",
        help="Motion to east, north and up, m/s, while --sensor takes the picture.",
    ),
]
Spin = Annotated[
    str | None,
    typer.Option("--spin", metavar="R,D,F", help="Rotation about the camera's right, down and forward axes, deg/s."),
]
Detail = Annotated[
    int | None,
    typer.Option(
        "--detail",
        metavar="SEED",
        min=0,
        max=2**63 - 1,
        help="Camera views: invent craters, rocks and roughness below the DEM's pixels; the channel 'invented' shows them.",
    ),
]
RockAbundance = Annotated[
    float, typer.Option("--rock-abundance", metavar="SHARE", help="Share of the ground under rocks, with --detail.")
]
Samples = Annotated[
    int | None,
    typer.Option(metavar="N", help="N x N rays per pixel (default: one per DEM pixel and axis, 2 to 8)."),
]
# A map
BackplanesInTif = Annotated[
    bool, typer.Option("--backplanes", help="Ortho views: also write the backplanes into the GeoTIFF.")
]
# A trajectory
Trajectory = Annotated[
    Path | None,
    typer.Option(metavar="CSV", help="Table with one view per row (docs/render.md); --output then names a folder."),
]
Export = Annotated[
    str | None,
    typer.Option(
        "--export",
        metavar="colmap,nerfstudio",
        help="With --trajectory: also write these data sets.",
    ),
]
Rig = Annotated[
    float | None,
    typer.Option(
        "--rig", metavar="M", help="Two parallel cameras this far apart under one Sun, with --trajectory or --stereo."
    ),
]
PngOnly = Annotated[bool, typer.Option("--png-only", help="With --trajectory: write no EXR files.")]
# Stereo pairs
Stereo = Annotated[
    int | None,
    typer.Option(
        "--stereo",
        metavar="N",
        max=100_000,  # names have five digits
        help="Write N stereo pairs with dense correspondences into the folder --output.",
    ),
]
Altitude = Annotated[
    float | None, typer.Option(metavar="M", help="With --stereo: height of both cameras above the ground.")
]
Convergence = Annotated[
    str,
    typer.Option(metavar="LOW,HIGH", help="With --stereo: range of the angle between both lines of sight, deg."),
]
