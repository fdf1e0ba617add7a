"""The artefacts of the pipeline. `lunargr schema NAME`, the writers, the checks and the docs all read this page."""

from __future__ import annotations

from dataclasses import replace

from schemas.declaration import STRING, Attribute, Schema, Variable, declare

SPLITS = (("train", 0), ("validation", 1), ("test", 2))
VALIDITY = (("invalid", 0), ("valid", 1))
UNITS = (("iof", 0), ("dn", 1))
SMALLEST_GSD, LARGEST_GSD = 1e-4, 1e6  # m
BODY_RADII = (100.0, 1e10)  # m: from Bennu to what is flat in any crop
HEIGHTS = (-1e8, 1e8)  # m
LARGEST_COUNT = 2**31 - 1

_GRID = (
    Variable("y", ("y",), "f8", "m", "grid northing of the pixel centre; rows run south", finite=True),
    Variable("x", ("x",), "f8", "m", "grid easting of the pixel centre", finite=True),
)
_PLACE = (
    Attribute("gsd_m", "ground sample distance of the grid, m", True, "number", SMALLEST_GSD, LARGEST_GSD),
    Attribute("body_radius_m", "radius of the reference sphere, m", True, "number", *BODY_RADII),
)
_FRAMES = (
    Variable("image_id", ("frame",), STRING, "", "name of the source image"),
    Variable(
        "solar_distance_au", ("frame",), "f8", "au", "distance of the Sun", required=False, minimum=0.05, maximum=100.0
    ),
)


def _angle(name: str, dim: str, limit: float, description: str) -> Variable:
    return Variable(name, (dim,), "f8", "degree", description, minimum=-limit, maximum=limit, finite=True)


