"""Artefact schemas, declared once; HDF5 writing, opening and validation; the errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas.artefacts import CHECKPOINT, CROPS, DIAGNOSIS, EVALUATION, PAIRS, SCENE, SPLITS, SVBRDF, UNITS
from schemas.declaration import SCHEMAS, Attribute, Schema, Variable, get_schema
from schemas.errors import (
    EXIT_CODE,
    ArtefactError,
    ConfigError,
    GeometryError,
    InputError,
    LunargrError,
    RegistryError,
)
from schemas.truth import TRUTH

_HDF5 = ("ArtefactWriter", "atomic_path", "check_output", "open_artefact", "read_config", "read_kind", "read_strings")

if TYPE_CHECKING:
    from schemas.hdf5 import (
        ArtefactWriter,
        atomic_path,
        check_output,
        open_artefact,
        read_config,
        read_kind,
        read_strings,
    )


def __getattr__(name: str) -> Any:
    """Import h5py only for those who open files: `lunargr --help` must answer at once."""
    if name in _HDF5:
        from schemas import hdf5

        return getattr(hdf5, name)
    raise AttributeError(f"module 'schemas' has no attribute '{name}'")


__all__ = [
    "CHECKPOINT",
    "CROPS",
    "DIAGNOSIS",
    "EVALUATION",
    "EXIT_CODE",
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
    "check_output",
    "get_schema",
    "open_artefact",
    "read_config",
    "read_kind",
    "read_strings",
]
