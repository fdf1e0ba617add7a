"""The model card beside an exported network: inputs and outputs, training data, limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from schemas.provenance import Record
from stages.network.predictor import Predictor


def model_card(
    name: str,
    checkpoint: str,
    predictor: Predictor,
    record: Record,
    losses: Mapping[str, NDArray],
    best: int,
) -> str:
    """The card in Markdown.

    record : of the checkpoint; losses : train_loss and validation_loss, (epochs,) each; best : epoch of the
    weights, from 1
    """
    model, stride = predictor.model, predictor.net.stride
    rows = "\n".join(f"| {k} | `{p.name}` | {p.unit} | {p.description} |" for k, p in enumerate(model.parameters))
    inputs = ", ".join(f"`{i['name']}` (SHA-256 `{i['sha256'][:16]}...`)" for i in record["inputs"])
    history = record["history"].strip().splitlines() or ["?"]
    found = float(losses["validation_loss"][best - 1]) if 0 < best <= len(losses["validation_loss"]) else float("nan")
    error = f"{found:.4g}" if np.isfinite(found) else "not recorded"
    return f"""# {name}

A network that maps terrain to the coefficients of the reflectance model **{model.name}** ({model.title}):

    I/F = {model.formula}

I/F is the radiance factor pi r, including cos(incidence). Source of the formula: {model.reference}.

| | name | shape | unit |
|---|---|---|---|
| input | `elevation` | (batch, height, width) float32 | m; any datum, rows run south, {predictor.gsd:g} m per pixel |
| output | `coefficients` | (batch, {len(model.parameters)}, height, width) float32 | as below |

Height and width are multiples of {stride}. An output pixel sees {predictor.net.reach} pixels around it: of maps in windows keep
those pixels as context, on windows that begin at multiples of {stride}. Holes must be filled before.

| channel | coefficient | unit | |
|---|---|---|---|
{rows}

## Where it comes from

- Exported from `{checkpoint}`, epoch {best} of {len(losses["train_loss"])}; mean squared error on validation pixels {error} (I/F squared).
- Trained on {inputs or "inputs that were not recorded"} with lunargr {record["version"] or "?"}: `{history[-1]}`
- Images in {"I/F" if predictor.image_units == "iof" else "DN, with a gain and an offset per image"}.

## Limits

- Trained at {predictor.gsd:g} m per pixel; at other scales terrain looks different, and nothing is known about the result.
- It knows only the ground, the Sun's directions and the cameras of its training images.
- It gives no uncertainty.
"""
