"""What `lunargr simulate` knows and does not tell the pipeline."""

from __future__ import annotations

from schemas.declaration import STRING, Attribute, Schema, Variable, declare


def _map(name: str, description: str) -> Variable:
    return Variable(name, ("y", "x"), "f4", "1", description, chunks=(256, 256), georeferenced=True)


def _frame(name: str, unit: str, description: str) -> Variable:
    return Variable(name, ("frame",), "f8", unit, description)


TRUTH = declare(
    Schema(
        name="truth",
        version=1,
        stage="simulate",
        title="The truth of a simulated scene: reflectance maps, craters, geometry and planted effects",
        dims={
            "y": "working-grid rows, north to south",
            "x": "working-grid columns, west to east",
            "coefficient": "parameters of the truth's reflectance model",
            "frame": "images",
            "crater": "craters, largest first",
        },
        variables=(
            Variable("y", ("y",), "f8", "m", "grid northing of the pixel centre; rows run south"),
            Variable("x", ("x",), "f8", "m", "grid easting of the pixel centre"),
            Variable(
                "elevation",
                ("y", "x"),
                "f4",
                "m",
                "true height above the reference sphere, without the DEM's errors and holes",
                chunks=(256, 256),
                georeferenced=True,
            ),
            Variable(
                "coefficients",
                ("coefficient", "y", "x"),
                "f4",
                "1",
                "parameters of the truth's reflectance model, by name in coefficient_name",
                chunks=(1, 256, 256),
                georeferenced=True,
            ),
            Variable("coefficient_name", ("coefficient",), STRING, "", "names of the parameters"),
            _map("standard_iof", "I/F of level ground at incidence 30, emission 0, phase 30 deg"),
            _map("log_albedo_geometry", "ln of the albedo factor that follows the terrain"),
            _map("log_albedo_free", "ln of the albedo factor that does not: rays, patches, texture"),
            Variable("image_id", ("frame",), STRING, "", "name of the image"),
            Variable("start_time", ("frame",), STRING, "", "UTC"),
            _frame("subsolar_longitude_deg", "degree", "true east longitude of the sub-solar point"),
            _frame("subsolar_latitude_deg", "degree", "true latitude of the sub-solar point"),
            _frame("solar_distance_au", "au", "distance of the Sun"),
            _frame("incidence_deg", "degree", "of level ground at the scene's centre"),
            _frame("emission_deg", "degree", "of level ground at the scene's centre"),
            _frame("phase_deg", "degree", "at the scene's centre"),
            _frame("sun_azimuth_deg", "degree", "clockwise from north at the scene's centre"),
            _frame("camera_azimuth_deg", "degree", "clockwise from north at the scene's centre"),
            _frame("image_gsd", "m", "pixel size of the image"),
            _frame("gain", "1", "DN = gain x I/F + offset; 1 for calibrated images"),
            _frame("offset", "1", "DN = gain x I/F + offset; 0 for calibrated images"),
            _frame("response", "1", "planted gain error of the image"),
            _frame("shift_east", "m", "where the image truly lies minus where its georeference says, grid east"),
            _frame("shift_north", "m", "the same, grid north"),
            _frame("noise_iof", "1", "standard deviation of the noise at the image's mean signal, I/F"),
            _frame("mean_iof", "1", "mean signal without noise, I/F"),
            Variable("crater_x", ("crater",), "f8", "m", "grid easting of the centre"),
            Variable("crater_y", ("crater",), "f8", "m", "grid northing of the centre"),
            Variable("crater_diameter", ("crater",), "f4", "m", "rim-to-rim diameter when fresh"),
            Variable("crater_age", ("crater",), "f4", "1", "0 = fresh, 1 = worn out: share of its size's lifetime"),
        ),
        attributes=(
            Attribute("gsd_m", "ground sample distance of the working grid, m", True, "number", 0.0),
            Attribute("dem_gsd_m", "ground sample distance of the truth and of the DEM, m", True, "number", 0.0),
            Attribute("body_radius_m", "radius of the reference sphere, m", True, "number", 0.0),
            Attribute("model", "the truth's reflectance model"),
            Attribute("parameters", "its constant parameters as JSON", kind="json"),
            Attribute("hidden", "JSON list of the planted effects with their parameters", kind="json list"),
            Attribute("units", "units of the images: 'iof' or 'dn'"),
        ),
    )
)
