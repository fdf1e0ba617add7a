"""Checks of an artefact's numbers and text against its declaration, made whenever one is opened."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas.declaration import ROOT_ATTRIBUTES, STRING, Attribute, Schema, Variable
from schemas.errors import ArtefactError
from schemas.packing import unpack

UNIT_TOLERANCE = 1e-3  # of a unit vector's length: writers in float32, and in few decimals
GSD_TOLERANCE = 1e-3  # relative: what writing numbers as text may cost
LARGEST_TABLE = 100_000_000  # values of a table; a larger size is an error of the file's writer
DEEPEST_JSON = 64  # levels: whatever follows them by recursion can
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def has_control_characters(text: str) -> bool:
    """Whether text holds control characters, which a terminal obeys, or surrogates, which no file name can hold."""
    return _CONTROL.search(text) is not None


def parse_json(text: str, where: str, error: type[Exception] = ArtefactError, advice: str = "write it again") -> Any:
    """The content of JSON text. Raises ``error`` for other text, for deep nesting and for what is no Unicode."""
    try:
        found = json.loads(text)
        deep = _is_deep(found)
    except RecursionError:
        deep = True
    except ValueError as problem:
        raise error(f"{where}: expected JSON, found something else ({str(problem)[:120]}); {advice}.") from None
    if deep:
        raise error(f"{where}: expected JSON of at most {DEEPEST_JSON} levels, found more; {advice}.")
    try:
        json.dumps(found, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise error(
            f"{where}: expected text in Unicode, found half of a surrogate pair (\\ud800 ..); {advice}."
        ) from None
    return found


def _is_deep(content: Any) -> bool:
    """Whether lists and objects lie within each other beyond DEEPEST_JSON levels."""
    level = [content]
    for _ in range(DEEPEST_JSON + 1):
        level = [node for node in level if isinstance(node, dict | list)]
        if not level:
            return False
        level = [v for node in level for v in (node.values() if isinstance(node, dict) else node)]
    return True


def is_foreign(file: h5py.File) -> bool:
    """Whether another program wrote a file: what it says of its making is then its own matter."""
    return not {"lunargr_schema", "lunargr_version"} <= set(file.attrs)


def remedy(file: h5py.File, schema: Schema) -> str:
    """What to do about a file that is not as its schema says."""
    stage = f"write it again with 'lunargr {schema.stage}'"
    return f"mend the program that wrote it, or {stage}" if is_foreign(file) else stage


def check_attributes(path: Path, file: h5py.File, schema: Schema) -> None:
    """Check kinds, ranges and choices of the root attributes. Raises ArtefactError."""
    for attribute in (*(() if is_foreign(file) else ROOT_ATTRIBUTES), *schema.attributes):
        if attribute.name in file.attrs:
            _check_attribute(path, file, attribute, remedy(file, schema))


def _check_attribute(path: Path, file: h5py.File, attribute: Attribute, advice: str) -> None:
    where = f"{path}: root attribute '{attribute.name}'"
    try:
        value: Any = file.attrs[attribute.name]
    except (OSError, TypeError, ValueError) as error:
        raise ArtefactError(f"{where}: cannot be read ({error}); {advice}.") from None
    if attribute.kind in ("number", "integer"):
        number = np.ravel(value) if isinstance(value, np.ndarray | np.generic | int | float) else np.array(["?"])
        low, high = _bounds(attribute)
        good = (
            number.size == 1 and number.dtype.kind in "iufb" and math.isfinite(number[0]) and low <= number[0] <= high
        )
        if not good or (attribute.kind == "integer" and not float(number[0]).is_integer()):
            raise ArtefactError(f"{where}: expected {_wanted(attribute)}, found {_short(value)}; {advice}.")
        return
    text = as_text(value)
    if text is None:
        raise ArtefactError(f"{where}: expected text ({attribute.description}), found {_short(value)}; {advice}.")
    if attribute.choices and text not in attribute.choices:
        raise ArtefactError(f"{where}: expected {' or '.join(attribute.choices)}, found {_short(text)}; {advice}.")
    if attribute.kind.startswith("json"):
        wanted = list if attribute.kind == "json list" else dict
        if not isinstance(found := parse_json(text, where, advice=advice), wanted):
            kind = "list" if wanted is list else "object"
            raise ArtefactError(f"{where}: expected a JSON {kind}, found {_short(found)}; {advice}.")


def check_georeference(path: Path, file: h5py.File, schema: Schema) -> None:
    """Refuse a map whose georeference is absent, not north up, or not of pixels of ``gsd_m``. Raises ArtefactError."""
    if not any(v.georeferenced for v in schema.variables):
        return
    where, advice = f"{path}:/crs", remedy(file, schema)
    found = file["crs"].attrs if "crs" in file else {}
    if as_text(found.get("crs_wkt")) is None or as_text(found.get("GeoTransform")) is None:
        raise ArtefactError(f"{where}: expected a georeference (crs_wkt, GeoTransform), found none; {advice}.")
    text = str(found["GeoTransform"])
    try:
        c, a, b, f, d, e = (float(v) for v in text.split())
    except ValueError:
        raise ArtefactError(f"{where}: expected six numbers in GeoTransform, found '{text}'; {advice}.") from None
    gsd = float(np.ravel(file.attrs["gsd_m"])[0])
    north_up = b == d == 0 and a > 0 > e and all(map(math.isfinite, (a, c, e, f)))
    if not (north_up and abs(a - gsd) <= GSD_TOLERANCE * gsd and abs(a + e) <= GSD_TOLERANCE * gsd):
        raise ArtefactError(
            f"{where}: expected a grid that is north up, of square pixels of gsd_m = {gsd:g}, found GeoTransform '{text}'; {advice}."
        )


def as_text(value: Any) -> str | None:
    """An attribute's text, None where it is something else. Some programs write lists of one text."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        try:
            return value.decode()
        except UnicodeDecodeError:
            return None
    if isinstance(value, str):
        return None if re.search("[\ud800-\udfff]", value) else value
    return None


