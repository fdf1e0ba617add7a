"""diagnosis.h5: the report, and the extended model that `load_extension` reads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from schemas import DIAGNOSIS, ArtefactWriter
from stages.diagnose.result.answer import Answer


def write_diagnosis(
    path: Path, answer: Answer, image_ids: Sequence[str], inputs: Sequence[Path], overwrite: bool
) -> None:
    """Write the file. Values per image stand in tables, under the name and in the order that the effect's class gives."""
    entries: list[dict[str, Any]] = []
    tables: dict[str, Any] = {}
    sizes = {"frame": len(image_ids)}
    for cause in answer.causes:
        effect = cause.effect
        entry: dict[str, Any] = {"effect": effect.name, "survey": effect.survey.to_json(), "values": {}}
        if effect.table and any(isinstance(v, Tensor) and v.ndim for v in effect.values.values()):
            variable, second = effect.table
            data = torch.stack([torch.as_tensor(v) for v in effect.values.values()], 1).float().numpy()
            tables[variable] = data if second else data[:, 0]
            entry["tables"] = {k: {"variable": variable, "column": j} for j, k in enumerate(effect.values)}
            if second:
                sizes[second] = data.shape[1]
            if effect.scope == "site":
                sizes["site"] = len(data)
        else:
            entry["values"] = {k: float(v) + effect.in_simulation.get(k, 0.0) for k, v in effect.values.items()}
        for variable, (curve, dimension) in effect.curves().items():
            tables[variable], sizes[dimension] = curve, len(curve)
        entries.append(entry)
    attributes = {"report": json.dumps(answer.to_json()), "extension": json.dumps(entries)}
    with ArtefactWriter(
        path, DIAGNOSIS, sizes, config=answer.config, inputs=inputs, attributes=attributes, overwrite=overwrite
    ) as writer:
        writer.write("image_id", image_ids)
        for name, data in tables.items():
            writer.write(name, data)


__all__ = ["write_diagnosis"]
