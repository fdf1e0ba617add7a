"""Opening artefacts, of this program or another, and checking that they are what they should be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas.checks import (
    any_text,
    as_text,
    check_attributes,
    check_georeference,
    check_values,
    is_foreign,
    parse_json,
    remedy,
)
from schemas.declaration import SCHEMAS, STRING, Schema, Variable
from schemas.errors import ArtefactError
from schemas.files.hdf5 import open_hdf5, silence_hdf5
from schemas.units import unit_name


def open_artefact(path: Path, schema: Schema) -> h5py.File:
    """Open an artefact for reading, after checking that it is what it should be. Raises ArtefactError."""
    path = Path(path)
    file = open_hdf5(path)
    try:
        _check_kind(path, file, schema)
        for variable in schema.variables:
            if variable.name in file:
                _check_variable(path, file, variable, remedy(file, schema))
            elif variable.required:
                raise ArtefactError(
                    f"{path}:/{variable.name}: expected a variable ({variable.description}), found none; "
                    f"{remedy(file, schema)}."
                )
        for attribute in schema.attributes:
            if attribute.required and attribute.name not in file.attrs:
                raise ArtefactError(
                    f"{path}: expected the root attribute '{attribute.name}' ({attribute.description}), found none; "
                    f"{remedy(file, schema)}."
                )
        check_attributes(path, file, schema)
        _check_sizes(path, file, schema)
        check_georeference(path, file, schema)
        check_values(path, file, schema)
    except BaseException:
        file.close()
        raise
    return file


def read_kind(path: Path) -> Schema:
    """The schema that an artefact names as its own. Raises ArtefactError."""
    with open_hdf5(Path(path)) as file:
        name = _attribute(path, file, "lunargr_schema")
    if name not in SCHEMAS:
        raise ArtefactError(
            f"{path}: expected a lunargr artefact (root attribute 'lunargr_schema'), found '{name or 'none'}'; "
            f"artefacts are: {', '.join(SCHEMAS)}."
        )
    return SCHEMAS[name]


def is_artefact(path: Path) -> bool:
    """Whether a file is HDF5 with ``lunargr_schema``, as ours are, or is named .h5 and too damaged to tell."""
    silence_hdf5()
    if not (path.is_file() and h5py.is_hdf5(path)):
        return False
    try:
        with h5py.File(path, "r") as file:
            return "lunargr_schema" in file.attrs
    except (OSError, RuntimeError):  # damaged
        return path.suffix.lower() in (".h5", ".hdf5")


def _check_kind(path: Path, file: h5py.File, schema: Schema) -> None:
    found = _attribute(path, file, "lunargr_schema")
    if not found and schema.foreign_writers:
        return
    if found != schema.name:
        kind = f"a '{found}'" if found else "an HDF5 file without 'lunargr_schema'"
        raise ArtefactError(
            f"{path}: expected a '{schema.name}' artefact (from 'lunargr {schema.stage}'), found {kind}; check the order of the files."
        )
    version = any_text(np.ravel(file.attrs.get("schema_version", schema.version))[0])
    try:
        known = float(version) in (schema.version, *schema.still_read)
    except ValueError:
        known = False
    if not known:
        raise ArtefactError(
            f"{path}: expected version {schema.version} of '{schema.name}', found '{version}'; {remedy(file, schema)}."
        )


def _attribute(path: Path, file: h5py.File, name: str) -> str:
    """A root attribute of text, '' where absent. Raises ArtefactError."""
    if name not in file.attrs:
        return ""
    try:
        text = as_text(file.attrs[name])
    except (OSError, TypeError, ValueError):
        text = None
    if text is None:
        raise ArtefactError(f"{path}: root attribute '{name}': expected text, found something else; write it again.")
    return text


def _check_variable(path: Path, file: h5py.File, variable: Variable, advice: str) -> None:
    where = f"{path}:/{variable.name}"
    data = file[variable.name]
    if not isinstance(data, h5py.Dataset) or data.ndim != len(variable.dims):
        found = f"{data.ndim}" if isinstance(data, h5py.Dataset) else "a group"
        raise ArtefactError(
            f"{where}: expected {len(variable.dims)} dimensions ({', '.join(variable.dims)}), found {found}; write it again."
        )
    if variable.dtype == STRING:
        if data.dtype.kind != "S" and h5py.check_string_dtype(data.dtype) is None:
            raise ArtefactError(f"{where}: expected text, found {data.dtype}; write it again.")
        return
    if data.dtype.kind not in "iufb":
        raise ArtefactError(f"{where}: expected numbers ({variable.dtype}), found {data.dtype}; write it again.")
    unit = read_unit(data)
    allowed = (variable.unit, *variable.unit_choices)
    if unit and unit not in allowed:
        expected = " or ".join(f"'{u}'" for u in dict.fromkeys(allowed))
        raise ArtefactError(f"{where}: expected units {expected}, found '{unit}'; {advice}.")
    _check_packing(where, data, advice)


def _check_packing(where: str, data: h5py.Dataset, advice: str) -> None:
    """Refuse attributes by which ``schemas.packing`` could not decode a variable. Raises ArtefactError."""
    for name in ("scale_factor", "add_offset", "_FillValue", "missing_value"):
        value = data.attrs.get(name, 1.0)
        numbers = np.ravel(value) if isinstance(value, np.ndarray | np.generic | float) else np.array(["?"])
        good = numbers.dtype.kind in "iuf" and numbers.size > 0
        if good and name in ("scale_factor", "add_offset"):
            good = numbers.size == 1 and bool(np.isfinite(numbers[0])) and (numbers[0] != 0 or name == "add_offset")
        if not good:
            raise ArtefactError(f"{where}: expected a number in '{name}', found '{any_text(value)[:40]}'; {advice}.")


def _check_sizes(path: Path, file: h5py.File, schema: Schema) -> None:
    sizes: dict[str, tuple[int, str]] = {dim: (size, "its schema") for dim, size in schema.sizes}
    for variable in schema.variables:
        if variable.name not in file:
            continue
        for dim, size in zip(variable.dims, file[variable.name].shape, strict=True):
            first = sizes.setdefault(dim, (size, f"/{variable.name}"))
            if first[0] != size:
                raise ArtefactError(
                    f"{path}:/{variable.name}: expected {first[0]} along '{dim}' as in {first[1]}, found {size}; write it again."
                )
            if size == 0 and dim in ("y", "x"):
                raise ArtefactError(
                    f"{path}:/{variable.name}: expected pixels along '{dim}', found none; write it again."
                )


def read_unit(data: h5py.Dataset) -> str:
    """The unit of a variable in the spelling that declarations have, '' where it names none."""
    unit = data.attrs.get("units", "")
    return "" if isinstance(unit, h5py.Empty) else unit_name(any_text(unit))


def read_strings(file: h5py.File, name: str) -> list[str]:
    """A string variable as a list of ``str``."""
    return [any_text(v) for v in file[name][...]]


def read_config(file: h5py.File) -> dict[str, Any]:
    """The configuration that an artefact was made with; {} in files of other programs. Raises ArtefactError."""
    if is_foreign(file):
        return {}
    return parse_json(any_text(file.attrs.get("config", "{}")), f"{file.filename}: root attribute 'config'")
