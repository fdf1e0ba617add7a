"""One run per output: a lock beside it, and the temporary names under which that run writes.

The lock is one of the ``filelock`` package: the operating system lets go of it when its process ends, however it ends,
and a network file system when the machine is lost. Where a file system has no locks (``flock``), filelock keeps a file
in its place; after the loss of a machine somebody has to remove that, and the refusal names it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
import stat
import threading
import time
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.errors import ConfigError, InputError
from schemas.files.companions import remove_companions

if TYPE_CHECKING:
    from filelock import BaseFileLock

PATIENCE = 0.2  # seconds: another run may be letting go in this moment
LONGEST_NAME = 255  # bytes, of a file on every system
LONGEST_PATH = 4096  # bytes, as Linux has it
SHOWN = 120  # characters of who holds a lock

_guard = threading.Lock()
_unlocked: ContextVar[bool] = ContextVar("unlocked", default=False)


def lock_path(output: Path) -> Path:
    """Where the lock of an output (a file or a folder) is."""
    return _beside(output, "lock")


def record_path(output: Path) -> Path:
    """Where the run that holds an output's lock says who it is, and which companions of the output it wrote."""
    return _beside(output, "run")


def _beside(output: Path, what: str) -> Path:
    output = Path(os.path.abspath(output))
    return output.with_name(f".{output.name}.{what}")


def partial_path(output: Path, purpose: str = "") -> Path:
    """The temporary name under which this process, and no other on any machine, writes ``output``.

    It holds the output's whole name and then a mark without a dot: it can be no other output's temporary name.
    """
    mark = f"{purpose}{_host()}-{os.getpid()}-{threading.get_native_id()}"
    return output.with_name(f".{output.name}.partial-{mark}{output.suffix}")


def is_partial(output: str, name: str) -> bool:
    """Whether ``name`` is a temporary name, of any process, of the output of this name."""
    pattern = re.escape(f".{output}.partial-") + r"[^.]+" + re.escape(Path(output).suffix)
    return re.fullmatch(pattern, name) is not None


def check_length(path: Path) -> None:
    """Refuse a name that no file has; GDAL, HDF5 and JSON keep names as UTF-8. Raises ConfigError."""
    name = os.fspath(path)
    try:
        longest = max(len(part.encode()) for part in name.split(os.sep))
    except UnicodeEncodeError:
        raise ConfigError(f"{name}: expected a name in UTF-8, found other bytes; rename the file.") from None
    if longest > LONGEST_NAME or len(name.encode()) >= LONGEST_PATH:
        raise ConfigError(f"{name}: expected a name of at most {LONGEST_NAME} bytes, found a longer one; shorten it.")


@contextlib.contextmanager
def scratch_path(output: Path, purpose: str) -> Iterator[Path]:
    """A temporary file beside ``output``, named after its purpose; removed at the end, or by the next run."""
    path = partial_path(output, f"{purpose}-")
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def is_beside(output: str, name: str) -> bool:
    """Whether a file of this name would be taken for a lock, a record or another process' temporary file of ``output``."""
    own = f"{_host()}-{os.getpid()}-{threading.get_native_id()}{Path(output).suffix}"
    return name in (f".{output}.lock", f".{output}.run") or (is_partial(output, name) and not name.endswith(own))


def _host() -> str:
    """This machine's name without a dot."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", socket.gethostname().split(".")[0])


@contextlib.contextmanager
def unlocked() -> Iterator[None]:
    """Within this block outputs are not locked: the parts of a run whose driver holds the lock of the whole."""
    token = _unlocked.set(True)
    try:
        yield
    finally:
        _unlocked.reset(token)


@contextlib.contextmanager
def claim(output: Path) -> Iterator[None]:
    """Hold the lock of an output; the same process may claim it again inside. Raises ConfigError where another run has
    it.

    What killed runs left beside the output under temporary names is removed, and so are its companions where it is absent.
    A missing folder is made, and goes again where nothing was written into it.
    """
    output = Path(os.path.abspath(output))
    with _folder(output.parent):
        if _unlocked.get():
            yield
        else:
            with _hold(output, lock_path(output)):
                yield


@contextlib.contextmanager
def _folder(folder: Path) -> Iterator[None]:
    missing = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made a folder ({error.strerror}); choose another `output`.") from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # not empty: it holds the output
            for made in missing:
                made.rmdir()


@contextlib.contextmanager
def _hold(output: Path, path: Path) -> Iterator[None]:
    from filelock import FileLock

    lock = FileLock(path, timeout=PATIENCE, poll_interval=PATIENCE / 10, thread_local=False, is_singleton=True)
    with _guard:
        if not lock.is_locked:
            _acquire(output, path, lock)
            _begin(output, lock)
        else:
            lock.acquire()
    try:
        yield
    finally:
        with _guard:
            if lock.lock_counter == 1:
                _end(output, path)
            lock.release()


def _acquire(output: Path, path: Path, lock: BaseFileLock) -> None:
    from filelock import Timeout

    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(path.lstat().st_mode):
            raise ConfigError(f"{path}: expected the lock of {output.name}, found no regular file; remove it.")
    try:
        lock.acquire()
    except Timeout:
        if not path.exists():  # filelock takes a folder without files, such as /proc, for a file that others remove
            raise ConfigError(f"{output}: no file can be made in this folder; choose another `output`.") from None
        who = _read(record_path(output)).partition("\n")[0]
        who = f" ({who[:SHOWN]})" if who else ""
        raise ConfigError(
            f"{output}: another run is writing this output{who}; wait for it or choose another `output` "
            f"(if its machine is lost, remove {path})."
        ) from None
    except OSError as error:
        raise ConfigError(f"{output}: cannot be written ({error.strerror}); choose another `output`.") from None


def _begin(output: Path, lock: BaseFileLock) -> None:
    """Tidy up after a killed run, and say who holds the lock now."""
    record = record_path(output)
    remove_companions(_read(record), output)
    for name in os.listdir(output.parent):  # whoever holds the lock is the only one that writes
        if is_partial(output.name, name):
            _remove(output.with_name(name))
    try:
        _remove(record)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        record.write_text(f"process {os.getpid()} on {_host()}, since {since}\n")
    except OSError as error:
        _end(output, lock_path(output))
        lock.release()
        raise InputError(
            f"{output}: cannot be written ({error.strerror}); nothing is left. Free some space and run the command again."
        ) from None


def _end(output: Path, path: Path) -> None:
    record = record_path(output)
    remove_companions(_read(record), output)
    record.unlink(missing_ok=True)
    path.unlink(missing_ok=True)  # before it is let go of: who waits for it sees that its file is gone


def _read(record: Path) -> str:
    try:
        return record.read_text(errors="replace") if record.is_file() else ""
    except OSError:
        return ""


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
