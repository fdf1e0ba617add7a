"""normalized.h5: images at a standard geometry, and their mosaics."""

from __future__ import annotations

from schemas.artefacts.common import FRAMES, GRID, PLACE, column, grid_map, text_column
from schemas.declaration import Attribute, Schema, Variable, declare

MASKS = (("unseen", 0), ("good", 1), ("shadow", 2), ("grazing", 3))

NORMALIZED = declare(
    Schema(
        name="normalized",
        version=1,
        stage="normalize",
        title="Images at a standard geometry, and their mosaics",
        dims={
            "frame": "source images",
            "layer": "mosaics: of each band one of all phases, and one of each phase bin",
            "incidence_bin": "bins of the cosine of incidence",
            "y": "grid rows, north to south",
            "x": "grid columns, west to east",
        },
        variables=GRID
        + (
            grid_map("normalized", "f4", "1", "I/F at the standard geometry", stacked_along="frame"),
            grid_map("normalized_std", "f4", "1", "its standard deviation, NaN where not known", stacked_along="frame"),
            grid_map("mask", "u1", "1", "which pixels of an image have values", "frame", flags=MASKS, compress=True),
            grid_map("mosaic", "f4", "1", "I/F at the standard geometry, of all images of the layer", "layer"),
            grid_map("mosaic_std", "f4", "1", "its standard deviation, NaN where not known", "layer"),
            grid_map("mosaic_scatter", "f4", "1", "standard deviation of single images about the mosaic", "layer"),
            grid_map("mosaic_images", "u2", "1", "images of the pixel", "layer", compress=True),
            text_column(
                "layer", "layer_name", "band and phase bin, as in bands of the GeoTIFF; empty for the one mosaic of all"
            ),
            column("layer", "phase_low_deg", "degree", "least phase of the layer"),
            column("layer", "phase_high_deg", "degree", "largest phase of the layer"),
            column("frame", "gain", "1", "measured = gain x I/F + offset"),
            column("frame", "offset", "1", "the same; 0 for images in I/F"),
            column("incidence_bin", "bin_cos_incidence", "1", "middle of the bin"),
            Variable(
                "image_std",
                ("frame", "incidence_bin"),
                "f8",
                "1",
                "relative standard deviation of an image's normalised I/F, from images that overlap it; NaN without any",
            ),
        )
        + FRAMES,
        attributes=PLACE
        + (
            Attribute("model", "reflectance model"),
            Attribute("quantity", "what the values are: I/F at the standard geometry"),
            Attribute("incidence_deg", "incidence of the standard geometry", True, "number", 0.0, 90.0),
            Attribute("emission_deg", "its emission", True, "number", 0.0, 90.0),
            Attribute("phase_deg", "its phase", True, "number", 0.0, 180.0),
            Attribute("image_units", "units of the images: 'iof' or 'dn'"),
        ),
    )
)
