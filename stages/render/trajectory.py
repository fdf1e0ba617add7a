"""A table of views: one row per camera position, nadir or oblique, each with its own Sun where it names one."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from schemas.errors import InputError
from schemas.files.user_files import parse_csv, parse_number, read_text
from stages.render.config import SUN

_QUATERNION = ("qw", "qx", "qy", "qz")
_NUMBERS = (
    "longitude_deg",
    "latitude_deg",
    "altitude_m",
    "height_m",
    "look_longitude_deg",
    "look_latitude_deg",
    "look_altitude_m",
    *_QUATERNION,
    "roll_deg",
    "fov_deg",
    "subsolar_longitude_deg",
    "subsolar_latitude_deg",
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "solar_distance_au",
    "time_s",
)
_KNOWN = ("view_id", "time", *_NUMBERS)


@dataclass(frozen=True)
class ViewRow:
    """One row: place and target (degrees, degrees, metres above the sphere) or attitude, and what replaces the command's options.

    height : m above the ground, in place of the position's altitude, or None
    seconds : since any moment, of the row's pose; None where it has no time
    fov_deg : None for the command's own; sun : fields of ``Config`` by name, empty for the command's own Sun
    """

    view_id: str
    position: tuple[float, float, float]
    height: float | None
    look_at: tuple[float, float, float] | None
    quaternion: tuple[float, float, float, float] | None
    roll_deg: float
    fov_deg: float | None
    sun: dict[str, float | str]
    seconds: float | None = None


def read_trajectory(path: Path) -> list[ViewRow]:
    """Read and check a trajectory table. Raises InputError naming the row and column."""
    what = "a trajectory (CSV, one row per view)"
    lines = [line for line in read_text(path, what).splitlines() if not line.lstrip().startswith("#")]
    names, records = parse_csv(path, "\n".join(lines), what)
    for name in ("longitude_deg", "latitude_deg", "altitude_m"):
        if name not in names and not (name == "altitude_m" and "height_m" in names):
            raise InputError(f"{path}: expected a column '{name}', found {', '.join(names) or 'nothing'}; add it.")
    unknown = [name for name in names if name not in _KNOWN]
    if unknown:
        raise InputError(f"{path}: unknown column '{unknown[0]}'; known are: {', '.join(_KNOWN)}.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: expected each column once, found '{twice[0]}' twice; remove one.")
    rows = [_row(path, number, record) for number, record in enumerate(records, start=1)]
    if not rows:
        raise InputError(f"{path}: expected at least one view, found none; write one row per view.")
    seen: set[str] = set()
    for row in rows:
        if row.view_id in seen:
            raise InputError(
                f"{path}: expected each view_id once, found '{row.view_id}' twice; give each row a name of its own."
            )
        seen.add(row.view_id)
    return rows


def _row(path: Path, number: int, record: dict[str | None, Any]) -> ViewRow:
    where = f"{path}: view {number}"
    if None in record:
        raise InputError(f"{where}: expected as many cells as columns, found more; correct the row.")
    text = {k: (v or "").strip() for k, v in record.items() if k is not None and not isinstance(v, list)}
    value: dict[str, float] = {}
    for name in _NUMBERS:
        if not text.get(name):
            continue
        try:
            value[name] = parse_number(text[name])
        except ValueError:
            value[name] = math.nan
        if not math.isfinite(value[name]):
            raise InputError(f"{where}: expected a number in column '{name}', found '{text[name]}'; correct it.")
    if "altitude_m" in value and "height_m" in value:
        raise InputError(f"{where}: expected altitude_m (above the sphere) or height_m (above the ground), found both.")
    altitude = "height_m" if "height_m" in value else "altitude_m"
    for name in ("longitude_deg", "latitude_deg", altitude):
        if name not in value:
            raise InputError(f"{where}: expected a number in column '{name}', found nothing; fill it in.")
    look_at = None
    if "look_longitude_deg" in value or "look_latitude_deg" in value:
        if "look_longitude_deg" not in value or "look_latitude_deg" not in value:
            raise InputError(
                f"{where}: expected both look_longitude_deg and look_latitude_deg, found one; give both or none."
            )
        look_at = (value["look_longitude_deg"], value["look_latitude_deg"], value.get("look_altitude_m", math.nan))
    quaternion = None
    given = [q for q in _QUATERNION if q in value]
    if given:
        if len(given) < 4 or look_at is not None:
            raise InputError(
                f"{where}: expected either a place to look at or all of qw, qx, qy, qz, found both or too few; keep one of them."
            )
        quaternion = tuple(value[q] for q in _QUATERNION)
    sun: dict[str, float | str] = {name: value[name] for name in SUN if name in value}
    if text.get("time"):
        sun["time"] = text["time"]
    view_id = text.get("view_id") or f"view_{number:04d}"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", view_id):
        raise InputError(
            f"{where}: expected a view_id that can name a file (letters, digits, . _ -), found '{view_id}'; rename the view."
        )
    return ViewRow(
        view_id=view_id,
        position=(value["longitude_deg"], value["latitude_deg"], value.get("altitude_m", math.nan)),
        height=value.get("height_m"),
        look_at=look_at,
        quaternion=quaternion,  # type: ignore[arg-type]
        roll_deg=value.get("roll_deg", 0.0),
        fov_deg=value.get("fov_deg"),
        sun=sun,
        seconds=_seconds(value, text, where),
    )


def _seconds(value: dict[str, float], text: dict[str, str], where: str) -> float | None:
    """When the row's pose is taken, s: from ``time_s``, else from ``time``. Raises InputError."""
    if "time_s" in value or not text.get("time"):
        return value.get("time_s")
    from stages.physics.bodies.ephemeris import utc_to_et  # slow to import

    try:
        return utc_to_et(text["time"])
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
