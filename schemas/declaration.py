"""What an artefact is: dimensions, variables, units and root attributes, declared once and used everywhere."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from schemas.errors import RegistryError

STRING = "string"  # a variable-length UTF-8 string, netCDF's NC_STRING


@dataclass(frozen=True)
class Variable:
    """One variable of an artefact.

    ``unit`` is a UDUNITS string, ``"1"`` for pure numbers, ``"dn"`` among ``unit_choices`` where images may be uncalibrated;
    ``flags`` : (meaning, value) of a flag variable; ``compress`` is for masks, which deflate to nearly nothing.
    Checked whenever a file is opened, but for maps and stacks of crops: ``minimum`` .. ``maximum``, ``finite``
    (otherwise NaN = unknown), ``unit_vector`` along the last dimension, ``index_of`` a dimension; flag variables hold
    the values in ``flags`` only, integers are whole.
    """

    name: str
    dims: tuple[str, ...]
    dtype: str
    unit: str
    description: str
    required: bool = True
    flags: tuple[tuple[str, int], ...] = ()
    unit_choices: tuple[str, ...] = ()
    chunks: tuple[int, ...] | None = None
    compress: bool = False
    georeferenced: bool = False
    minimum: float | None = None
    maximum: float | None = None
    finite: bool = False
    unit_vector: bool = False
    index_of: str = ""

    @property
    def is_table(self) -> bool:
        """Whether its values are checked when a file is opened; those of maps and crops are checked when read."""
        return len(self.dims) <= 2 and not self.georeferenced


@dataclass(frozen=True)
class Attribute:
    """One root attribute, with its unit in the name where it has one.

    ``kind``: 'text', 'number' (finite), 'integer', or 'json' (text that holds an object), 'json list'; ``minimum`` ..
    ``maximum`` of numbers, ``choices`` of text.
    """

    name: str
    description: str
    required: bool = True
    kind: str = "text"
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()


# Every artefact may carry them; files of other programs need not.
ROOT_ATTRIBUTES = (
    Attribute("schema_version", "version of the schema", False, "integer"),
    Attribute("seed", "seed of every random choice, -1 where nothing is random", False, "integer", -1),
    Attribute("config", "options of the run as JSON", False, "json"),
    Attribute("inputs", "names and SHA-256 of the inputs as JSON", False, "json list"),
    Attribute("provenance", "records of all that the artefact descends from, as JSON", False, "json"),
)


@dataclass(frozen=True)
class Schema:
    """One kind of artefact."""

    name: str
    version: int
    stage: str
    title: str
    dims: dict[str, str]
    variables: tuple[Variable, ...]
    attributes: tuple[Attribute, ...] = ()
    sizes: tuple[tuple[str, int], ...] = ()  # dimensions of a fixed size
    still_read: tuple[int, ...] = ()  # earlier versions, whose files mean the same
    # Other programs also write pairs.h5: such a file need not name its schema, only hold its variables.
    foreign_writers: bool = False

    @functools.cached_property
    def _index(self) -> dict[str, Variable]:
        return {v.name: v for v in self.variables}

    def __getitem__(self, name: str) -> Variable:
        try:
            return self._index[name]
        except KeyError:
            raise RegistryError.unknown(f"variable of {self.name}", name, self._index) from None

    def __contains__(self, name: str) -> bool:
        return name in self._index


SCHEMAS: dict[str, Schema] = {}


def declare(schema: Schema) -> Schema:
    """Register a schema under its name and return it."""
    SCHEMAS[schema.name] = schema
    return schema


def get_schema(name: str) -> Schema:
    """The schema called ``name``; RegistryError lists the choices."""
    try:
        return SCHEMAS[name]
    except KeyError:
        raise RegistryError.unknown("schema", name, SCHEMAS) from None
