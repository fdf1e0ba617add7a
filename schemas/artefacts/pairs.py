"""pairs.h5: crops of terrain with the images of it."""

from __future__ import annotations

from dataclasses import replace

from schemas.artefacts.common import FRAMES, PAIR_PLACE, PLACE, VALIDITY, crop_map
from schemas.declaration import Schema, Variable, declare


def _optional(variables: tuple[Variable, ...], *names: str) -> tuple[Variable, ...]:
    return tuple(replace(v, required=False) if v.name in names else v for v in variables)


PAIRS = declare(
    Schema(
        name="pairs",
        version=1,
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
        variables=(
            crop_map("elevation", "f4", "m", "height above the reference sphere"),
            crop_map("image", "f4", "1", "orthorectified image: I/F where units = 1", unit_choices=("dn",)),
            crop_map("valid", "u1", "1", "1 = both DEM and image are valid", flags=VALIDITY, compress=True),
            crop_map(
                "sun_horizon_deg",
                "f4",
                "degree",
                "elevation of the terrain horizon in the Sun's azimuth, from the whole DEM",
            ),
            crop_map(
                "sky_view", "f4", "1", "share of the sky that terrain leaves free, cosine-weighted", required=False
            ),
            crop_map(
                "detector_sample",
                "f4",
                "px",
                "sample of the camera's image that saw the pixel, first centre at 0",
                required=False,
            ),
            crop_map(
                "detector_line",
                "f4",
                "px",
                "line of the camera's image that saw the pixel, first centre at 0",
                required=False,
            ),
            crop_map(
                "emission_deg",
                "f4",
                "degree",
                "between the true ray to the camera and the terrain's normal; camera images only",
                required=False,
            ),
            crop_map(
                "phase_deg",
                "f4",
                "degree",
                "between the true ray to the camera and the Sun; camera images only",
                required=False,
            ),
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
            Variable(
                "convergence_deg",
                ("pair",),
                "f8",
                "degree",
                "true north at the crop centre, clockwise from the crop's up-column direction",
                required=False,
            ),
        )
        + _optional(PAIR_PLACE, "tile", "row", "col")
        + FRAMES
        + (
            Variable(
                "displacement_col_px",
                ("pair",),
                "f8",
                "px",
                "registration: how far the image lay to the east at the crop's centre, taken off",
                required=False,
            ),
            Variable("displacement_row_px", ("pair",), "f8", "px", "likewise to the south", required=False),
            Variable(
                "shift_col_px",
                ("frame",),
                "f8",
                "px",
                "mean of what registration took off, to the east, without relief; NaN = none",
                required=False,
            ),
            Variable("shift_row_px", ("frame",), "f8", "px", "likewise to the south", required=False),
            Variable("shift_sigma_px", ("frame",), "f8", "px", "standard error of that shift", required=False),
            Variable(
                "shift_correlation",
                ("frame",),
                "f8",
                "1",
                "correlation of image and rendering, small structure only, median over its blocks",
                required=False,
            ),
            Variable("shift_scatter_px", ("frame",), "f8", "px", "robust deviation of a block from it", required=False),
            Variable(
                "shift_freedom",
                ("frame",),
                "f8",
                "1",
                "parameters per axis: 1 = constant, 3 = linear, more = a smooth field",
                required=False,
            ),
            Variable(
                "shift_held_out",
                ("frame",),
                "f8",
                "1",
                "share of held-out blocks' squared shifts that it takes away",
                required=False,
            ),
            Variable(
                "relief_share",
                ("frame",),
                "f8",
                "1",
                "share of the relief displacement, h tan(emission), taken off; 0 = none",
                required=False,
            ),
            Variable("relief_share_error", ("frame",), "f8", "1", "its standard error; NaN = none", required=False),
        ),
        attributes=PLACE,
    )
)
