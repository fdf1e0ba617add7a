"""scene.h5 and crops.h5: the ground, its images, and where crops lie."""

from __future__ import annotations

from schemas.artefacts.common import (
    FRAME_TABLE,
    GRID,
    HEIGHTS,
    LARGEST_COUNT,
    PAIR_PLACE,
    PLACE,
    SMALLEST_GSD,
    VALIDITY,
    column,
    grid_map,
)
from schemas.declaration import Attribute, Schema, Variable, declare

SCENE = declare(
    Schema(
        name="scene",
        version=1,
        stage="ingest",
        title="A DEM on a metric grid, its images and the valid ground that they show",
        dims={
            "frame": "source images",
            "y": "grid rows, north to south",
            "x": "grid columns, west to east",
            "window": "row, column, height, width",
        },
        variables=GRID
        + (
            grid_map("elevation", "f4", "m", "height above the reference sphere"),
            grid_map("dem_valid", "u1", "1", "1 = the DEM is valid", flags=VALIDITY, compress=True),
            grid_map(
                "valid",
                "u1",
                "1",
                "1 = both DEM and image are valid",
                flags=VALIDITY,
                compress=True,
                stacked_along="frame",
            ),
            Variable(
                "frame_window",
                ("frame", "window"),
                "i4",
                "1",
                "row, column, height, width of the box that holds the image's valid pixels",
                minimum=0,
            ),
            column("frame", "valid_area_m2", "m2", "valid ground that the image shows", minimum=0.0, finite=True),
        )
        + FRAME_TABLE,
        attributes=PLACE
        + (
            Attribute("crop_px", "crop size, for the split's ground tiles", True, "integer", 2, LARGEST_COUNT),
            Attribute("elevation_source", "the DEM file, relative to this file"),
            Attribute("elevation_low_m", "least elevation, m", False, "number", *HEIGHTS),
            Attribute("elevation_high_m", "largest elevation, m", False, "number", *HEIGHTS),
            Attribute("dem_valid_px", "valid pixels of the DEM", False, "integer", 0),
        ),
        sizes=(("window", 4),),
    )
)

CROPS = declare(
    Schema(
        name="crops",
        version=2,
        stage="sample",
        title="Crop centres with a geographic split; the scene holds their elevations",
        dims={"pair": "one crop of one image", "frame": "source images"},
        variables=PAIR_PLACE + FRAME_TABLE,
        attributes=PLACE
        + (
            Attribute("crop_px", "edge of a crop, px", True, "integer", 2, LARGEST_COUNT),
            Attribute("scene", "the scene artefact, relative to this file"),
            Attribute("scene_sha256", "its SHA-256"),
            Attribute("tile_m", "edge of a ground tile, m", True, "number", SMALLEST_GSD, LARGEST_COUNT),
            Attribute("split_audit", "pairs, images, tiles and ground of each part, as JSON", False, "json list"),
        ),
    )
)
