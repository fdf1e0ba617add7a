"""Which spellings of a unit are equal, as CF and UDUNITS have them. Nothing is converted."""

from __future__ import annotations

_SPELLINGS = {
    "1": ("1", "dimensionless", "unitless"),
    "m": ("m", "metre", "metres", "meter", "meters"),
    "m2": ("m2", "m^2", "m**2", "square_metre", "square_meter"),
    "s": ("s", "sec", "second", "seconds"),
    "px": ("px", "pixel", "pixels"),
    "dn": ("dn", "digital_number", "digital_numbers"),
    "au": ("au", "ua", "astronomical_unit", "astronomical_units"),
    # CF's for longitudes and latitudes are degrees too; west and south would count the other way
    "degree": ("deg", "degree", "degrees", "arc_degree", "arc_degrees", "°")
    + tuple(f"degree{s}{end}" for s in ("", "s") for end in ("_east", "_north", "_true", "_e", "_n", "_t", "e", "n", "t")),
}  # fmt: skip
_NAMES = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings}


def unit_name(text: str) -> str:
    """The one spelling of a unit that declarations use, for any equal one; text that is none of these stays."""
    return _NAMES.get("_".join(text.lower().split()), text)
