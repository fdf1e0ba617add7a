"""The extended model of a diagnosis, read back so that training, rendering and evaluation can apply it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from schemas import DIAGNOSIS, ArtefactError, RegistryError, open_artefact, read_strings
from schemas.checks import any_text
from stages.effects.base import Effect, Survey, get_effect
from stages.pairs.ground import boxes_overlap, splits_of


def load_extension(path: Path, image_ids: Sequence[str] | None = None) -> list[Effect]:
    """The effects that `lunargr diagnose` named, ready for ``formation.form``.

    image_ids : names behind ``Observation.frame`` in the file at hand. Values per image go with the name; images that
        the diagnosis did not see get the null value. None: the frames are those of the diagnosed file.
    Raises ArtefactError, RegistryError.
    """
    with open_artefact(Path(path), DIAGNOSIS) as file:
        entries = json.loads(any_text(file.attrs["extension"]))
        known = {name: k for k, name in enumerate(read_strings(file, "image_id"))}
        try:
            names = _tables(entries, file)
            tables = {name: torch.from_numpy(np.asarray(file[name][...], np.float32)) for name in names}
            return _effects(entries, tables, known, image_ids)
        except RegistryError as error:
            raise ArtefactError(f"{path}: root attribute 'extension': {error}") from None
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, RuntimeError) as error:
            raise ArtefactError(
                f"{path}: root attribute 'extension': expected effects with their values and tables, found something else "
                f"({type(error).__name__}: {error}); run 'lunargr diagnose' again."
            ) from None


def _effects(
    entries: list[dict[str, Any]], tables: dict[str, Tensor], known: dict[str, int], image_ids: Sequence[str] | None
) -> list[Effect]:
    order = None if image_ids is None else [known.get(str(name), -1) for name in image_ids]
    effects = []
    for entry in entries:
        cls = get_effect(entry["effect"])
        if cls.scope in ("site", "pair"):
            continue  # a pattern of the diagnosed ground says nothing about other ground
        values = {name: _finite(value) for name, value in entry["values"].items()}
        for coordinate, table in entry.get("tables", {}).items():
            column = tables[table["variable"]].reshape(len(known), -1)[:, table["column"]]
            if order is not None and cls.scope == "image":
                null = cls.null()[coordinate]
                column = torch.tensor([float(column[k]) if k >= 0 else null for k in order], dtype=torch.float32)
            values[coordinate] = column
        effects.append(cls(values, Survey.from_json(entry["survey"])))
    return effects


def _finite(value: Any) -> Any:
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number, found {value}")
    return value


def _tables(entries: list[dict], file) -> set[str]:
    return {t["variable"] for e in entries for t in e.get("tables", {}).values() if t["variable"] in file}


def check_ground(diagnosis: Path, pairs: Path) -> list[str]:
    """That a diagnosis did not learn from ground on which ``pairs`` are tested; returns what cannot be told, as notes.

    Raises ArtefactError where both descend from samples of the same ground that were split in different ways.
    """
    learned, tested = splits_of(diagnosis), splits_of(pairs)
    if not learned or not tested:
        missing = diagnosis if not learned else pairs
        return [
            f"whether '{diagnosis.name}' learned from ground that is tested here cannot be told: {missing.name} does not "
            "say how its ground was split"
        ]
    for mine in tested:
        for other in learned:
            boxes = mine["split_ground_deg"], other["split_ground_deg"]
            if mine["split_id"] != other["split_id"] and boxes_overlap(*boxes):
                raise ArtefactError(
                    f"{diagnosis}: expected a diagnosis that learned from ground split as in {pairs.name} ({mine['split_id']}), "
                    f"found split {other['split_id']}: it may have learned from the test ground; sample both with the same "
                    "`tile_m`, `split` and `seed`."
                )
    return []
