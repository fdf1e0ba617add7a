"""Labels of planetary products (PVL of PDS3 and ISIS, PDS4 XML), the times that they hold, and tables of ISIS cubes."""

from __future__ import annotations

import math
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from stages.physics.bodies.ephemeris import et_to_utc, parse_utc
from stages.physics.maps.rasters import open_raster

HEAD = 262144  # bytes in which a label ends
Block = Mapping[str, Any]  # a PVL object or group; keys as written, nested blocks under their kind


def walk(label: Block, kind: str = "root") -> Iterator[tuple[str, Block]]:
    """(kind, block) of a label and of all blocks within it."""
    yield kind, label
    for inner, value in label.items():
        if isinstance(value, dict):
            yield from walk(value, inner)


def find_block(label: Block, kind: str, name: str | None = None) -> Block | None:
    """The first block of that kind (and ``Name``) at any depth, None where there is none; case does not matter."""
    for found, block in walk(label):
        if found.lower() == kind.lower() and (name is None or str(block.get("Name", "")) == name):
            return block
    return None


def find_value(label: Block, key: str) -> Any:
    """The first value under ``key`` at any depth, None where there is none; case does not matter."""
    for _, block in walk(label):
        for name, value in block.items():
            if name.lower() == key.lower() and not isinstance(value, dict):
                return value
    return None


def parse_pvl(text: str, where: str) -> Block:
    """A PVL label up to its END; units are dropped. Raises InputError."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pvl warns of a missing optional package
        import pvl
        from pvl.decoder import OmniDecoder
        from pvl.exceptions import LexerError, ParseError

    class PlainDecoder(OmniDecoder):
        def decode_datetime(self, value: str) -> str:
            raise ValueError(value)  # pvl then takes it for text: digits and time systems stay as they are

        def decode_quantity(self, value: Any, unit: str) -> Any:
            return value

    try:
        return pvl.loads(text, decoder=PlainDecoder())
    except (LexerError, ParseError, ValueError, RecursionError) as error:
        reason = " ".join(str(getattr(error, "msg", error)).split())[:120]
        raise InputError(
            f"{where}: expected a PVL label (KEY = value), found none that can be read ({reason})."
        ) from None


def read_label(path: Path) -> Block | None:
    """The PVL label at the head of a file (ISIS cube, PDS3 IMG or LBL), None where it has none."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    text = head.decode("latin-1").replace("\0", " ")
    if not re.match(
        r"\s*(?:/\*.*?\*/\s*)*(?:PDS_VERSION_ID|Object\s*=\s*IsisCube|CCSD3ZF|ODL_VERSION_ID|[A-Z][A-Z_:]+\s*=)", text
    ):
        return None
    return parse_pvl(text, str(path))


def isis_table(path: Path, label: Block, name: str) -> NDArray[np.float64]:
    """(records, fields) of a table of doubles attached to an ISIS cube. Raises InputError."""
    table = find_block(label, "Table", name)
    if table is None:
        raise InputError(
            f"{path}: expected the SPICE table '{name}' in the cube, found none; run spiceinit on it first."
        )
    fields = [block for kind, block in table.items() if kind == "Field"]
    if any(str(f.get("Type")).lower() != "double" or f.get("Size") != 1 for f in fields):
        raise InputError(f"{path}: expected table '{name}' to hold doubles, found other fields; run spiceinit again.")
    order = "<" if str(table.get("ByteOrder", "Lsb")).lower() == "lsb" else ">"
    with path.open("rb") as file:
        file.seek(int(table["StartByte"]) - 1)
        data = file.read(int(table["Bytes"]))
    records = int(table["Records"])
    if len(data) != 8 * records * len(fields):
        raise InputError(
            f"{path}: expected {records} records in table '{name}', found the file cut short; fetch it again."
        )
    return np.frombuffer(data, f"{order}f8").reshape(records, len(fields)).astype(float)


MICROMETRES = 100.0  # a wavelength below counts as micrometres: labels use both, and their units are dropped


def band_wavelength(path: Path, band: int) -> float:
    """Wavelength at the centre of a band, nm, from an ISIS cube's BandBin or a raster's own tags; NaN where neither says.

    band : counted from 1; GDAL and ENVI write `wavelength` (and its unit) as tags of a band, or describe it as "643 nm"
    """
    if not os.path.isfile(path):  # False, too, for a name that no file can have
        return math.nan
    label = read_label(path) if path.suffix.lower() == ".cub" else None
    centre = find_value(label, "Center") if label is not None else None
    if centre is None:
        centre = _tagged_wavelength(path, band)
    elif isinstance(centre, list):
        centre = centre[band - 1] if band <= len(centre) else None
    try:
        value = float(centre)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return math.nan
    return math.nan if not value > 0 else 1000 * value if value < MICROMETRES else value


def _tagged_wavelength(path: Path, band: int) -> str | None:
    """What a raster's tags or the description of its band hold; None where GDAL cannot open it."""
    try:
        with open_raster(path) as dataset:
            if band > dataset.count:
                return None
            tags = {key.lower(): value for key, value in dataset.tags(band).items()}
            named = re.search(
                r"(\d+(?:\.\d+)?)\s*(?:nm|um|micromet|nanomet)", dataset.descriptions[band - 1] or "", re.I
            )
    except InputError:
        return None
    return tags.get("wavelength") or (named.group(1) if named else None)


# --- times ----------------------------------------------------------------------------------------------------------

_LROC_ID = re.compile(r"(?<![A-Z0-9])M(\d{9,10})([LR]|[CMVU])[EC]?", re.IGNORECASE)
LROC_EPOCH = (
    198632799.6  # ephemeris time of product number 0, s; from 2009 to 2015 the clock stayed within 0.6 s of that
)
_TIME_KEYS = ("START_TIME", "StartTime", "IMAGE_TIME")


def product_time(product_id: str) -> str | None:
    """UTC of an LROC product id such as M143947267LE, good to about a second; None for other names.

    The number counts the clock's seconds; from 2011 on it has ten digits and counts from 900,000,000 higher.
    """
    match = _LROC_ID.search(product_id)
    if match is None:
        return None
    number = int(match.group(1))
    if len(match.group(1)) == 10:
        number -= 900_000_000
    return et_to_utc(number + LROC_EPOCH)


def label_time(path: Path) -> str | None:
    """The start of the exposure, UTC, from a product's own label or the one beside it; None where there is none.

    Reads PDS3 labels (attached or .LBL), PDS4 labels (.xml) and ISIS cubes.
    """
    for candidate in (path, *_labels_beside(path)):
        if not candidate.is_file():
            continue
        if candidate.suffix.lower() == ".xml":
            found = _pds4_time(candidate)
        else:
            label = read_label(candidate)
            found = next((v for k in _TIME_KEYS if label is not None and (v := find_value(label, k))), None)
        if found is not None and str(found).upper() not in ("NULL", "UNK", "N/A"):
            parse_utc(str(found), f"{candidate}: start time")
            return str(found)
    return None


def _labels_beside(path: Path) -> list[Path]:
    if not path.name:  # '.', which the stage refuses
        return []
    return [path.with_suffix(s) for s in (".lbl", ".LBL", ".xml", ".XML") if path.suffix != s]


def _pds4_time(path: Path) -> str | None:
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: expected a PDS4 label, found broken XML ({error}).") from None
    for element in root.iter():
        if element.tag.rsplit("}", 1)[-1] == "start_date_time" and element.text:
            return element.text.strip()
    return None