_FRAME_TABLE = _FRAMES + (
    Variable("path", ("frame",), STRING, "", "image file, relative to this artefact where possible"),
    Variable("camera", ("frame",), STRING, "", "camera model file, empty for map-projected images"),
    Variable("start_time", ("frame",), STRING, "", "UTC"),
    Variable("units", ("frame",), "u1", "1", "radiometric units of the image", flags=UNITS),
    _angle("subsolar_longitude_deg", "frame", 720.0, "east longitude of the sub-solar point"),
    _angle("subsolar_latitude_deg", "frame", 90.0, "latitude of the sub-solar point"),
    _angle("spacecraft_longitude_deg", "frame", 720.0, "east longitude below the camera"),
    _angle("spacecraft_latitude_deg", "frame", 90.0, "latitude below the camera"),
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

SCENE = declare(
    Schema(
        name="scene",
        version=1,
        stage="ingest",
        title="A DEM on a metric grid, its images and where crops may be centred",
        dims={
            "frame": "source images",
            "y": "grid rows, north to south",
            "x": "grid columns, west to east",
            "window": "row, column, height, width",
        },
        variables=_GRID
        + (
            Variable(
                "elevation",
                ("y", "x"),
                "f4",
                "m",
                "height above the reference sphere",
                chunks=(256, 256),
                georeferenced=True,
            ),
            Variable(
                "dem_valid",
                ("y", "x"),
                "u1",
                "1",
                "1 = the DEM is valid",
                flags=VALIDITY,
                chunks=(256, 256),
                compress=True,
                georeferenced=True,
            ),
            Variable(
                "valid",
                ("frame", "y", "x"),
                "u1",
                "1",
                "1 = both DEM and image are valid",
                flags=VALIDITY,
                chunks=(1, 256, 256),
                compress=True,
                georeferenced=True,
            ),
            Variable(
                "valid_position",
                ("frame", "y", "x"),
                "u1",
                "1",
                "1 = a crop centred here lies wholly in valid data",
                flags=VALIDITY,
                chunks=(1, 256, 256),
                compress=True,
                georeferenced=True,
            ),
            Variable(
                "frame_window",
                ("frame", "window"),
                "i4",
                "1",
                "row, column, height, width of the box that holds the image's valid pixels",
                minimum=0,
            ),
            Variable(
                "valid_area_m2",
                ("frame",),
                "f8",
                "m2",
                "ground covered by valid positions",
                minimum=0.0,
                finite=True,
            ),
        )
        + _FRAME_TABLE,
        attributes=_PLACE
        + (
            Attribute("crop_px", "crop size that valid_position was eroded for", True, "integer", 2, LARGEST_COUNT),
            Attribute("elevation_source", "name of the DEM file"),
            Attribute("elevation_low_m", "least elevation, m", False, "number", *HEIGHTS),
            Attribute("elevation_high_m", "largest elevation, m", False, "number", *HEIGHTS),
            Attribute("dem_valid_px", "valid pixels of the DEM", False, "integer", 0),
        ),
        sizes=(("window", 4),),
    )
)

_PAIR_PLACE = (
    _angle("longitude_deg", "pair", 720.0, "east longitude of the crop centre"),
    _angle("latitude_deg", "pair", 90.0, "planetocentric latitude of the crop centre"),
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

CROPS = declare(
    Schema(
        name="crops",
        version=1,
        stage="sample",
        title="Crop centres and DEM crops with a geographic split",
        dims={"pair": "one crop of one image", "y": "crop rows", "x": "crop columns", "frame": "source images"},
        variables=(Variable("elevation", ("pair", "y", "x"), "f4", "m", "height above the reference sphere"),)
        + _PAIR_PLACE
        + _FRAME_TABLE,
        attributes=_PLACE
        + (
            Attribute("scene", "the scene artefact, relative to this file"),
            Attribute("scene_sha256", "its SHA-256"),
            Attribute("tile_m", "edge of a ground tile, m", True, "number", SMALLEST_GSD, LARGEST_COUNT),
            Attribute("split_audit", "pairs, images, tiles and ground of each part, as JSON", False, "json list"),
        ),
    )
)


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
            Variable("elevation", ("pair", "y", "x"), "f4", "m", "height above the reference sphere"),
            Variable(
                "image",
                ("pair", "y", "x"),
                "f4",
                "1",
                "orthorectified image: I/F where units = 1",
                unit_choices=("dn",),
            ),
            Variable(
                "valid",
                ("pair", "y", "x"),
                "u1",
                "1",
                "1 = both DEM and image are valid",
                flags=VALIDITY,
                compress=True,
            ),
            Variable(
                "sun_horizon_deg",
                ("pair", "y", "x"),
                "f4",
                "degree",
                "elevation of the terrain horizon in the Sun's azimuth, from the whole DEM",
            ),
            Variable(
                "sky_view",
                ("pair", "y", "x"),
                "f4",
                "1",
                "share of the sky that terrain leaves free, cosine-weighted",
                required=False,
            ),
            Variable(
                "detector_sample",
                ("pair", "y", "x"),
                "f4",
                "px",
                "sample of the camera's image that saw the pixel, first centre at 0",
                required=False,
            ),
            Variable(
                "detector_line",
                ("pair", "y", "x"),
                "f4",
                "px",
                "line of the camera's image that saw the pixel, first centre at 0",
                required=False,
            ),
            Variable(
                "emission_deg",
                ("pair", "y", "x"),
                "f4",
                "degree",
                "between the true ray to the camera and the terrain's normal; camera images only",
                required=False,
            ),
            Variable(
                "phase_deg",
                ("pair", "y", "x"),
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
        + _optional(_PAIR_PLACE, "tile", "row", "col")
        + _FRAMES
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
        attributes=_PLACE,
    )
)

_IMAGE_NOISE = Attribute(
    "image_noise",
    "standard deviation of images, I/F, that errors of the maps do not explain; absent where it is not known",
    False,
    "number",
    0.0,
)

CHECKPOINT = declare(
    Schema(
        name="checkpoint",
        version=1,
        stage="train",
        title="Weights, normalisation and history of a trained network",
        dims={"epoch": "training epochs", "frame": "source images"},
        variables=(
            Variable("train_loss", ("epoch",), "f8", "1", "mean squared error on valid training pixels", minimum=0.0),
            Variable(
                "validation_loss", ("epoch",), "f8", "1", "mean squared error on valid validation pixels", minimum=0.0
            ),
            Variable("epoch_seconds", ("epoch",), "f8", "s", "wall time of the epoch", minimum=0.0),
            Variable("image_id", ("frame",), STRING, "", "name of the source image"),
            Variable("gain", ("frame",), "f8", "1", "measured = gain x I/F + offset; 1 for calibrated images"),
            Variable("offset", ("frame",), "f8", "1", "measured = gain x I/F + offset; 0 for calibrated images"),
        ),
        attributes=(
            Attribute("model", "reflectance model whose coefficients the network predicts"),
            Attribute("coefficients", "JSON list of coefficient names, in channel order", kind="json list"),
            Attribute(
                "maps",
                "JSON list of the coefficients that the network predicts place by place, in channel order",
                kind="json list",
            ),
            Attribute("globals", "JSON: the other coefficients, the same everywhere, by name", kind="json"),
            Attribute(
                "positive",
                "1 = coefficients are kept nearly positive by LeakyReLU, 0 = within their bounds",
                True,
                "integer",
                0,
                1,
            ),
            Attribute(
                "deviations",
                "1 = the network also gives the logarithm of each map's standard deviation",
                True,
                "integer",
                0,
                1,
            ),
            _IMAGE_NOISE,
            Attribute(
                "elevation_scale_m", "std of the crop-centred training elevations, m", True, "number", 1e-6, LARGEST_GSD
            ),
            *_PLACE,
            Attribute("output_scale", "factor of the network's raw output", True, "number", 0.0, LARGEST_GSD),
            Attribute("image_units", "units of the training images", choices=("iof", "dn")),
            Attribute(
                "best_epoch", "epoch whose weights are in /weights, the first is 1", True, "integer", 1, LARGEST_COUNT
            ),
        ),
    )
)


def _albedo_map(name: str, dtype: str, description: str) -> Variable:
    chunks = (256, 256)
    return Variable(name, ("y", "x"), dtype, "1", description, required=False, chunks=chunks, georeferenced=True)


def _of_images(name: str, dims: tuple[str, ...], dtype: str, unit: str, description: str) -> Variable:
    return Variable(name, dims, dtype, unit, description, required=False)


# What 'lunargr albedo' adds to a map.
_ALBEDO = (
    _albedo_map("albedo", "f4", "factor on the I/F of the coefficients; 1 where no photograph says otherwise"),
    _albedo_map("albedo_std", "f4", "standard deviation of the albedo"),
    _albedo_map("albedo_images", "u2", "images that the albedo of a pixel was made of"),
    _of_images("albedo_image_id", ("frame",), STRING, "", "name of the image"),
    _of_images("albedo_gain", ("frame",), "f8", "1", "measured = gain x I/F x albedo + offset"),
    _of_images("albedo_offset", ("frame",), "f8", "1", "the same; 0 for calibrated images"),
    _of_images("albedo_subsolar_longitude_deg", ("frame",), "f8", "degree", "east longitude of the sub-solar point"),
    _of_images("albedo_subsolar_latitude_deg", ("frame",), "f8", "degree", "latitude of the sub-solar point"),
    _of_images(
        "albedo_band_px", ("band",), "f8", "px", "structure of the band is about so large, and larger in the last"
    ),
    _of_images("albedo_band_std", ("band",), "f8", "1", "std of log albedo beyond the coefficients, by band"),
    _of_images(
        "albedo_image_std", ("frame", "band"), "f8", "1", "std of each image's own error in log albedo, by band"
    ),
    _of_images("albedo_bin_cos_incidence", ("incidence_bin",), "f8", "1", "middle of the bin"),
    _of_images(
        "albedo_interval_68",
        ("incidence_bin",),
        "f8",
        "1",
        "half-width of the 68 % interval of an unseen image's pixel, in hypot(albedo_std / albedo, median image's own std)",
    ),
    _of_images("albedo_interval_95", ("incidence_bin",), "f8", "1", "the same of the 95 % interval"),
    _of_images(
        "albedo_interval_shadow",
        ("level",),
        "f8",
        "1",
        "half-widths of the 68 and 95 % intervals in shadow, I/F over the sine of the Sun's elevation",
    ),
)

SVBRDF = declare(
    Schema(
        name="svbrdf",
        version=1,
        stage="infer",
        title="Georeferenced maps of reflectance coefficients",
        dims={
            "coefficient": "coefficients of the reflectance model",
            "map": "coefficients that vary by place",
            "y": "grid rows, north to south",
            "x": "grid columns, west to east",
            "frame": "images that the albedo was made of",
            "band": "structure sizes, fine to coarse",
            "incidence_bin": "bins of the cosine of incidence",
            "level": "68 and 95 % intervals",
        },
        variables=_GRID
        + (
            Variable(
                "coefficients_std",
                ("map", "y", "x"),
                "f4",
                "1",
                "standard deviations of single pixels' coefficients, by name in map_name; the other coefficients are the "
                "same everywhere",
                chunks=(1, 256, 256),
                georeferenced=True,
                required=False,
            ),
            Variable("map_name", ("map",), STRING, "", "names of the coefficients that vary by place", required=False),
            Variable(
                "coefficients",
                ("coefficient", "y", "x"),
                "f4",
                "1",
                "coefficients of the reflectance model, by name in coefficient_name",
                chunks=(1, 256, 256),
                georeferenced=True,
            ),
            Variable("coefficient_name", ("coefficient",), STRING, "", "names of the coefficients"),
            Variable(
                "elevation",
                ("y", "x"),
                "f4",
                "m",
                "height above the reference sphere",
                chunks=(256, 256),
                georeferenced=True,
            ),
            Variable(
                "valid",
                ("y", "x"),
                "u1",
                "1",
                "1 = the map holds coefficients here",
                flags=VALIDITY,
                chunks=(256, 256),
                compress=True,
                georeferenced=True,
            ),
        )
        + _ALBEDO,
        attributes=_PLACE
        + (
            Attribute("model", "reflectance model"),
            Attribute("quantity", "what the model gives: I/F"),
            _IMAGE_NOISE,
            Attribute("image_units", "units of the images that the map was trained on: 'iof' or 'dn'", required=False),
        ),
    )
)

EVALUATION = declare(
    Schema(
        name="evaluation",
        version=1,
        stage="evaluate",
        title="Measured against rendered crops of one split, for every compared model",
        dims={
            "model": "compared models",
            "run": "training runs of the learned model",
            "pair": "crops of the split",
            "y": "crop rows",
            "x": "crop columns",
        },
        variables=(
            Variable("model_name", ("model",), STRING, "", "names of the compared models"),
            Variable("pair_index", ("pair",), "i4", "1", "index of the crop in pairs.h5", minimum=0),
            Variable("tile", ("pair",), "i4", "1", "ground tile, the independent unit of the intervals"),
            Variable("valid_pixels", ("pair",), "i4", "1", "pixels that count", minimum=0),
            Variable("mse", ("model", "pair"), "f8", "1", "mean squared error of the crop, mean over training runs"),
            Variable(
                "ssim", ("model", "pair"), "f8", "1", "structural similarity of the crop, mean over training runs"
            ),
            Variable("run_seed", ("run",), "i8", "1", "seed of each training run", required=False),
            Variable(
                "run_mse",
                ("run", "pair"),
                "f8",
                "1",
                "mean squared error of the crop under the learned model of each training run",
                required=False,
            ),
            Variable("measured", ("pair", "y", "x"), "f4", "1", "measured crop"),
            Variable(
                "rendered",
                ("model", "pair", "y", "x"),
                "f4",
                "1",
                "rendered crop, of the first training run",
                required=False,
            ),
        ),
        attributes=(
            Attribute("split", "which split was evaluated"),
            Attribute("metrics", "the table as JSON", kind="json"),
        ),
    )
)

DIAGNOSIS = declare(
    Schema(
        name="diagnosis",
        version=1,
        stage="diagnose",
        title="Named causes of the residual and the extended model that contains them",
        dims={
            "frame": "source images",
            "axis": "east, south",
            "mode": "cosines of line jitter",
            "field_term": "cosines of a frame's response over a crop",
            "column": "detector samples, evenly spaced from the first to the last",
            "site": "sites of the pairs, by their number there",
            "term": "cosines of an albedo pattern, down and across a crop, in the order of the effect's coordinates",
        },
        variables=(
            Variable("image_id", ("frame",), STRING, "", "name of the source image"),
            Variable(
                "image_shift_px",
                ("frame", "axis"),
                "f4",
                "px",
                "misregistration: columns and rows by which the image shows ground further east and south",
                required=False,
            ),
            Variable(
                "line_jitter_px",
                ("frame", "mode"),
                "f4",
                "px",
                "line_jitter: amplitudes of cosines 1..3 over the lines, east, then south",
                required=False,
            ),
            Variable(
                "frame_field",
                ("frame", "field_term"),
                "f4",
                "1",
                "frame_field: amplitudes of low cosines over a crop, relative to the response",
                required=False,
            ),
            Variable("image_gain", ("frame",), "f4", "1", "image_gain: relative gain of the image", required=False),
            Variable(
                "column_response",
                ("column",),
                "f4",
                "1",
                "column_pattern: response over the detector samples first..last, relative to 1",
                required=False,
            ),
            Variable(
                "site_albedo",
                ("site", "term"),
                "f4",
                "1",
                "albedo_map: amplitudes of the cosines at each site, relative to its albedo; 0 for sites not looked at",
                required=False,
            ),
        ),
        attributes=(
            Attribute("report", "the diagnosis as JSON (docs: the output of diagnose)", kind="json"),
            Attribute(
                "extension", "JSON list of the effects of the extended model with their parameters", kind="json list"
            ),
        ),
    )
)
