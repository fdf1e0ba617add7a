"""Artefact schemas, declared once; writing, opening and validation; the errors."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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
from schemas.files.outputs import atomic_path, write_json

if TYPE_CHECKING:
    from schemas.reading import open_artefact, read_config, read_kind, read_strings
    from schemas.writing import ArtefactWriter


def __getattr__(name: str) -> Any:
    """What needs h5py is imported when it is asked for: a command that only refuses or helps must answer at once."""
    for module in ("reading", "writing") if name in __all__ else ():
        loaded = importlib.import_module(f"schemas.{module}")
        if hasattr(loaded, name):
            return getattr(loaded, name)
    raise AttributeError(f"module 'schemas' has no attribute '{name}'")


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
