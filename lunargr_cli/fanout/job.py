"""The parts of one output: their folder, whose they are, and which are finished."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lunargr_cli.fanout.engines import Engine, Here, Task, open_dask
from schemas.errors import ConfigError, InputError
from schemas.files.locks import claim
from schemas.files.outputs import Output, check_output
from schemas.provenance import sha256
from stages.common.progress import Progress, Say, say_nothing, show_nothing

PATIENCE = 20  # seconds


@dataclass
class Job:
    """One output and its parts; :meth:`fan` is what stages and commands have work done with."""

    folder: Path
    engine: Engine
    say: Say
    progress: Progress
    again: bool  # an earlier run was interrupted

    def fan(
        self, what: str, function: Callable[..., Any], arguments: Sequence[Mapping[str, Any]], suffix: str = ".h5"
    ) -> list[Path]:
        """``function(path, **arguments)`` for every part that is not there yet; the parts in order.

        Raises what a part raises (LunargrError), and InputError where the machines for it fail.
        """
        count = len(arguments)
        paths = [self.folder / f"{what}-{k + 1:05d}-of-{count:05d}{suffix}" for k in range(count)]
        todo = [Task(function, path, dict(a)) for path, a in zip(paths, arguments, strict=True) if not path.exists()]
        if len(todo) < count:
            self.say(f"{what}: {count - len(todo)} of {count} parts are there already")
        done = count - len(todo)
        self.progress(0, count, f"{what}, parts")
        for _ in self.engine.work(todo):
            done += 1
            self.progress(done, count, f"{what}, parts")
        for path in paths:
            _await(path)
        return paths


@dataclass(frozen=True)
class Work:
    """How a command works in parts. scheduler : None for this process; parts : how many, None for by size"""

    scheduler: str | None = None
    parts: int | None = None
    say: Say = say_nothing
    progress: Progress = show_nothing


@dataclass(frozen=True)
class Identity:
    """What decides a result. inputs : known by their contents; sources : files too many to read for that, known by size
    and time of change
    """

    stage: str
    options: Mapping[str, Any]
    inputs: Sequence[Path]
    sources: Sequence[Path] = ()

    def digest(self) -> str:
        """Raises InputError for inputs that are not there."""
        for path in self.inputs:
            if not path.is_file():
                raise InputError(f"{path}: no such file; check the path or run the stage that writes it.")
        what = {
            "stage": self.stage,
            "version": version("lunargr"),
            "options": dict(self.options),
            "inputs": [sha256(path) for path in self.inputs],
            "sources": [_state(path) for path in self.sources],
        }
        return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()


@contextlib.contextmanager
def open_job(output: Output, identity: Identity, work: Work) -> Iterator[Job]:
    """The parts of an output beside it, gone when all ends well and kept when it does not.

    Parts of another command, by ``identity``, are thrown away.
    """
    path = output.file
    check_output(path, [*identity.inputs, *identity.sources], output.overwrite)
    with claim(path):
        digest = identity.digest()
        root = path.with_name(f"{path.name}.parts")
        folder = root / digest[:16]
        for other in root.iterdir() if root.is_dir() else ():
            if other != folder:
                shutil.rmtree(other, ignore_errors=True)
        again = folder.is_dir()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{root}: cannot be made a folder ({error.strerror}); choose another --output.") from None
        for left in folder.glob(".*partial-*"):  # of killed workers
            left.unlink(missing_ok=True)
        engine: Any = open_dask(work.scheduler, folder) if work.scheduler else contextlib.nullcontext(Here())
        with engine as working:
            yield Job(folder.resolve(), working, work.say, work.progress, again)
        shutil.rmtree(root, ignore_errors=True)


def _await(path: Path) -> None:
    """A network file system may show a new file some seconds late. Raises InputError."""
    for _ in range(PATIENCE):
        if path.exists():
            return
        time.sleep(1.0)
        os.listdir(path.parent)
    raise InputError(
        f"{path}: a worker says that it wrote this part, but it is not here; "
        "--scheduler needs workers that see the same files under the same names."
    )


def _state(path: Path) -> list[Any]:
    try:
        found = os.stat(path)
    except OSError:
        return [str(path)]
    return [str(path), found.st_size, found.st_mtime_ns]
