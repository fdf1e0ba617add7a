"""What several artefacts share: axes, places, the table of images, and the bounds of values."""

from __future__ import annotations

from typing import Any

from schemas.declaration import STRING, Attribute, Variable

SPLITS = (("train", 0), ("validation", 1), ("test", 2))

VALIDITY = (("invalid", 0), ("valid", 1))

UNITS = (("iof", 0), ("dn", 1))

SMALLEST_GSD, LARGEST_GSD = 1e-4, 1e6  # m

BODY_RADII = (100.0, 1e10)  # m: from Bennu to what is flat in any crop

HEIGHTS = (-1e8, 1e8)  # m

LARGEST_COUNT = 2**31 - 1

GRID = (
    Variable("y", ("y",), "f8", "m", "grid northing of the pixel centre; rows run south", finite=True),
    Variable("x", ("x",), "f8", "m", "grid easting of the pixel centre", finite=True),
)

PLACE = (
    Attribute("gsd_m", "ground sample distance of the grid, m", True, "number", SMALLEST_GSD, LARGEST_GSD),
    Attribute("body_radius_m", "radius of the reference sphere, m", True, "number", *BODY_RADII),
)

FRAMES = (
    Variable("image_id", ("frame",), STRING, "", "name of the source image"),
    Variable(
        "solar_distance_au", ("frame",), "f8", "au", "distance of the Sun", required=False, minimum=0.05, maximum=100.0
    ),
)


def angle(name: str, dim: str, limit: float, description: str) -> Variable:
    """A finite angle within +-``limit`` degrees along one dimension."""
    return Variable(name, (dim,), "f8", "degree", description, minimum=-limit, maximum=limit, finite=True)


def crop_map(name: str, dtype: str, unit: str, description: str, **more: Any) -> Variable:
    """A value for every pixel of every crop."""
    return Variable(name, ("pair", "y", "x"), dtype, unit, description, **more)


def grid_map(name: str, dtype: str, unit: str, description: str, of: str = "", **more: Any) -> Variable:
    """A value for every pixel of a map; ``of`` names a dimension that such maps are stacked along."""
    first, depth = ((of,), (1,)) if of else ((), ())
    chunks = (*depth, 256, 256)
    return Variable(name, (*first, "y", "x"), dtype, unit, description, chunks=chunks, georeferenced=True, **more)


FRAME_TABLE = FRAMES + (
    Variable("path", ("frame",), STRING, "", "image file, relative to this artefact where possible"),
    Variable("camera", ("frame",), STRING, "", "camera model file, empty for map-projected images"),
    Variable("start_time", ("frame",), STRING, "", "UTC"),
    Variable("units", ("frame",), "u1", "1", "radiometric units of the image", flags=UNITS),
    angle("subsolar_longitude_deg", "frame", 720.0, "east longitude of the sub-solar point"),
    angle("subsolar_latitude_deg", "frame", 90.0, "latitude of the sub-solar point"),
    angle("spacecraft_longitude_deg", "frame", 720.0, "east longitude below the camera"),
    angle("spacecraft_latitude_deg", "frame", 90.0, "latitude below the camera"),
    Variable(
        "spacecraft_altitude_m",
        ("frame",),
        "f8",
        "m",
        "camera height above the reference sphere",
        minimum=1.0,
        maximum=1e10,
        finite=True,
    ),
    Variable("sha256", ("frame",), STRING, "", "SHA-256 of the image file when it was ingested", required=False),
    Variable("camera_sha256", ("frame",), STRING, "", "SHA-256 of the camera model file, or empty", required=False),
)

PAIR_PLACE = (
    angle("longitude_deg", "pair", 720.0, "east longitude of the crop centre"),
    angle("latitude_deg", "pair", 90.0, "planetocentric latitude of the crop centre"),
    Variable(
        "row",
        ("pair",),
        "i4",
        "1",
        "row of the crop centre on the scene grid: the crop spans row - size/2 .. row + size/2 - 1",
    ),
    Variable("col", ("pair",), "i4", "1", "column of the crop centre on the scene grid"),
    Variable("image_index", ("pair",), "i4", "1", "index into the frame dimension", index_of="frame"),
    Variable("site", ("pair",), "i4", "1", "pairs with the same site show the same ground, pixel for pixel"),
    Variable("tile", ("pair",), "i4", "1", "ground tile of the geographic split"),
    Variable("split", ("pair",), "u1", "1", "which part of the geographic split", flags=SPLITS),
)

IMAGE_NOISE = Attribute(
    "image_noise",
    "standard deviation of images, I/F, that errors of the maps do not explain; absent where it is not known",
    False,
    "number",
    0.0,
)