def any_text(value: Any) -> str:
    """An attribute as text to show or compare, whatever it is: bytes that are no UTF-8 are spelled out."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        return value.decode(errors="backslashreplace")
    return str(value).encode("utf-8", "backslashreplace").decode()


def check_values(path: Path, file: h5py.File, schema: Schema) -> None:
    """Check ranges, flags, indices, directions and text of all variables that are tables. Raises ArtefactError."""
    for variable in schema.variables:
        if variable.is_table and variable.name in file:
            data = file[variable.name]
            where = f"{path}:/{variable.name}"
            advice = remedy(file, schema)
            if data.size > LARGEST_TABLE:
                raise ArtefactError(
                    f"{where}: expected at most {LARGEST_TABLE:,} values, found {data.size:,}; {advice}."
                )
            try:
                values = data[...]
            except (OSError, ValueError, TypeError, MemoryError) as error:
                raise ArtefactError(
                    f"{where}: cannot be read ({_short(error)}); the file is damaged, {advice}."
                ) from None
            if variable.dtype == STRING:
                _check_strings(where, values, advice)
            else:
                limit = _size(file, schema, variable.index_of)
                _check_numbers(where, variable, data, values, limit, advice)


def _size(file: h5py.File, schema: Schema, dim: str) -> int:
    """Length of a dimension, from any variable that has it."""
    for variable in schema.variables:
        if dim in variable.dims and variable.name in file:
            return int(file[variable.name].shape[variable.dims.index(dim)])
    return 0


def _check_strings(where: str, values: Any, advice: str) -> None:
    for value in np.ravel(values):
        text = as_text(value)
        if text is None:
            raise ArtefactError(f"{where}: expected text in UTF-8, found {_short(value)}; {advice}.")
        if has_control_characters(text):
            raise ArtefactError(f"{where}: expected text without control characters, found {_short(text)}; {advice}.")


def _check_numbers(where: str, variable: Variable, data: h5py.Dataset, values: Any, limit: int, advice: str) -> None:
    try:
        numbers = np.asarray(unpack(data, values), dtype=np.float64)
    except (TypeError, ValueError):
        raise ArtefactError(f"{where}: its scale_factor, add_offset or _FillValue is no number; {advice}.") from None
    whole = np.dtype(variable.dtype).kind in "iu"
    if whole or variable.finite or variable.unit_vector:
        _refuse(where, ~np.isfinite(numbers), numbers, "finite numbers", advice)
    if whole:
        _refuse(where, numbers != np.floor(numbers), numbers, "whole numbers", advice)
    if variable.flags:
        names = ", ".join(f"{value} = {meaning}" for meaning, value in variable.flags)
        _refuse(where, ~np.isin(numbers, [value for _, value in variable.flags]), numbers, f"flags ({names})", advice)
    if variable.index_of:
        wanted = f"indices from 0 to below {limit} ({variable.index_of})"
        _refuse(where, (numbers < 0) | (numbers >= limit), numbers, wanted, advice)
    if variable.unit_vector and len(numbers):
        length = np.linalg.norm(numbers, axis=-1)
        _refuse(where, np.abs(length - 1) > UNIT_TOLERANCE, length, "vectors of length 1", advice)
    low, high = _bounds(variable)
    _refuse(where, (numbers < low) | (numbers > high), numbers, _wanted(variable), advice)


def _refuse(where: str, bad: Any, numbers: Any, wanted: str, advice: str) -> None:
    if bad.any():
        first = np.ravel(numbers)[int(np.flatnonzero(bad)[0])]
        place = ", ".join(map(str, np.argwhere(bad)[0]))
        raise ArtefactError(f"{where}: expected {wanted}, found {first:g} at [{place}]; {advice}.")


def _bounds(declared: Variable | Attribute) -> tuple[float, float]:
    low, high = declared.minimum, declared.maximum
    return -math.inf if low is None else low, math.inf if high is None else high


def _wanted(declared: Variable | Attribute) -> str:
    low, high = _bounds(declared)
    kind = "a whole number" if isinstance(declared, Attribute) and declared.kind == "integer" else "a finite number"
    kind = "numbers" if isinstance(declared, Variable) else kind
    if math.isinf(low) and math.isinf(high):
        return kind
    return f"{kind} of {low:g} .. {high:g}" if math.isfinite(high) else f"{kind} of at least {low:g}"


def _short(value: Any) -> str:
    text = repr(value.tolist() if isinstance(value, np.ndarray | np.generic) else value)
    return text if len(text) <= 80 else text[:77] + "..."
