"""What an artefact is: dimensions, variables, units and root attributes, declared once and used everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field

from schemas.errors import RegistryError

STRING = "string"  # a variable-length UTF-8 string, netCDF's NC_STRING


@dataclass(frozen=True)
class Variable:
    """One variable of an artefact.

    ``unit`` is a UDUNITS string, ``"1"`` for pure numbers, ``"dn"`` among ``unit_choices`` where images may be uncalibrated;
    ``flags`` maps meaning -> value for flag variables; ``compress`` is for masks, which deflate to nothing.
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


@dataclass(frozen=True)
class Attribute:
    """One root attribute, with its unit in the name where it has one."""

    name: str
    description: str
    required: bool = True


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
    # Other programs also write pairs.h5: such a file need not name its schema, only hold its variables.
    foreign_writers: bool = False
    _index: dict[str, Variable] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._index.update({v.name: v for v in self.variables})

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
