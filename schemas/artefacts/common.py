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


def column(dim: str, name: str, unit: str, description: str, dtype: str = "f8", **checks: Any) -> Variable:
    """A number for every entry of one dimension. checks : further fields of the Variable"""
    return Variable(name, (dim,), dtype, unit, description, **checks)


def text_column(dim: str, name: str, description: str, required: bool = True) -> Variable:
    """A text for every entry of one dimension."""
    return Variable(name, (dim,), STRING, "", description, required=required)


def angle(dim: str, name: str, limit: float, description: str, **checks: Any) -> Variable:
    """A finite angle within +-``limit`` degrees for every entry of one dimension. checks : as of :func:`column`"""
    return column(dim, name, "degree", description, minimum=-limit, maximum=limit, finite=True, **checks)


def crop_map(name: str, dtype: str, unit: str, description: str, **checks: Any) -> Variable:
    """A value for every pixel of every crop."""
    return Variable(name, ("pair", "y", "x"), dtype, unit, description, **checks)


def grid_map(name: str, dtype: str, unit: str, description: str, stacked_along: str = "", **checks: Any) -> Variable:
    """A value for every pixel of a map, or of each map of a stack along a further dimension."""
    first, depth = ((stacked_along,), (1,)) if stacked_along else ((), ())
    chunks = (*depth, 256, 256)
    return Variable(name, (*first, "y", "x"), dtype, unit, description, chunks=chunks, georeferenced=True, **checks)


GRID = (
    column("y", "y", "m", "grid northing of the pixel centre; rows run south", finite=True),
    column("x", "x", "m", "grid easting of the pixel centre", finite=True),
)

PLACE = (
    Attribute("gsd_m", "ground sample distance of the grid, m", True, "number", SMALLEST_GSD, LARGEST_GSD),
    Attribute("body_radius_m", "radius of the reference sphere, m", True, "number", *BODY_RADII),
)

FRAMES = (
    text_column("frame", "image_id", "name of the source image"),
    column("frame", "solar_distance_au", "au", "distance of the Sun", required=False, minimum=0.05, maximum=100.0),
    column(
        "frame", "wavelength_nm", "nm", "centre of the image's band, NaN where not known", required=False, minimum=0.0
    ),
)

FRAME_TABLE = FRAMES + (
    text_column("frame", "path", "image file, relative to this artefact where possible"),
    text_column("frame", "camera", "camera model file, empty for map-projected images"),
    text_column("frame", "angles", "file of phase, emission and incidence, or empty", required=False),
    text_column("frame", "start_time", "UTC"),
    column("frame", "units", "1", "radiometric units of the image", "u1", flags=UNITS),
    column("frame", "band", "1", "band of the image file, from 1; 0 = its only one", "u2", required=False),
    angle("frame", "subsolar_longitude_deg", 720.0, "east longitude of the sub-solar point"),
    angle("frame", "subsolar_latitude_deg", 90.0, "latitude of the sub-solar point"),
    angle("frame", "spacecraft_longitude_deg", 720.0, "east longitude below the camera"),
    angle("frame", "spacecraft_latitude_deg", 90.0, "latitude below the camera"),
    column(
        "frame",
        "spacecraft_altitude_m",
        "m",
        "camera height above the reference sphere",
        minimum=1.0,
        maximum=1e10,
        finite=True,
    ),
    text_column("frame", "sha256", "SHA-256 of the image file when it was ingested", required=False),
    text_column("frame", "camera_sha256", "SHA-256 of the camera model file, or empty", required=False),
)

_ROW = "row of the crop centre on the scene grid: the crop spans row - size/2 .. row + size/2 - 1"
PAIR_PLACE = (
    angle("pair", "longitude_deg", 720.0, "east longitude of the crop centre"),
    angle("pair", "latitude_deg", 90.0, "planetocentric latitude of the crop centre"),
    column("pair", "row", "1", _ROW, "i4"),
    column("pair", "col", "1", "column of the crop centre on the scene grid", "i4"),
    column("pair", "image_index", "1", "index into the frame dimension", "i4", index_of="frame"),
    column("pair", "site", "1", "pairs with the same site show the same ground, pixel for pixel", "i4"),
    column("pair", "tile", "1", "ground tile of the geographic split", "i4"),
    column("pair", "split", "1", "which part of the geographic split", "u1", flags=SPLITS),
)

LEARNED = "distinct crops of training and validation"  # dimension `place`
LEARNED_GROUND = (
    angle("place", "ground_longitude_deg", 720.0, "east longitude of the crop's centre", required=False),
    angle("place", "ground_latitude_deg", 90.0, "planetocentric latitude of the crop's centre", required=False),
    column("place", "ground_split", "1", "whether for training or validation", "u1", flags=SPLITS[:2], required=False),
)
LEARNED_EDGE = Attribute("ground_edge_m", "edge of these crops, m", False, "number", SMALLEST_GSD, 1e9)

IMAGE_NOISE = Attribute(
    "image_noise",
    "standard deviation of images, I/F, that errors of the maps do not explain; absent where it is not known",
    False,
    "number",
    0.0,
)
