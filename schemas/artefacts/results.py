"""evaluation.h5 and diagnosis.h5: what was found."""

from __future__ import annotations

from schemas.artefacts.common import column, text_column
from schemas.declaration import Attribute, Schema, Variable, declare

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
            text_column("model", "model_name", "names of the compared models"),
            column("pair", "pair_index", "1", "index of the crop in pairs.h5", "i4", minimum=0),
            column("pair", "tile", "1", "ground tile, the independent unit of the intervals", "i4"),
            column("pair", "valid_pixels", "1", "pixels that count", "i4", minimum=0),
            Variable("mse", ("model", "pair"), "f8", "1", "mean squared error of the crop, mean over training runs"),
            Variable(
                "ssim", ("model", "pair"), "f8", "1", "structural similarity of the crop, mean over training runs"
            ),
            column("run", "run_seed", "1", "seed of each training run", "i8", required=False),
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


def _value(name: str, dims: tuple[str, ...], unit: str, description: str) -> Variable:
    """What one effect of the extended model holds, where the model has that effect."""
    return Variable(name, dims, "f4", unit, description, required=False)


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
            "frame_value": "coordinates of effects with values per image that name no variable of their own",
            "site_value": "the same of effects with values per site",
            "term": "cosines of an albedo pattern, down and across a crop, in the order of the effect's coordinates",
        },
        variables=(
            text_column("frame", "image_id", "name of the source image"),
            _value(
                "image_shift_px",
                ("frame", "axis"),
                "px",
                "misregistration: columns and rows by which the image shows ground further east and south",
            ),
            _value(
                "line_jitter_px",
                ("frame", "mode"),
                "px",
                "line_jitter: amplitudes of cosines 1..3 over the lines, east, then south",
            ),
            _value(
                "frame_field",
                ("frame", "site", "field_term"),
                "1",
                "frame_field: amplitudes of low cosines over each crop of a frame, relative to the response; 0 for crops not looked at",
            ),
            _value("image_gain", ("frame",), "1", "image_gain: relative gain of the image"),
            _value(
                "column_response",
                ("column",),
                "1",
                "column_pattern: response over the detector samples first..last, relative to 1",
            ),
            _value(
                "site_albedo",
                ("site", "term"),
                "1",
                "albedo_map: amplitudes of the cosines at each site, relative to its albedo; 0 for sites not looked at",
            ),
            text_column(
                "frame_value", "frame_value_name", "effect and coordinate of a column of frame_values", required=False
            ),
            _value("frame_values", ("frame", "frame_value"), "1", "values per image, in the unit of the coordinate"),
            text_column(
                "site_value", "site_value_name", "effect and coordinate of a column of site_values", required=False
            ),
            _value("site_values", ("site", "site_value"), "1", "values per site, in the unit of the coordinate"),
        ),
        attributes=(
            Attribute("report", "the diagnosis as JSON (docs: the output of diagnose)", kind="json"),
            Attribute(
                "extension", "JSON list of the effects of the extended model with their parameters", kind="json list"
            ),
        ),
    )
)
