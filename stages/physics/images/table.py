"""The image table: one frame per source image, with its Sun and its camera. `images.csv`, or JSON with the same keys."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from schemas.checks import has_control_characters
from schemas.errors import InputError
from schemas.files.user_files import (
    check_columns,
    check_file,
    check_keys,
    parse_csv,
    parse_number,
    read_json,
    read_text,
)
from schemas.reading import read_strings
from schemas.writing import ArtefactWriter
from stages.physics.bodies.ephemeris import AU, parse_utc
from stages.physics.bodies.spheres import Body, find_body
from stages.physics.cameras.isis_cube import is_own_camera
from stages.physics.images.frame_geometry import complete_row
from stages.physics.images.labels import band_wavelength
from stages.physics.images.pds_index import index_images
from stages.physics.maps.grid import unit_vectors

_NUMBERS = {
    "subsolar_longitude_deg": (-360.0, 360.0),
    "subsolar_latitude_deg": (-90.0, 90.0),
    "solar_distance_au": (0.05, 100.0),
    "spacecraft_longitude_deg": (-360.0, 360.0),
    "spacecraft_latitude_deg": (-90.0, 90.0),
    "spacecraft_altitude_m": (1.0, 1e10),
}
MOST_BANDS = 65535
COLUMNS = ("image_id", "path", "units", "camera", "band", "angles", "start_time", *_NUMBERS)


@dataclass(frozen=True)
class Frame:
    """One source image.

    units : 'iof' or 'dn'; camera : its camera model, ``path`` again for an ISIS cube, None for map-projected images
    sha256, camera_sha256 : digests of both files, empty before they are read
    band : which one of the file, counted from 1, None for its only one; wavelength_nm : its centre, NaN where not known
    angles : file of its phase, emission and incidence, as from ISIS phocube
    """

    image_id: str
    path: Path
    units: str
    camera: Path | None
    start_time: str
    subsolar_longitude_deg: float
    subsolar_latitude_deg: float
    solar_distance_au: float
    spacecraft_longitude_deg: float
    spacecraft_latitude_deg: float
    spacecraft_altitude_m: float
    sha256: str = ""
    camera_sha256: str = ""
    band: int | None = None
    wavelength_nm: float = math.nan
    angles: Path | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that it names."""
        return tuple(path for path in (self.path, self.camera, self.angles) if path is not None)

    def sun_position(self) -> np.ndarray:
        """(3,) body-fixed position of the Sun, m."""
        direction = unit_vectors(self.subsolar_longitude_deg, self.subsolar_latitude_deg)
        return direction * self.solar_distance_au * AU

    def camera_position(self, radius: float) -> np.ndarray:
        """(3,) body-fixed position of the spacecraft, m, over a body of that radius, m."""
        direction = unit_vectors(self.spacecraft_longitude_deg, self.spacecraft_latitude_deg)
        return direction * (radius + self.spacecraft_altitude_m)


def read_frames(table: Path, body: Body | None = None) -> list[Frame]:
    """Read and check an image table, or a PDS3 index (CUMINDEX.TAB) in its place.

    What the table leaves empty is taken from the camera model, the image's label or its time: see frame_geometry.
    Raises InputError naming the row and column.
    """
    what = "the image table (images.csv or JSON)"
    check_file(table, what)
    if table.suffix.lower() in (".tab", ".lbl"):
        return _frames(table, index_images(table), body)
    if table.suffix.lower() == ".json":
        rows = read_json(table, what)
        rows = rows.get("images", []) if isinstance(rows, Mapping) else rows
        if not (isinstance(rows, list) and all(isinstance(row, Mapping) for row in rows)):
            raise InputError(
                f"{table}: expected a JSON list of objects, one per image with the keys of images.csv, found another structure; "
                "mend the file."
            )
        for number, row in enumerate(rows, start=1):
            check_keys(row, COLUMNS, f"{table}: image {number}")
    else:
        names, rows = parse_csv(table, read_text(table, what), what)
        check_columns(names, COLUMNS, str(table))
    if not rows:
        raise InputError(f"{table}: expected at least one image, found none; mend the table.")
    return _frames(table, rows, body)


def _frames(table: Path, rows: Sequence[Mapping[str, Any]], body: Body | None) -> list[Frame]:
    body = body or find_body("moon")
    frames = [_frame(table, number, row, body) for number, row in enumerate(rows, start=1)]
    seen: set[str] = set()
    for frame in frames:
        if frame.image_id in seen:
            raise InputError(f"{table}: expected each image_id once, found '{frame.image_id}' twice; mend the table.")
        seen.add(frame.image_id)
    return frames


