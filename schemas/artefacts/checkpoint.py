"""checkpoint.h5: a trained network."""

from __future__ import annotations

from schemas.artefacts.common import IMAGE_NOISE, LARGEST_COUNT, LARGEST_GSD, PLACE
from schemas.declaration import STRING, Attribute, Schema, Variable, declare

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
            IMAGE_NOISE,
            Attribute(
                "elevation_scale_m", "std of the crop-centred training elevations, m", True, "number", 1e-6, LARGEST_GSD
            ),
            *PLACE,
            Attribute("output_scale", "factor of the network's raw output", True, "number", 0.0, LARGEST_GSD),
            Attribute("image_units", "units of the training images", choices=("iof", "dn")),
            Attribute(
                "best_epoch", "epoch whose weights are in /weights, the first is 1", True, "integer", 1, LARGEST_COUNT
            ),
        ),
    )
)
