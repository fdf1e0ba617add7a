"""Labels of planetary products: PVL (PDS3, ISIS), PDS4 XML, the times they hold, ISIS tables, and product ids of LROC."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from stages.physics.bodies.ephemeris import et_to_utc, parse_utc

HEAD = 262144  # bytes in which a label ends
_TOKEN = re.compile(
    r"""\s*(?:/\*.*?\*/\s*)*(?:\#[^\n]*\n\s*)*   # blanks and comments
    (?P<token>"[^"]*" | '[^']*' | <[^>]*> | [(){},=] | [^\s(){},="<]+)""",
    re.VERBOSE | re.DOTALL,
)
_OPEN, _CLOSE = {"object", "group", "begin_object", "begin_group"}, {"end_object", "end_group"}


# --- PVL ------------------------------------------------------------------------------------------------------------


class Block(dict[str, Any]):
    """A PVL object or group: keys as written, in order; ``kind`` its name. Nested blocks of one name make a list."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind
        self.blocks: list[Block] = []

    def find(self, kind: str, name: str | None = None) -> Block | None:
        """The first block of that kind (and ``Name``) at any depth; case does not matter."""
        for block in self.walk():
            if block.kind.lower() == kind.lower() and (name is None or str(block.get("Name", "")) == name):
                return block
        return None

    def walk(self) -> Iterator[Block]:
        yield self
        for block in self.blocks:
            yield from block.walk()

    def lookup(self, key: str) -> Any:
        """The first value under ``key`` at any depth, None where there is none; case does not matter."""
        for block in self.walk():
            for name, value in block.items():
                if name.lower() == key.lower():
                    return value
        return None


def parse_pvl(text: str, where: str) -> Block:
    """A PVL label up to its END. Raises InputError."""
    text = re.sub(r"-\r?\n\s*", "", text)  # words that are broken over two lines, quoted or not
    tokens = [m.group("token") for m in _TOKEN.finditer(text)]
    root = Block("root")
    stack = [root]
    i = 0
    while i < len(tokens):
        word = tokens[i]
        lowered = word.lower()
        if lowered == "end":
            break
        if lowered in _CLOSE:
            if len(stack) == 1:
                raise InputError(f"{where}: expected a PVL label, found '{word}' that closes nothing.")
            stack.pop()
            i += 3 if i + 1 < len(tokens) and tokens[i + 1] == "=" else 1
            continue
        if i + 2 >= len(tokens) or tokens[i + 1] != "=":
            raise InputError(f"{where}: expected a PVL label (KEY = value), found '{word[:40]}'.")
        value, i = _value(tokens, i + 2)
        if lowered in _OPEN:
            block = Block(str(value))
            stack[-1].blocks.append(block)
            stack.append(block)
        else:
            stack[-1][word] = value
    return root


def _value(tokens: list[str], i: int) -> tuple[Any, int]:
    token = tokens[i]
    value: Any
    if token in "({":
        value, i = [], i + 1
        while i < len(tokens) and tokens[i] not in ")}":
            if tokens[i] == ",":
                i += 1
                continue
            item, i = _value(tokens, i)
            value.append(item)
        i += 1
    else:
        value, i = _scalar(token), i + 1
    if i < len(tokens) and tokens[i].startswith("<"):  # a unit
        i += 1
    return value, i


def _scalar(token: str) -> Any:
    if token[0] in "\"'":
        return re.sub(r"\s*\n\s*", " ", token[1:-1])
    for kind in (int, float):
        try:
            return kind(token)
        except ValueError:
            continue
    return token


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
    table = label.find("Table", name)
    if table is None:
        raise InputError(
            f"{path}: expected the SPICE table '{name}' in the cube, found none; run spiceinit on it first."
        )
    fields = [block for block in table.blocks if block.kind == "Field"]
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


# --- times ----------------------------------------------------------------------------------------------------------

_LROC_ID = re.compile(r"(?<![A-Z0-9])M(\d{9,10})([LR]|[CMVU])[EC]?", re.IGNORECASE)
LROC_EPOCH = 198632799.6  # ephemeris time of product number 0, s; the clock stayed within 0.6 s of it from 2009 to 2015
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
            found = next((v for k in _TIME_KEYS if label is not None and (v := label.lookup(k))), None)
        if found is not None and str(found).upper() not in ("NULL", "UNK", "N/A"):
            parse_utc(str(found), f"{candidate}: start time")
            return str(found)
    return None


def _labels_beside(path: Path) -> list[Path]:
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


# --- PDS3 index tables ----------------------------------------------------------------------------------------------


def read_index(path: Path) -> list[dict[str, str]]:
    """The rows of a PDS3 index table (CUMINDEX.TAB, INDEX.TAB), by the column names of its label beside it.

    path : the table or its label. Raises InputError.
    """
    label_path, table_path = _index_pair(path)
    label = read_label(label_path)
    table = next((b for b in label.walk() if b.kind.upper().endswith("TABLE")), None) if label is not None else None
    if table is None:
        raise InputError(f"{label_path}: expected the PDS3 label of an index table, found none in it.")
    columns = [b for b in table.blocks if b.kind.upper() == "COLUMN"]
    try:
        spans = [(str(c["NAME"]).upper(), int(c["START_BYTE"]) - 1, int(c["BYTES"])) for c in columns]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{label_path}: expected NAME, START_BYTE and BYTES for each column of the index.") from None
    if not spans:
        raise InputError(f"{label_path}: expected the index's columns, found none.")
    rows = []
    for number, line in enumerate(table_path.read_text(encoding="latin-1").splitlines(), start=1):
        if not line.strip():
            continue
        if len(line) < max(start for _, start, _ in spans):
            raise InputError(
                f"{table_path}: row {number}: expected {spans[-1][1] + spans[-1][2]} characters, found {len(line)}."
            )
        rows.append({name: line[start : start + length].strip().strip('"').strip() for name, start, length in spans})
    if not rows:
        raise InputError(f"{table_path}: expected at least one product, found none.")
    return rows


