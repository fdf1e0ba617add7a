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


def write_diagnosis(path: Path, answer: Answer, image_ids: Sequence[str], inputs: Sequence[Path]) -> None:
    """Write the file. Values per image or site stand in the variable that the effect's class names, or in a common one."""
    entries: list[dict[str, Any]] = []
    tables: dict[str, Any] = {}
    shared: dict[str, list[tuple[str, Tensor]]] = {"frame": [], "site": []}  # columns of effects without a variable
    sizes = {"frame": len(image_ids)}
    sites = max(
        (v.shape[-1] for c in answer.causes if c.effect.scope in ("site", "pair") for v in c.effect.values.values()),
        default=0,
    )
    for cause in answer.causes:
        effect = cause.effect
        entry: dict[str, Any] = {"effect": effect.name, "survey": effect.survey.to_json(), "values": {}}
        if not any(isinstance(v, Tensor) and v.ndim for v in effect.values.values()):
            entry["values"] = {k: float(v) + effect.in_simulation.get(k, 0.0) for k, v in effect.values.items()}
        elif effect.table is None:
            kind = "site" if effect.scope == "site" else "frame"
            first = len(shared[kind])
            shared[kind] += [(f"{effect.name} {k}", torch.as_tensor(v).float()) for k, v in effect.values.items()]
            entry["tables"] = {
                k: {"variable": f"{kind}_values", "column": first + j} for j, k in enumerate(effect.values)
            }
        else:
            variable, second = effect.table
            data = torch.stack([torch.as_tensor(v) for v in effect.values.values()], -1).float()
            if effect.scope in ("site", "pair"):
                sizes["site"] = sites
                data = torch.nn.functional.pad(data, (0, 0, 0, sites - data.shape[-2]))
            if effect.scope == "pair":  # the last images may be of sites that were not looked at
                data = torch.nn.functional.pad(data, (0, 0, 0, 0, 0, len(image_ids) - len(data)))
            tables[variable] = (data if second else data[..., 0]).numpy()
            entry["tables"] = {k: {"variable": variable, "column": j} for j, k in enumerate(effect.values)}
            if second:
                sizes[second] = data.shape[-1]
        for variable, (curve, dimension) in effect.curves().items():
            tables[variable], sizes[dimension] = curve, len(curve)
        entries.append(entry)
    for kind, columns in shared.items():
        if columns:
            values = torch.stack(torch.broadcast_tensors(*(values for _, values in columns)), 1).numpy()
            tables[f"{kind}_values"], tables[f"{kind}_value_name"] = values, [name for name, _ in columns]
            sizes |= {kind: len(values), f"{kind}_value": len(columns)}
    attributes = {"report": json.dumps(answer.to_json()), "extension": json.dumps(entries)}
    with ArtefactWriter(path, DIAGNOSIS, sizes, config=answer.config, inputs=inputs, attributes=attributes) as writer:
        writer.write("image_id", image_ids)
        for name, data in tables.items():
            writer.write(name, data)


__all__ = ["write_diagnosis"]
