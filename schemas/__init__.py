"""Artefact schemas, declared once; writing, opening and validation; the errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.artefacts import (
    CHECKPOINT,
    CROPS,
    DIAGNOSIS,
    EVALUATION,
    NORMALIZED,
    PAIRS,
    SCENE,
    SPLITS,
    SVBRDF,
    TRUTH,
    UNITS,
)
from schemas.declaration import SCHEMAS, Attribute, Schema, Variable, get_schema
from schemas.errors import EXIT_CODE, ArtefactError, ConfigError, GeometryError, InputError, LunargrError, RegistryError
from schemas.later import imported_later

if TYPE_CHECKING:
    from schemas.files.outputs import atomic_path, write_json
    from schemas.reading import open_artefact, read_config, read_kind, read_strings
    from schemas.writing import ArtefactWriter


__getattr__ = imported_later(__name__, "files.outputs", "reading", "writing")

__all__ = [
    "CHECKPOINT",
    "CROPS",
    "DIAGNOSIS",
    "EVALUATION",
    "EXIT_CODE",
    "NORMALIZED",
    "PAIRS",
    "SCENE",
    "SCHEMAS",
    "SPLITS",
    "SVBRDF",
    "TRUTH",
    "UNITS",
    "ArtefactError",
    "ArtefactWriter",
    "Attribute",
    "ConfigError",
    "GeometryError",
    "InputError",
    "LunargrError",
    "RegistryError",
    "Schema",
    "Variable",
    "atomic_path",
    "get_schema",
    "open_artefact",
    "read_config",
    "read_kind",
    "read_strings",
    "write_json",
]
