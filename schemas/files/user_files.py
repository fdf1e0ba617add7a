"""The user's own files: regular ones only, and text of a size that can be text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from schemas.checks import parse_json
from schemas.errors import InputError

LARGEST_TEXT = 1 << 30  # bytes: PDS indices have hundreds of megabytes


def check_file(path: Path, what: str) -> None:
    """Refuse what is missing, a folder, a device or a pipe, before anything is read of it. Raises InputError."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: expected {what}, found a folder; name the file in it.")
    if not path.exists():
        raise InputError(f"{path}: no such file; expected {what}. Check the path.")
    if not path.is_file():
        raise InputError(f"{path}: expected {what}, found a device or a pipe; write it to a file and name that.")


def read_text(path: Path, what: str, encoding: str = "utf-8-sig") -> str:
    """The text of a file. Raises InputError."""
    check_file(path, what)
    try:
        if path.stat().st_size > LARGEST_TEXT:
            raise InputError(
                f"{path}: expected {what}, found a file of more than {LARGEST_TEXT >> 20} MiB; is it the right one?"
            )
        return path.read_text(encoding=encoding)
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected {what}, found something else than UTF-8 text (byte {error.start}); convert it (iconv -t utf-8)."
        ) from None
    except OSError as error:
        raise InputError(
            f"{path}: expected {what}, cannot be read ({error.strerror}); check its permissions."
        ) from None


def read_json(path: Path, what: str) -> Any:
    """What a JSON file holds. Raises InputError."""
    return parse_json(read_text(path, what), f"{path}: expected {what}", InputError, "mend the file")
