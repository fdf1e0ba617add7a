"""One run per output: a lock file beside it, made in a way that is safe on NFS and other network file systems too."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError
from schemas.files.companions import remove_companions

# A process on another machine cannot be asked whether it lives: it touches its locks every HEARTBEAT seconds, and a lock
# that was not touched for STALE_AFTER seconds is that of a machine that went down.
HEARTBEAT = 30.0
STALE_AFTER = 600.0
EMPTY_FOR = 10.0  # seconds that a lock may be empty: its maker is about to write its name

_held: dict[Path, int] = {}
_guard = threading.Lock()
_unlocked: ContextVar[bool] = ContextVar("unlocked", default=False)


def lock_path(output: Path) -> Path:
    """Where the lock of an output (a file or a folder) is."""
    output = Path(os.path.abspath(output))
    return output.with_name(f".{output.name}.lock")


def partial_path(output: Path) -> Path:
    """The temporary name under which this process, and no other on any machine, writes ``output``."""
    mark = f"{host()}-{os.getpid()}-{threading.get_native_id()}"
    return output.with_name(f".{output.stem}.partial-{mark}{output.suffix}")


@contextlib.contextmanager
def scratch_path(output: Path, purpose: str) -> Iterator[Path]:
    """A temporary file beside ``output``, named after its purpose; removed at the end, or by the next run."""
    path = partial_path(output)
    path = path.with_name(f"{path.stem}.{purpose}{path.suffix}")
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def is_beside(output: str, name: str) -> bool:
    """Whether a file of this name would be taken for the lock of ``output`` or for another process' temporary file of it."""
    stem, suffix = Path(output).stem, Path(output).suffix
    own = partial_path(Path(output)).stem
    partial = name.startswith(f".{stem}.partial-") and name.endswith(suffix) and not name.startswith(own)
    return partial or name == f".{output}.lock" or name.startswith(f".{output}.lock-")


def host() -> str:
    """This machine's name, as a lock names its holder."""
    return socket.gethostname().split(".")[0]


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
    lock = lock_path(output)
    with _folder(lock.parent):
        if _unlocked.get():
            yield
        else:
            with _hold(lock, output):
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
def _hold(lock: Path, output: Path) -> Iterator[None]:
    with _guard:
        mine = lock in _held
        if not mine:
            noted = _acquire(lock, output)
        _held[lock] = _held.get(lock, 0) + 1
    if not mine:
        _remove_partials(Path(os.path.abspath(output)))
        remove_companions(noted, output)
        _keep_alive()
    try:
        yield
    finally:
        with _guard:
            _held[lock] -= 1
            if not _held[lock]:
                del _held[lock]
                with contextlib.suppress(OSError):
                    remove_companions(lock.read_text(), output)
                    lock.unlink()


def _acquire(lock: Path, output: Path) -> str:
    """Make the lock; returns the text of the lock of a dead run that it replaces, '' where there was none."""
    noted = ""
    for _ in range(5):
        try:
            number = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            owner, seen = _read(lock)
            if owner is None:
                continue  # released in this moment
            if not _is_stale(lock, owner):
                raise ConfigError(_refusal(output, lock, owner)) from None
            _discard(lock, seen)
            noted = seen
            continue
        except OSError as error:
            raise ConfigError(f"{output}: cannot be written ({error.strerror}); choose another `output`.") from None
        own = {
            "host": host(),
            "pid": os.getpid(),
            "began": _process_start(os.getpid()),
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        try:
            with os.fdopen(number, "w") as stream:
                json.dump(own, stream)
        except OSError as error:
            lock.unlink(missing_ok=True)
            raise InputError(
                f"{output}: cannot be written ({error.strerror}); nothing is left. Free some space and run the command again."
            ) from None
        return noted
    raise ConfigError(f"{output}: another run is taking this output at the same moment; let it finish.")


def _refusal(output: Path, lock: Path, owner: dict[str, Any]) -> str:
    who = f"process {owner['pid']} on {owner['host']}, since {owner['since']}" if owner else "just started"
    return (
        f"{output}: another run is writing this output ({who}); wait for it or choose another `output` "
        f"(if it cannot be alive any more, remove {lock})."
    )


def _read(lock: Path) -> tuple[dict[str, Any] | None, str]:
    """The owner written in a lock ({} where it is not written yet), None where the lock is gone; and its text."""
    try:
        text = lock.read_text()
    except OSError:
        return None, ""
    try:
        owner = json.loads(text.partition("\n")[0])  # companions may follow
        return {"host": owner["host"], "pid": int(owner["pid"]), "began": owner["began"], "since": owner["since"]}, text
    except (ValueError, KeyError, TypeError):
        return {}, text


def _is_stale(lock: Path, owner: dict[str, Any]) -> bool:
    if owner and owner["host"] == host():
        began = _process_start(owner["pid"])
        return began is None or (owner["began"] is not None and began != owner["began"])
    return _age(lock) > (STALE_AFTER if owner else EMPTY_FOR)


def _age(lock: Path) -> float:
    """Seconds since a lock was touched, by the clock of its file system."""
    probe = lock.with_name(f"{lock.name}-{uuid.uuid4().hex}")
    try:
        probe.touch()
        return probe.stat().st_mtime - lock.stat().st_mtime
    except OSError:
        return 0.0
    finally:
        probe.unlink(missing_ok=True)


def _discard(lock: Path, seen: str) -> None:
    """Take a stale lock away, unless another process has just done so and put its own there."""
    aside = lock.with_name(f"{lock.name}-{uuid.uuid4().hex}")
    try:
        os.rename(lock, aside)
    except OSError:
        return
    try:
        if aside.read_text() != seen:
            with contextlib.suppress(OSError):
                os.link(aside, lock)
    finally:
        aside.unlink(missing_ok=True)


def _process_start(pid: int) -> float | None:
    """When a process of this machine began (clock ticks), 0 where the system does not tell, None where it is dead."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return None if after_name[0] in "ZX" else float(after_name[19])


def _remove_partials(output: Path) -> None:
    """Whoever holds the lock is the only one that writes: what lies there under temporary names is of killed runs."""
    for left in output.parent.glob(f".{glob.escape(output.stem)}.partial-*{glob.escape(output.suffix)}"):
        with contextlib.suppress(OSError):
            if left.is_dir():
                shutil.rmtree(left)
            else:
                left.unlink()


_pulse: list[threading.Thread] = []


def _keep_alive() -> None:
    with _guard:
        if not _pulse or not _pulse[0].is_alive():
            _pulse[:] = [threading.Thread(target=_beat, name="lunargr-locks", daemon=True)]
            _pulse[0].start()


def _beat() -> None:
    while True:
        time.sleep(HEARTBEAT)
        with _guard:
            locks = list(_held)
        for lock in locks:
            with contextlib.suppress(OSError):
                os.utime(lock)
