"""pairs.h5: crops of terrain with the images of it."""

from __future__ import annotations

from dataclasses import replace

from schemas.artefacts.common import FRAMES, PAIR_PLACE, PLACE, VALIDITY, column, crop_map
from schemas.declaration import Schema, Variable, declare

# Programs that write pairs.h5 themselves may have neither tiles nor a scene's grid.
_CROP_PLACE = tuple(replace(v, required=v.name not in ("tile", "row", "col")) for v in PAIR_PLACE)


def _optional_map(name: str, unit: str, description: str) -> Variable:
    return crop_map(name, "f4", unit, description, required=False)


def _optional(dim: str, name: str, unit: str, description: str) -> Variable:
    return column(dim, name, unit, description, required=False)


_MAPS = (
    crop_map(
        "elevation", "f4", "m", "height above the reference sphere, less reference_elevation where the file has that"
    ),
    crop_map("image", "f4", "1", "orthorectified image: I/F where units = 1", unit_choices=("dn",)),
    crop_map("valid", "u1", "1", "1 = both DEM and image are valid", flags=VALIDITY, compress=True),
    crop_map(
        "sun_horizon_deg", "f4", "degree", "elevation of the terrain horizon in the Sun's azimuth, from the whole DEM"
    ),
    _optional_map("sky_view", "1", "share of the sky that terrain leaves free, cosine-weighted"),
    _optional_map("detector_sample", "px", "sample of the camera's image that saw the pixel, first centre at 0"),
    _optional_map("detector_line", "px", "line of the camera's image that saw the pixel, first centre at 0"),
    _optional_map(
        "emission_deg", "degree", "between the true ray to the camera and the terrain's normal; camera images only"
    ),
    _optional_map("phase_deg", "degree", "between the true ray to the camera and the Sun; camera images only"),
)

_DIRECTIONS = (
    Variable(
        "sun_direction_enu",
        ("pair", "enu"),
        "f8",
        "1",
        "unit vector towards the Sun at the crop centre, along the crop's columns, rows (north) and up",
        unit_vector=True,
    ),
    Variable(
        "camera_position_enu",
        ("pair", "enu"),
        "f8",
        "m",
        "camera position from the crop centre at the crop's mean elevation, same axes",
        finite=True,
    ),
    _optional(
        "pair",
        "reference_elevation",
        "m",
        "height above the reference sphere that the pair's elevations count from",
    ),
    _optional(
        "pair",
        "convergence_deg",
        "degree",
        "true north at the crop centre, clockwise from the crop's up-column direction",
    ),
)

_REGISTRATION = (
    _optional(
        "pair",
        "displacement_col_px",
        "px",
        "registration: how far the image lay to the east at the crop's centre, taken off",
    ),
    _optional("pair", "displacement_row_px", "px", "likewise to the south"),
    _optional(
        "frame",
        "shift_col_px",
        "px",
        "mean of what registration took off, to the east, without relief; NaN = none",
    ),
    _optional("frame", "shift_row_px", "px", "likewise to the south"),
    _optional("frame", "shift_sigma_px", "px", "standard error of that shift"),
    _optional(
        "frame",
        "shift_correlation",
        "1",
        "correlation of image and rendering, small structure only, median over its blocks",
    ),
    _optional("frame", "shift_scatter_px", "px", "robust deviation of a block from it"),
    _optional("frame", "shift_freedom", "1", "parameters per axis: 1 = constant, 3 = linear, more = a smooth field"),
    _optional("frame", "shift_held_out", "1", "share of held-out blocks' squared shifts that it takes away"),
    _optional("frame", "relief_share", "1", "share of the relief displacement, h tan(emission), taken off; 0 = none"),
    _optional("frame", "relief_share_error", "1", "its standard error; NaN = none"),
)

_RESEMBLANCE = (
    _optional(
        "frame", "rendering_correlation", "1", "correlation of the image and its rendering, small structure only"
    ),
    _optional("frame", "rendering_chance", "1", "largest correlation with renderings of other ground, or turned"),
    _optional(
        "frame", "rendering_contrast", "1", "small structure of the image over the rendering's, relative to means"
    ),
    _optional("frame", "image_mean", "1", "mean of the image where it was compared, in its own units"),
)

PAIRS = declare(
    Schema(
        name="pairs",
        version=2,
        still_read=(1,),
        stage="project",
        title="DEM crops and the images orthorectified onto them, with Sun, camera and horizon",
        dims={
            "pair": "one crop of one image",
            "y": "crop rows, north to south",
            "x": "crop columns, west to east",
            "enu": "east, north, up",
            "frame": "source images",
        },
        sizes=(("enu", 3),),
        foreign_writers=True,
        variables=_MAPS + _DIRECTIONS + _CROP_PLACE + FRAMES + _REGISTRATION + _RESEMBLANCE,
        attributes=PLACE,
    )
)
