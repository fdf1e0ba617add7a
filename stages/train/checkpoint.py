"""Writing checkpoint.h5."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np

from schemas import CHECKPOINT, ArtefactWriter
from schemas.files.outputs import Output
from stages.network.predictor import write_state
from stages.pairs.ground import Ground
from stages.train.config import Config
from stages.train.resume import History
from stages.train.training import Training


def write_checkpoint(output: Output, config: Config, training: Training, history: History) -> None:
    """The weights and all that is needed to use them."""
    reader, predictor, radiometry = training.reader, training.predictor, training.radiometry
    trained = set(reader.frame[reader.indices("train")].tolist())
    known = np.array([k in trained or reader.units == "iof" for k in range(len(reader.image_ids))])
    maps = predictor.maps
    attributes: dict[str, Any] = {
        "model": predictor.model.name,
        "coefficients": json.dumps(maps.names),
        "maps": json.dumps(maps.maps),
        "globals": json.dumps({name: value.item() for name, value in maps.global_values().items()}),
        "positive": np.int32(maps.positive),
        "deviations": np.int32(maps.channels > len(maps.maps)),
        "elevation_scale_m": predictor.elevation_scale,
        "output_scale": maps.output_scale,
        "gsd_m": reader.gsd,
        "body_radius_m": reader.body_radius,
        "image_units": reader.units,
        "best_epoch": np.int32(history.best_epoch + 1),
        "start": json.dumps(training.start),
        "precision": training.precision,
    }
    if math.isfinite(predictor.image_noise):
        attributes["image_noise"] = predictor.image_noise
    ground = Ground.of(reader)
    sizes = {"epoch": len(history.train_loss), "frame": len(reader.image_ids)} | ground.sizes
    with ArtefactWriter(
        output.file,
        CHECKPOINT,
        sizes,
        config=asdict(config),
        inputs=[reader.path],
        seed=config.seed,
        attributes=attributes | ground.attributes,
    ) as writer:
        for key in ("train_loss", "validation_loss", "epoch_seconds"):
            writer.write(key, np.array(getattr(history, key)))
        writer.write("image_id", reader.image_ids)
        # NaN for an image without training pairs, whose gain is not known.
        for key in ("gain", "offset"):
            writer.write(key, np.where(known, getattr(radiometry, key)().detach().cpu().numpy(), np.nan))
        ground.write(writer)
        write_state(writer.file.create_group("weights", track_order=True), predictor.state_dict())
