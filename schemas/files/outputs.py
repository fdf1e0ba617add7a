"""Files that are whole or absent, never half-written, and never take the place of an input."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError
from schemas.files.companions import current_output, note_companion
from schemas.files.locks import claim, lock_path, partial_path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_output(path: Path, inputs: Sequence[Path] = (), overwrite: bool = False) -> None:
    """Refuse, before any work is done, an output that would replace an input or an existing file.

    Raises ConfigError; the folder is created where it is missing.
    """
    path = Path(path)
    for source in inputs:
        if path.resolve() == Path(source).resolve():
            raise ConfigError(f"{path}: the output would replace the input of the same name; choose another --output.")
    if path.is_dir():
        raise ConfigError(f"{path}: expected a file name, found a folder; name the file in --output.")
    if path.exists() and not overwrite:
        raise ConfigError(f"{path}: exists already; add --overwrite to replace it or choose another --output.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{path.parent}: cannot be made a folder ({error.strerror}); choose another --output."
        ) from None


def is_full_disk(error: BaseException | None) -> bool:
    """HDF5 reports the system's error in words, and a failed close hides the failed write behind itself."""
    while error is not None:
        text = str(error).lower()
        if getattr(error, "errno", None) in _FULL or any(f"errno = {number}," in text for number in _FULL):
            return True
        if "no space left" in text or "disk quota" in text:
            return True
        error = error.__cause__ or error.__context__
    return False


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` that becomes ``path`` when the block ends well and vanishes when it does not.

    Also turns a full disk into one clear line (InputError), and refuses an output that another run is writing
    (ConfigError).
    """
    path = Path(path)
    partial = partial_path(path)
    with claim(path), _whole_or_absent(path, partial):
        yield partial
        if (output := current_output()) is not None and output != path:
            note_companion(lock_path(output), path, partial)
        os.replace(partial, path)


@contextlib.contextmanager
def _whole_or_absent(path: Path, partial: Path) -> Iterator[None]:
    try:
        yield
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        if is_full_disk(error):
            raise InputError(
                f"{path}: the disk is full or over quota; nothing half-written is left. "
                "Free some space and run the command again."
            ) from None
        raise


@contextlib.contextmanager
def terminate_as_exception() -> Iterator[None]:
    """Let SIGTERM (a Slurm time limit, ``kill``) unwind like Ctrl-C, so that the partial file is removed."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return

    def stop(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
