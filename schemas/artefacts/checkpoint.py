"""checkpoint.h5: a trained network."""

from __future__ import annotations

from schemas.artefacts.common import (
    IMAGE_NOISE,
    LARGEST_COUNT,
    LARGEST_GSD,
    LEARNED,
    LEARNED_EDGE,
    LEARNED_GROUND,
    PLACE,
    column,
    text_column,
)
from schemas.declaration import Attribute, Schema, declare


def _switch(name: str, description: str) -> Attribute:
    return Attribute(name, description, True, "integer", 0, 1)


CHECKPOINT = declare(
    Schema(
        name="checkpoint",
        version=1,
        stage="train",
        title="Weights, normalisation and history of a trained network",
        dims={"epoch": "training epochs", "frame": "source images", "place": LEARNED},
        variables=(
            column("epoch", "train_loss", "1", "mean squared error on valid training pixels", minimum=0.0),
            column("epoch", "validation_loss", "1", "mean squared error on valid validation pixels", minimum=0.0),
            column("epoch", "epoch_seconds", "s", "wall time of the epoch", minimum=0.0),
            text_column("frame", "image_id", "name of the source image"),
            column("frame", "gain", "1", "measured = gain x I/F + offset; 1 for calibrated images"),
            column("frame", "offset", "1", "measured = gain x I/F + offset; 0 for calibrated images"),
        )
        + LEARNED_GROUND,
        attributes=(
            Attribute("model", "reflectance model whose coefficients the network predicts"),
            Attribute("coefficients", "JSON list of coefficient names, in channel order", kind="json list"),
            Attribute(
                "maps",
                "JSON list of the coefficients that the network predicts place by place, in channel order",
                kind="json list",
            ),
            Attribute("globals", "JSON: the other coefficients, the same everywhere, by name", kind="json"),
            _switch("positive", "1 = coefficients are kept nearly positive by LeakyReLU, 0 = within their bounds"),
            _switch("deviations", "1 = the network also gives the logarithm of each map's standard deviation"),
            IMAGE_NOISE,
            LEARNED_EDGE,
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