def _index_pair(path: Path) -> tuple[Path, Path]:
    """(label, table) of an index, whichever is given."""
    is_label = path.suffix.lower() == ".lbl"
    wanted = (".TAB", ".tab") if is_label else (".LBL", ".lbl")
    other = next((path.with_suffix(s) for s in wanted if path.with_suffix(s).is_file()), None)
    if other is None:
        what = "table" if is_label else "label"
        raise InputError(
            f"{path}: expected its {what} '{path.with_suffix(wanted[0]).name}' beside it, found none; fetch it too."
        )
    return (path, other) if is_label else (other, path)


# Our column -> what indices call it (LROC, MESSENGER MDIS; degrees, longitudes east, km), the factor to our unit and the
# values that can be: archives fill what they do not know with -9999, 1E32 and the like.
INDEX_COLUMNS: Mapping[str, tuple[str, float, float, float]] = {
    "subsolar_longitude_deg": ("SUB_SOLAR_LONGITUDE", 1.0, -360.0, 360.0),
    "subsolar_latitude_deg": ("SUB_SOLAR_LATITUDE", 1.0, -90.0, 90.0),
    "solar_distance_au": ("SOLAR_DISTANCE", 1.0 / 149597870.7, 0.1, 100.0),
    "spacecraft_longitude_deg": ("SUB_SPACECRAFT_LONGITUDE", 1.0, -360.0, 360.0),
    "spacecraft_latitude_deg": ("SUB_SPACECRAFT_LATITUDE", 1.0, -90.0, 90.0),
    "spacecraft_altitude_m": ("SPACECRAFT_ALTITUDE", 1000.0, 1.0, 1e11),
}
# LROC's and CTX's; HiRISE's. MESSENGER's indices split it into PATH_NAME and FILE_NAME.
_FILE_COLUMNS = ("FILE_SPECIFICATION_NAME", "FILE_NAME_SPECIFICATION")
_INDEX_TIMES = ("START_TIME", "IMAGE_TIME", "OBSERVATION_START_TIME")
IMAGE_SUFFIXES = (".tif", ".tiff", ".cub", ".img", ".png", ".xml")


def index_images(path: Path) -> list[dict[str, str]]:
    """The rows of an index in the columns of ``images.csv``, for the products whose images lie nearby.

    An image is looked for where the index names it and beside the index, with any usual ending (a calibrated or
    map-projected copy of the product keeps its id), with a camera model ``ID*.json`` beside it where there is one.
    Distances in an index are kilometres. Raises InputError where no product has an image.
    """
    rows = read_index(path)
    folder = path.parent
    found = []
    nearby = {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_file()}
    names = sorted(nearby)
    listings: dict[Path, frozenset[str]] = {}
    for row in rows:
        named = _index_file(row)
        product = row.get("PRODUCT_ID", "") or Path(named).stem
        first, last = (bisect_left(names, product.lower() + end) for end in ("", chr(0x10FFFF)))
        candidates = [nearby[name] for name in names[first:last]] if product else []
        image = next((p for s in IMAGE_SUFFIXES for p in candidates if p.suffix.lower() == s), None)
        image = image or _below(folder, named, listings)
        if image is None:
            continue
        camera = next((p for p in candidates if p.suffix.lower() == ".json"), None)
        ours = {
            "image_id": product,
            "path": os.path.relpath(image.resolve(), folder.resolve()),
            "camera": camera.name if camera else "",
            "units": "iof" if ".cal" in image.name.lower() or ".iof" in image.name.lower() else "dn",
            "start_time": next((row[k] for k in _INDEX_TIMES if row.get(k)), ""),
        }
        for key, (name, factor, low, high) in INDEX_COLUMNS.items():
            try:
                value = float(row[name]) * factor
            except (KeyError, ValueError):
                continue
            if low <= value <= high:
                ours[key] = repr(value)
        found.append(ours)
    if not found:
        raise InputError(
            f"{path}: expected an image of at least one of its {len(rows)} products near it, found none; put them beside it."
        )
    return found


def _index_file(row: Mapping[str, str]) -> str:
    """Where a row says that its product is, relative to the volume or the archive."""
    named = next((row[k] for k in _FILE_COLUMNS if row.get(k)), "")
    if not named and row.get("FILE_NAME"):
        named = f"{row.get('PATH_NAME', '')}/{row['FILE_NAME']}"
    return named.replace("\\", "/").lstrip("/")  # some begin at the server's root


def _below(folder: Path, named: str, listings: dict[Path, frozenset[str]]) -> Path | None:
    """The named file under the index's folder or one above it, whatever part of the archive's tree was kept."""
    parts = Path(named).parts
    for first in range(len(parts)):
        for parent in (folder, *list(folder.parents)[:4]):
            place = parent.joinpath(*parts[first:-1])
            if place not in listings:
                listings[place] = frozenset(os.listdir(place)) if place.is_dir() else frozenset()
            if parts[-1] in listings[place]:
                return place / parts[-1]
    return None
