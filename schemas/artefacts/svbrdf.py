"""svbrdf.h5: maps of reflectance."""

from __future__ import annotations

from schemas.artefacts.common import (
    GRID,
    IMAGE_NOISE,
    LEARNED,
    LEARNED_EDGE,
    LEARNED_GROUND,
    PLACE,
    VALIDITY,
    column,
    grid_map,
    text_column,
)
from schemas.declaration import Attribute, Schema, Variable, declare


def _albedo_map(name: str, dtype: str, description: str) -> Variable:
    return grid_map(name, dtype, "1", description, required=False)


def _albedo_column(dim: str, name: str, unit: str, description: str) -> Variable:
    return column(dim, name, unit, description, required=False)


_INTERVAL = (
    "half-width of the 68 % interval of an unseen image's pixel, in hypot(albedo_std / albedo, median image's own std)"
)
_SHADOW = "half-widths of the 68 and 95 % intervals in shadow, I/F over the sine of the Sun's elevation"
_ALBEDO = (
    _albedo_map("albedo", "f4", "factor on the I/F of the coefficients; 1 where no photograph says otherwise"),
    _albedo_map("albedo_std", "f4", "standard deviation of the albedo"),
    _albedo_map("albedo_images", "u2", "images that the albedo of a pixel was made of"),
    text_column("frame", "albedo_image_id", "name of the image", required=False),
    _albedo_column("frame", "albedo_gain", "1", "measured = gain x I/F x albedo + offset"),
    _albedo_column("frame", "albedo_offset", "1", "the same; 0 for calibrated images"),
    _albedo_column("frame", "albedo_subsolar_longitude_deg", "degree", "east longitude of the sub-solar point"),
    _albedo_column("frame", "albedo_subsolar_latitude_deg", "degree", "latitude of the sub-solar point"),
    _albedo_column("band", "albedo_band_px", "px", "structure of the band is about so large, and larger in the last"),
    _albedo_column("band", "albedo_band_std", "1", "std of log albedo beyond the coefficients, by band"),
    Variable(
        "albedo_image_std",
        ("frame", "band"),
        "f8",
        "1",
        "std of each image's own error in log albedo, by band",
        required=False,
    ),
    _albedo_column("incidence_bin", "albedo_bin_cos_incidence", "1", "middle of the bin"),
    _albedo_column("incidence_bin", "albedo_interval_68", "1", _INTERVAL),
    _albedo_column("incidence_bin", "albedo_interval_95", "1", "the same of the 95 % interval"),
    _albedo_column("level", "albedo_interval_shadow", "1", _SHADOW),
)


def _refined_column(dim: str, name: str, unit: str, description: str) -> Variable:
    return column(dim, name, unit, description, required=False)


_WAVE = "orthonormal cosine waves of about this length"
_REFINED = (
    grid_map("elevation_correction", "f4", "m", "what photographs added to the DEM's elevation", required=False),
    grid_map("elevation_std", "f4", "m", "standard deviation of the corrected elevation's waves", required=False),
    _albedo_map("albedo_alone", "f4", "albedo before the elevation was corrected"),
    _refined_column("wavelength", "refine_wavelength_px", "px", "wavelengths, broad to fine"),
    _refined_column("wavelength", "refine_elevation_wave_std", "m", f"std of what the DEM lacks, {_WAVE}"),
    _refined_column("wavelength", "refine_albedo_wave_std", "1", f"std of log albedo, {_WAVE}"),
    _refined_column("wavelength", "refine_trust", "1", "share of white noise's weight that images keep"),
    _refined_column(
        "bound",
        "refine_gain_percent",
        "percent",
        "by which squared errors of images left out fall, each at its best gain; value, low, high",
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
            "wavelength": "wavelengths of spectra, broad to fine",
            "bound": "value and both ends of its 95 % interval",
            "place": LEARNED,
        },
        variables=GRID
        + (
            grid_map(
                "coefficients_std",
                "f4",
                "1",
                "standard deviations of single pixels' coefficients, by name in map_name; the other coefficients are the "
                "same everywhere",
                required=False,
                stacked_along="map",
            ),
            text_column("map", "map_name", "names of the coefficients that vary by place", required=False),
            grid_map(
                "coefficients",
                "f4",
                "1",
                "coefficients of the reflectance model, by name in coefficient_name",
                stacked_along="coefficient",
            ),
            text_column("coefficient", "coefficient_name", "names of the coefficients"),
            grid_map("elevation", "f4", "m", "height above the reference sphere"),
            grid_map("valid", "u1", "1", "1 = the map holds coefficients here", flags=VALIDITY, compress=True),
        )
        + _ALBEDO
        + _REFINED
        + LEARNED_GROUND,
        attributes=PLACE
        + (
            Attribute("model", "reflectance model"),
            Attribute("quantity", "what the model gives: I/F"),
            IMAGE_NOISE,
            LEARNED_EDGE,
            Attribute("refine_reason", "why refine left the elevation as it was, or empty", required=False),
            Attribute("image_units", "units of the images that the map was trained on: 'iof' or 'dn'", required=False),
        ),
    )
)