def _frame(table: Path, number: int, row: Mapping[str, Any], body: Body) -> Frame:
    where = f"{table}: image {number}"
    text = {str(k): ("" if v is None else str(v).strip()) for k, v in row.items() if k is not None}
    for key in ("image_id", "path"):
        if not text.get(key):
            raise InputError(f"{where}: expected a value in column '{key}', found none; mend the table.")
    for key, cell in text.items():
        if has_control_characters(cell):
            raise InputError(
                f"{where}: expected text without control characters in column '{key}', found {cell!r}; mend the table."
            )
    where = f"{where} ({text['image_id']})"
    units = text.get("units", "").lower()
    if units not in ("iof", "dn"):
        raise InputError(f"{where}: expected units 'iof' or 'dn', found '{units or 'nothing'}'; mend the table.")
    image = table.parent / text["path"]
    camera = table.parent / text["camera"] if text.get("camera") else None
    if camera is None and is_own_camera(image):
        camera = image
    text = complete_row(text, image, camera, body, where)
    if text.get("start_time"):
        parse_utc(text["start_time"], f"{where}: column 'start_time'")
    numbers: dict[str, Any] = {}
    for key, (low, high) in _NUMBERS.items():
        try:
            value = parse_number(text.get(key, ""))
        except ValueError:
            raise InputError(
                f"{where}: expected a number in column '{key}', found '{text.get(key, '') or 'nothing'}'; mend the table."
            ) from None
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"{where}: expected '{key}' in {low:g}..{high:g}, found {value:g}; mend the table.")
        numbers[key] = value
    return Frame(
        image_id=text["image_id"],
        path=image,
        units=units,
        camera=camera,
        start_time=text.get("start_time", ""),
        angles=table.parent / text["angles"] if text.get("angles") else None,
        band=(band := _band(text.get("band", ""), where)),
        wavelength_nm=band_wavelength(image, band or 1),
        **numbers,
    )


def _band(text: str, where: str) -> int | None:
    """The column 'band', None where it is empty. Raises InputError."""
    if not text:
        return None
    if not (text.isdecimal() and 1 <= int(text) <= MOST_BANDS):
        raise InputError(
            f"{where}: expected the number of a band, 1..{MOST_BANDS}, in column 'band', found '{text}'; mend the table."
        )
    return int(text)


def write_frames(writer: ArtefactWriter, frames: Sequence[Frame]) -> None:
    """Write the frame table of a scene or crops artefact; paths become relative to it."""
    folder = writer.path.resolve().parent
    writer.write("image_id", [f.image_id for f in frames])
    writer.write("path", [relative_path(f.path, folder) for f in frames])
    writer.write("camera", [relative_path(f.camera, folder) if f.camera else "" for f in frames])
    writer.write("angles", [relative_path(f.angles, folder) if f.angles else "" for f in frames])
    writer.write("start_time", [f.start_time for f in frames])
    if all(f.sha256 for f in frames):
        writer.write("sha256", [f.sha256 for f in frames])
        writer.write("camera_sha256", [f.camera_sha256 for f in frames])
    writer.write("band", np.array([f.band or 0 for f in frames], np.uint16))
    writer.write("wavelength_nm", np.array([f.wavelength_nm for f in frames]))
    writer.write("units", np.array([0 if f.units == "iof" else 1 for f in frames], np.uint8))
    for key in _NUMBERS:
        writer.write(key, np.array([getattr(f, key) for f in frames]))


def load_frames(file: h5py.File, path: Path) -> list[Frame]:
    """The frame table of a scene or crops artefact at ``path``."""
    folder = path.resolve().parent
    names, paths, cameras, times = (read_strings(file, k) for k in ("image_id", "path", "camera", "start_time"))
    columns: dict[str, Any] = {key: file[key][...].tolist() for key in _NUMBERS}
    columns |= {k: read_strings(file, k) for k in ("sha256", "camera_sha256") if k in file}
    columns |= {"angles": [folder / a if a else None for a in read_strings(file, "angles")]} if "angles" in file else {}
    columns |= {"band": [int(b) or None for b in file["band"][...]]} if "band" in file else {}
    columns |= {"wavelength_nm": file["wavelength_nm"][...].tolist()} if "wavelength_nm" in file else {}
    return [
        Frame(
            image_id=names[k],
            path=folder / paths[k],
            units="dn" if file["units"][k] else "iof",
            camera=folder / cameras[k] if cameras[k] else None,
            start_time=times[k],
            **{key: column[k] for key, column in columns.items()},
        )
        for k in range(len(names))
    ]


def relative_path(path: Path, folder: Path) -> str:
    """``path`` as seen from ``folder``: artefacts name their sources so that a folder can move as a whole."""
    return os.path.relpath(path.resolve(), folder)
