"""PDS3 index tables (CUMINDEX.TAB, INDEX.TAB) in place of an image table."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Mapping
from pathlib import Path

from schemas.errors import InputError
from stages.physics.images.labels import read_label, walk


def read_index(path: Path) -> list[dict[str, str]]:
    """The rows of a PDS3 index table (CUMINDEX.TAB, INDEX.TAB), by the column names of its label beside it.

    path : the table or its label. Raises InputError.
    """
    label_path, table_path = _index_pair(path)
    label = read_label(label_path)
    table = next((b for kind, b in walk(label or {}) if kind.upper().endswith("TABLE")), None)
    if table is None:
        raise InputError(f"{label_path}: expected the PDS3 label of an index table, found none in it.")
    columns = [b for kind, b in table.items() if kind.upper() == "COLUMN"]
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


# Our column -> its name in indices (LROC, MESSENGER MDIS; degrees, longitudes east, km), the factor to our unit and the
# possible values: archives fill unknown ones with -9999, 1E32 and the like.
INDEX_COLUMNS: Mapping[str, tuple[str, float, float, float]] = {
    "subsolar_longitude_deg": ("SUB_SOLAR_LONGITUDE", 1.0, -360.0, 360.0),
    "subsolar_latitude_deg": ("SUB_SOLAR_LATITUDE", 1.0, -90.0, 90.0),
    "solar_distance_au": ("SOLAR_DISTANCE", 1.0 / 149597870.7, 0.1, 100.0),
    "spacecraft_longitude_deg": ("SUB_SPACECRAFT_LONGITUDE", 1.0, -360.0, 360.0),
    "spacecraft_latitude_deg": ("SUB_SPACECRAFT_LATITUDE", 1.0, -90.0, 90.0),
    "spacecraft_altitude_m": ("SPACECRAFT_ALTITUDE", 1000.0, 1.0, 1e11),
}
# of LROC and CTX, of HiRISE; MESSENGER's indices split it into PATH_NAME and FILE_NAME
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
        image = image or _find_in_archive(folder, named, listings)
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
    """Path of a row's product, relative to the volume or the archive."""
    named = next((row[k] for k in _FILE_COLUMNS if row.get(k)), "")
    if not named and row.get("FILE_NAME"):
        named = f"{row.get('PATH_NAME', '')}/{row['FILE_NAME']}"
    return named.replace("\\", "/").lstrip("/")  # some begin at the server's root


def _find_in_archive(folder: Path, named: str, listings: dict[Path, frozenset[str]]) -> Path | None:
    """The named file under the index's folder or one above it, whichever part of the archive's tree is there.

    listings : file names by folder, filled on the way
    """
    parts = Path(named).parts
    for first in range(len(parts)):
        for parent in (folder, *list(folder.parents)[:4]):
            place = parent.joinpath(*parts[first:-1])
            if place not in listings:
                listings[place] = frozenset(os.listdir(place)) if place.is_dir() else frozenset()
            if parts[-1] in listings[place]:
                return place / parts[-1]
    return None
