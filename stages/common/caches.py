"""Folders for compiled functions and fonts, where neither the installation nor the home folder can be written."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Mapping, MutableMapping
from pathlib import Path

from schemas.files.outputs import can_write_in

PACKAGE = Path(__file__).resolve().parent.parent


def choose_caches(environment: MutableMapping[str, str] = os.environ, package: Path = PACKAGE) -> None:
    """Set NUMBA_CACHE_DIR and MPLCONFIGDIR to a folder of this user's where numba and matplotlib would find none.

    numba keeps what it compiles beside the source or in the user's cache folder, and stops with "no locator available"
    where it can write to neither; matplotlib warns. To be called before they are imported.
    """
    home = _cache_home(environment)
    if "NUMBA_CACHE_DIR" not in environment and not can_write_in(package) and not can_write_in(home):
        environment["NUMBA_CACHE_DIR"] = str(_temporary() / "numba")
    settings = Path(environment.get("XDG_CONFIG_HOME") or home.parent / ".config")
    if "MPLCONFIGDIR" not in environment and not (can_write_in(settings) and can_write_in(home)):
        environment["MPLCONFIGDIR"] = str(_temporary() / "matplotlib")


def _cache_home(environment: Mapping[str, str]) -> Path:
    home = environment.get("HOME") or os.path.expanduser("~")
    return Path(environment.get("XDG_CACHE_HOME") or os.path.join(home, ".cache"))


def _temporary() -> Path:
    """The same folder for every run of this user; compiled code is loaded from it, so nobody else may own it."""
    folder = Path(tempfile.gettempdir()) / f"lunargr-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="lunargr-"))
