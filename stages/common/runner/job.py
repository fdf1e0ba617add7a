"""The parts of one output: their folder, the job that they belong to, and which of them are finished.

A part is a file, whole or absent. What is finished stays: the same command run again, on any engine, does only what is missing,
and the parts give what one process would have given.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError, InputError
from schemas.files.outputs import Output
from schemas.provenance import file_state, sha256
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.common.runner.engines import Engine, Task, ThisProcess, open_dask

PATIENCE = 20  # seconds until a new file must show on a network file system
DASK = "dask"  # folder of the workers' own files
RECORD = ".made"  # in the folder of parts: the names, without endings, of all that jobs made there


@dataclass
class Job:
    """One output and its parts. package : of the stage; inputs : the files of its call"""

    package: str
    output: Output
    inputs: Sequence[Path]
    folder: Path
    engine: Engine
    say: Say
    progress: Progress

    def file(self, name: str) -> Path:
        """A file beside the parts, which goes with them."""
        _note(self.folder.parent, [f"{self.folder.name}/{_stem(name)}"])
        return self.folder / name

    def fan(
        self, name: str, function: Callable[..., Any], arguments: Sequence[Mapping[str, Any]], suffix: str = ".h5"
    ) -> list[Path]:
        """Have ``function(path, **arguments)`` write every part that is not there yet; returns the parts' paths in
        order.

        name : of the parts' files and in messages. Raises a part's LunargrError, and InputError where the machines
            fail.
        """
        count = len(arguments)
        paths = [self.folder / f"{name}-{k + 1:05d}-of-{count:05d}{suffix}" for k in range(count)]
        _note(self.folder.parent, [f"{self.folder.name}/{_stem(path.name)}" for path in paths])
        todo = [Task(function, path, dict(a)) for path, a in zip(paths, arguments, strict=True) if not path.exists()]
        if len(todo) < count:
            self.say(f"{name}: {count - len(todo)} of {count} parts are there already")
        done = count - len(todo)
        self.progress(0, count, f"{name}, parts")
        for _ in self.engine.work(todo):
            done += 1
            self.progress(done, count, f"{name}, parts")
        for path in paths:
            _await(path)
        return paths

    def shards(self, name: str, inputs: Sequence[Any], config: Any, pieces: int, each: int = 1) -> list[Path]:
        """Have the stage make its shards of these inputs; their paths in order.

        pieces : into which the work can be cut; each : how many of them a shard holds where the user says nothing
        """
        count = max(1, min(self.output.parts or math.ceil(pieces / each), pieces))
        shared = {"package": self.package, "inputs": inputs}
        return self.fan(
            name, write_shard, [shared | {"config": replace(config, shard=(k, count))} for k in range(count)]
        )


def write_shard(path: Path, package: str, inputs: Sequence[Any], config: Any) -> None:
    """Write one shard of what a stage makes of its inputs."""
    importlib.import_module(package).run(*inputs, Output(path, overwrite=True), config)
    path.with_suffix(".tif").unlink(missing_ok=True)  # the whole gets it: also where one shard is all


@dataclass(frozen=True)
class Identity:
    """What the result of a job depends on: parts of an earlier run with the same identity are used.

    inputs : files compared by their contents; sources : files compared by size and time of change, being too many to
        read
    """

    package: str
    options: Mapping[str, Any]
    inputs: Sequence[Path]
    sources: Sequence[Path] = ()

    def digest(self) -> str:
        """A hash of it."""
        identity = {
            "package": self.package,
            "version": version("lunargr"),
            "options": {k: asdict(v) if is_dataclass(v) else v for k, v in self.options.items()},  # type: ignore[arg-type]
            "inputs": [sha256(path) for path in self.inputs],
            "sources": [[str(path), *file_state(path)] for path in self.sources],
        }
        return hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()


@contextlib.contextmanager
def open_job(
    output: Output, identity: Identity, say: Say = say_nothing, progress: Progress = show_nothing
) -> Iterator[Job]:
    """The parts of an output beside it, gone when all ends well and kept when it does not.

    The caller holds the lock of the output. Parts of another command, by ``identity``, are thrown away. Raises
    ConfigError before anything is made where the folder of parts holds what no job made.
    """
    path = output.file
    folder = path.with_name(f"{path.name}.parts") / identity.digest()[:16]
    _refuse_foreign(folder.parent)
    _clear(folder.parent, keep=folder.name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{folder.parent}: cannot be made a folder ({error.strerror}); choose another `output`."
        ) from None
    _note(folder.parent, [folder.name, f"{folder.name}/{DASK}"])
    for left in folder.glob(".*"):  # of killed workers
        left.unlink(missing_ok=True)
    engine: Any = contextlib.nullcontext(ThisProcess())
    if output.scheduler:
        engine = open_dask(output.scheduler, folder / DASK)
    with engine as working:
        yield Job(identity.package, output, identity.inputs, folder.resolve(), working, say, progress)
    _clear(folder.parent)


def _stem(name: str) -> str:
    """What the temporary names of a part, and the files that its stage writes beside it, have in common with it."""
    return name.lstrip(".").partition(".")[0]


def _note(root: Path, names: Sequence[str]) -> None:
    """Record names that are about to be made in the folder of parts."""
    if new := [name for name in names if name not in _noted(root)]:
        with open(root / RECORD, "a") as stream:
            stream.write("".join(f"{name}\n" for name in new))


def _noted(root: Path) -> set[str]:
    record = root / RECORD
    return set(record.read_text().splitlines()) if record.is_file() else set()


def _refuse_foreign(root: Path) -> None:
    """Refuse a folder of parts that holds what no job recorded. Raises ConfigError."""
    noted = _noted(root)
    for path in root.iterdir() if root.is_dir() else ():
        made = path.name in noted and path.is_dir() and not path.is_symlink()
        inner = [p for p in path.iterdir() if f"{path.name}/{_stem(p.name)}" not in noted] if made else [path]
        if inner and path.name != RECORD:
            raise ConfigError(
                f"{inner[0]}: expected only the parts of an interrupted run in {root.name}, found a file that no run made; "
                "move it, or choose another `output`."
            )


def _clear(root: Path, keep: str = "") -> None:
    """Remove what jobs recorded in the folder of parts, but for the folder ``keep``, and the folder itself if empty."""
    noted = _noted(root)
    for folder in (root / name for name in noted if "/" not in name and name != keep):
        for path in folder.iterdir() if folder.is_dir() else ():
            if f"{folder.name}/{_stem(path.name)}" in noted:
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            folder.rmdir()
    if not keep:
        (root / RECORD).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            root.rmdir()


def _await(path: Path) -> None:
    """A network file system may show a new file some seconds late. Raises InputError."""
    for _ in range(PATIENCE):
        if path.exists():
            return
        time.sleep(1.0)
        os.listdir(path.parent)
    raise InputError(
        f"{path}: a worker says that it wrote this part, but it is not here; "
        "`scheduler` needs workers that see the same files under the same names."
    )
