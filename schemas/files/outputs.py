"""Files that are whole or absent, never half-written, and never take the place of an input."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError, LunargrError
from schemas.files.companions import current_output, note_companion
from schemas.files.inputs import Inputs
from schemas.files.locks import LONGEST_NAME, check_length, claim, partial_path, record_path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_guard: ContextVar[_Guard | None] = ContextVar("guard", default=None)


@dataclass(frozen=True)
class Target:
    """A file that a run will write.

    setting : with which the user chooses another place; name : in messages
    state : of an unfinished run, which stays where the run ends early, and which the next one may replace
    """

    path: Path
    setting: str = "output"
    name: str = "the output"
    state: bool = False


@dataclass(frozen=True)
class Output:
    """Where a stage writes, whether it may replace what is there, and whether it works in parts.

    path : the artefact, page or folder; None for stages that are asked for `json`, `figures` or `report` alone
    overwrite : whether what exists may be replaced; resume : whether to go on with what an interrupted run left
    geotiff : of a map, None for its own name with .tif; json, figures (a folder), report, shifts (a table) : None for none
    scheduler : who works on parts, 'local:N' or the address of a Dask scheduler, None for this process
    parts : how many, None for a suitable number
    """

    path: Path | None = None
    overwrite: bool = False
    resume: bool = False
    geotiff: Path | None = None
    json: Path | None = None
    figures: Path | None = None
    report: Path | None = None
    shifts: Path | None = None
    scheduler: str | None = None
    parts: int | None = None

    @classmethod
    def at(cls, where: Output | Path | None) -> Output:
        """The output at a bare path, which replaces nothing; an Output stays as it is."""
        return where if isinstance(where, Output) else cls(where)

    @property
    def file(self) -> Path:
        """The path, where there must be one. Raises ConfigError."""
        if self.path is None:
            raise ConfigError("expected the name of an output, found none.")
        return self.path

    @property
    def in_parts(self) -> bool:
        """Whether a stage that can be cut works in parts, of which finished ones are kept."""
        return self.resume or self.scheduler is not None

    @property
    def geotiff_path(self) -> Path:
        """Where a map's GeoTIFF goes."""
        return self.geotiff or self.file.with_suffix(".tif")


def map_targets(output: Output, as_geotiff: bool) -> list[Target]:
    """The files of a map: the artefact, and its GeoTIFF where one is wanted."""
    picture = Target(output.geotiff_path, "geotiff", f"the GeoTIFF of {output.file.name}")
    return [Target(output.file), *([picture] if as_geotiff else [])]


@dataclass
class _Guard:
    """What a run may replace. inputs : of this run and of those that it is part of

    replaceable : the absolute paths of files that it may replace, or that it wrote itself; states : see Target
    """

    inputs: list[Inputs]
    replaceable: set[str] = field(default_factory=set)
    states: set[str] = field(default_factory=set)

    def refuse(self, path: Path) -> None:
        """Refuse to write ``path`` in the place of an input, or of a file that may not be replaced. Raises ConfigError."""
        refuse_inputs(Target(path), self.inputs)
        place = os.path.abspath(path)
        if place not in self.replaceable and os.path.lexists(path):
            raise _exists(Target(path))
        self.replaceable.add(place)


@contextlib.contextmanager
def protect(inputs: Inputs, targets: Iterable[Target] = (), overwrite: bool = False) -> Iterator[None]:
    """Within this block no file is written in the place of an input, or of a file that is no target.

    Targets are replaced with ``overwrite`` alone.
    """
    outer = _guard.get()
    guard = _Guard([inputs, *(outer.inputs if outer else [])])
    for target in targets:
        place = os.path.abspath(target.path)
        if overwrite or target.state:
            guard.replaceable.add(place)
        if target.state:
            guard.states.add(place)
    token = _guard.set(guard)
    try:
        yield
    finally:
        _guard.reset(token)


def check_apart(targets: Iterable[Target], inputs: Inputs) -> None:
    """Refuse outputs in the place of an input or of each other, and names that no file can have. Raises ConfigError.

    Inputs are those given, all that they name, and those of a run that this one is part of.
    """
    known = [inputs, *(guard.inputs if (guard := _guard.get()) else [])]
    earlier = Inputs()
    for target in targets:
        check_name(target)
        refuse_inputs(target, known)
        if (twin := earlier.find(target.path)) is not None:
            raise ConfigError(
                f"{target.path}: {target.name} would replace {twin}, which this run also writes; choose another `{target.setting}`."
            )
        earlier.note(target.path)


def check_places(targets: Iterable[Target], overwrite: bool = False) -> None:
    """Refuse outputs that exist, unless they may be replaced, and those that cannot be written. Raises ConfigError."""
    for target in targets:
        _check_place(target, overwrite or target.state)


