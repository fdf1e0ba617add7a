"""truth.h5: what `lunargr simulate` made, for comparison with what the pipeline finds."""

from __future__ import annotations

from schemas.artefacts.common import column, grid_map, text_column
from schemas.declaration import Attribute, Schema, Variable, declare


def _frame(name: str, unit: str, description: str) -> Variable:
    return column("frame", name, unit, description)


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
            column("y", "y", "m", "grid northing of the pixel centre; rows run south"),
            column("x", "x", "m", "grid easting of the pixel centre"),
            grid_map(
                "elevation", "f4", "m", "true height above the reference sphere, without the DEM's errors and holes"
            ),
            grid_map(
                "coefficients",
                "f4",
                "1",
                "parameters of the truth's reflectance model, by name in coefficient_name",
                stacked_along="coefficient",
            ),
            text_column("coefficient", "coefficient_name", "names of the parameters"),
            grid_map("standard_iof", "f4", "1", "I/F of level ground at incidence 30, emission 0, phase 30 deg"),
            grid_map("log_albedo_geometry", "f4", "1", "ln of the albedo factor that follows the terrain"),
            grid_map("log_albedo_free", "f4", "1", "ln of the albedo factor that does not: rays, patches, texture"),
            text_column("frame", "image_id", "name of the image"),
            text_column("frame", "start_time", "UTC"),
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
            column("crater", "crater_x", "m", "grid easting of the centre"),
            column("crater", "crater_y", "m", "grid northing of the centre"),
            column("crater", "crater_diameter", "m", "rim-to-rim diameter when fresh", "f4"),
            column("crater", "crater_age", "1", "0 = fresh, 1 = worn out: share of its size's lifetime", "f4"),
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
