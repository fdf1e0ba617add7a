"""The parts of one output: their folder, the job that they belong to, and which of them are finished."""

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

from lunargr_cli.fanout.engines import Engine, Task, ThisProcess, open_dask
from schemas.errors import ConfigError, InputError
from schemas.files.locks import claim
from schemas.files.outputs import Output, check_output
from schemas.provenance import file_state, sha256
from stages.common.progress import Progress, Say, say_nothing, show_nothing

PATIENCE = 20  # seconds until a new file must show on a network file system


@dataclass
class Job:
    """One output and its parts."""

    folder: Path
    engine: Engine
    say: Say
    progress: Progress
    again: bool  # whether an earlier run of the same job was interrupted

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


@dataclass(frozen=True)
class Work:
    """How parts are worked on. scheduler : None for this process; parts : their number, None for a suitable one"""

    scheduler: str | None = None
    parts: int | None = None
    say: Say = say_nothing
    progress: Progress = show_nothing


@dataclass(frozen=True)
class Identity:
    """What the result of a job depends on: parts of an earlier run with the same identity are used.

    inputs : files compared by their contents; sources : files compared by size and time of change, being too many to
        read
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
        identity = {
            "stage": self.stage,
            "version": version("lunargr"),
            "options": dict(self.options),
            "inputs": [sha256(path) for path in self.inputs],
            "sources": [[str(path), *file_state(path)] for path in self.sources],
        }
        return hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()


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
        engine: Any = open_dask(work.scheduler, folder) if work.scheduler else contextlib.nullcontext(ThisProcess())
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