def refuse_inputs(target: Target, known: Iterable[Inputs]) -> None:
    """Refuse to write ``target`` where that would replace or remove an input. Raises ConfigError."""
    for inputs in known:
        if (source := inputs.clash(target.path)) is not None:
            same = "the input of the same name" if str(source) == str(target.path) else f"the input {source}"
            raise ConfigError(f"{target.path}: {target.name} would replace {same}; choose another `{target.setting}`.")


def check_name(target: Target) -> None:
    """Refuse a name beside which no temporary file can stand. Raises ConfigError."""
    check_length(target.path)
    path = Path(os.path.abspath(target.path))
    if not path.name:
        raise ConfigError(f"{target.path}: expected a name, found the root folder; choose another `{target.setting}`.")
    if (over := len(os.fsencode(partial_path(path).name)) - LONGEST_NAME) > 0:
        longest = len(os.fsencode(path.name)) - over
        raise ConfigError(
            f"{target.path}: expected a name of at most {longest} bytes, which leaves room for a temporary file's; "
            f"choose another `{target.setting}`."
        )


def _check_place(target: Target, overwrite: bool) -> None:
    path, another = target.path, f"choose another `{target.setting}`"
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        mode = stat.S_IFREG if path.is_symlink() else 0  # a link to nothing is something that would be replaced
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}); {another}.") from None
    if stat.S_ISDIR(mode):
        raise ConfigError(f"{path}: expected a file name, found a folder; name the file in `{target.setting}`.")
    if mode and not stat.S_ISREG(mode):
        raise ConfigError(f"{path}: expected a file name, found a device, pipe or socket; {another}.")
    if mode and not overwrite:
        raise _exists(target)
    _check_writable(path.parent, target)


def _exists(target: Target) -> ConfigError:
    return ConfigError(
        f"{target.path}: exists already; add `overwrite` to replace it or choose another `{target.setting}`."
    )


def _check_writable(folder: Path, target: Target) -> None:
    """Refuse a folder in which no file can be made. Raises ConfigError."""
    if can_write_in(folder):
        return
    there = _nearest_existing(folder)
    why = "no permission, or a read-only file system" if there.is_dir() else f"{there} is a file"
    problem = (
        f"{folder}: cannot be made a folder" if there != folder.absolute() else f"{target.path}: cannot be written"
    )
    raise ConfigError(f"{problem} ({why}); choose another `{target.setting}`.")


def can_write_in(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the nearest one above it that exists."""
    there = _nearest_existing(folder)
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _nearest_existing(folder: Path) -> Path:
    there = Path(os.path.abspath(folder))
    while not there.exists() and there != there.parent:
        there = there.parent
    return there


def is_full_disk(error: BaseException | None) -> bool:
    """Whether a full disk or quota caused an error. HDF5 reports it in words, behind the error of a failed close."""
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
    """A temporary name beside ``path``, renamed to ``path`` when the block ends well and removed when it does not.

    Raises InputError where the disk is full, ConfigError for an input's place and for an output of another run.
    """
    path = Path(path)
    partial = partial_path(path)
    with claim(path):
        _refuse(path)
        try:
            yield partial
            if (output := current_output()) is not None and output != path and not _is_state(path):
                note_companion(record_path(output), path, partial)
            os.replace(partial, path)
        except BaseException as error:
            with contextlib.suppress(OSError):
                partial.unlink()
            if is_full_disk(error):
                raise InputError(
                    f"{path}: the disk is full or over quota; nothing half-written is left. "
                    "Free some space and run the command again."
                ) from None
            raise


def json_targets(path: Path | None) -> list[Target]:
    """The JSON file of a command that writes no other, where it is wanted."""
    return [] if path is None else [Target(path, "json")]


def write_json(path: Path, content: Any) -> None:
    """A result as JSON, whole or absent."""
    with atomic_path(path) as partial:
        partial.write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")


def _refuse(path: Path) -> None:
    if (guard := _guard.get()) is not None:
        guard.refuse(path)


def _is_state(path: Path) -> bool:
    return (guard := _guard.get()) is not None and os.path.abspath(path) in guard.states


@contextlib.contextmanager
def atomic_folder(folder: Path, last: str) -> Iterator[Path]:
    """A temporary folder whose files move into ``folder`` when the block ends well, the file ``last`` after all others.

    When it does not end well, nothing is left and nothing was replaced.
    """
    with claim(folder / last):
        staging = partial_path(folder / last)
        try:
            staging.mkdir()
            yield staging
            made = [p.relative_to(staging) for p in sorted(staging.rglob("*")) if p.is_file()]
            for name in sorted(made, key=lambda p: p == Path(last)):
                _refuse(folder / name)
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(staging / name, folder / name)
        except LunargrError as error:  # names the folder that the user knows
            raise type(error)(str(error).replace(str(staging), str(folder))) from None
        finally:
            shutil.rmtree(staging, ignore_errors=True)
