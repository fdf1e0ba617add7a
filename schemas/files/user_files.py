"""Reading the user's own text, JSON and CSV files; devices and pipes are refused."""

from __future__ import annotations

import csv
import difflib
import io
import os
import stat
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from schemas.checks import parse_json
from schemas.errors import InputError, LunargrError

LARGEST_TEXT = 1 << 30  # bytes: PDS indices have hundreds of megabytes


def check_file(path: Path, expected: str, error: type[LunargrError] = InputError) -> None:
    """Refuse what is no regular file, before it is read. expected : what it should be, in words. Raises ``error``."""
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise error(f"{path}: no such file; expected {expected}. Check the path.") from None
    except (OSError, ValueError) as problem:
        why = getattr(problem, "strerror", None) or problem
        raise error(f"{path}: expected {expected}, cannot be read ({why}); check its name and permissions.") from None
    if stat.S_ISDIR(mode):
        raise error(f"{path}: expected {expected}, found a folder; name the file in it.")
    if not stat.S_ISREG(mode):
        raise error(f"{path}: expected {expected}, found a device or a pipe; write it to a file and name that.")


def read_text(path: Path, expected: str, encoding: str = "utf-8-sig") -> str:
    """The text of a file. expected : what it should hold, for error lines. Raises InputError."""
    check_file(path, expected)
    try:
        if path.stat().st_size > LARGEST_TEXT:
            raise InputError(
                f"{path}: expected {expected}, found a file of more than {LARGEST_TEXT >> 20} MiB; is it the right one?"
            )
        return path.read_text(encoding=encoding)
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected {expected}, found something else than UTF-8 text (byte {error.start}); convert it (iconv -t utf-8)."
        ) from None
    except OSError as error:
        raise InputError(
            f"{path}: expected {expected}, cannot be read ({error.strerror}); check its permissions."
        ) from None


def parse_number(text: str) -> float:
    """A number of a table. Raises ValueError, also for what only Python takes for one: '1_0', digits of other scripts."""
    if "_" in text or not text.isascii():
        raise ValueError(f"expected a number, found '{text}'")
    return float(text)


def read_json(path: Path, expected: str) -> Any:
    """The content of a JSON file. expected : what it should hold, for error lines. Raises InputError."""
    return parse_json(read_text(path, expected), f"{path}: expected {expected}", InputError, "mend the file")


def parse_csv(path: Path, text: str, expected: str) -> tuple[list[str], list[dict[str | None, Any]]]:
    """Column names and rows of the text of a CSV file. expected : what it should hold, for error lines. Raises InputError."""
    reader = csv.DictReader(io.StringIO(text, newline=""))
    try:
        names = reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        rows = list(reader)
    except csv.Error as error:
        raise InputError(
            f"{path}: expected {expected}, found no CSV that can be read ({error}); mend the file."
        ) from None
    for number, row in enumerate(rows, start=1):
        if any(row.get(None, ())):
            raise InputError(
                f"{path}: expected {len(names)} cells in row {number}, as in the header, found more; mend the file."
            )
    return names, rows


def check_keys(found: Iterable[object], known: Collection[str], where: str) -> None:
    """Refuse keys of a JSON object that are not known: a misspelt one would be ignored. Raises InputError."""
    unknown = [str(key) for key in found if key not in known]
    if unknown:
        raise InputError(
            f"{where}: unknown key '{unknown[0]:.60}'{_meant(unknown[0], known)}; the keys are: {', '.join(known)}."
        )


def check_columns(found: Iterable[object], known: Collection[str], where: str) -> None:
    """Refuse columns that look like misspelt ones; others may be there for people. Raises InputError."""
    for name in found:
        if isinstance(name, str) and name not in known and (meant := _meant(name, known)):
            raise InputError(f"{where}: unknown column '{name:.60}'{meant}; rename or remove it.")


def _meant(name: str, known: Collection[str]) -> str:
    """', did you mean ...' where a known name is close."""
    close = difflib.get_close_matches(name.strip().lower(), [k.lower() for k in known], 1, cutoff=0.8)
    return f", did you mean '{close[0]}'?" if close else ""
