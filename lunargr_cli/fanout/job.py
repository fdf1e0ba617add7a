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
from schemas.files.outputs import check_output
from schemas.provenance import sha256

Progress = Callable[[int, int, str], None]
Say = Callable[[str], None]
PATIENCE = 20  # seconds


@dataclass
class Job:
    """One output and its parts; :meth:`fan` is what stages and commands have work done with."""

    folder: Path
    engine: Engine
    say: Say
    progress: Progress | None
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
        if self.progress:
            self.progress(0, count, f"{what}, parts")
        for _ in self.engine.work(todo):
            done += 1
            if self.progress:
                self.progress(done, count, f"{what}, parts")
        for path in paths:
            _await(path)
        return paths


@contextlib.contextmanager
def open_job(
    output: Path,
    stage: str,
    options: Mapping[str, Any],
    inputs: Sequence[Path],
    *,
    scheduler: str | None = None,
    sources: Sequence[Path] = (),
    overwrite: bool = False,
    say: Say = lambda line: None,
    progress: Progress | None = None,
) -> Iterator[Job]:
    """The parts of ``output`` beside it, gone when all ends well and kept when it does not.

    options, inputs : what decides the result, with the inputs' contents; sources : files too many to read for that,
    known by size and time of change. Parts of another command are thrown away.
    """
    check_output(output, inputs, overwrite)
    with claim(output):
        identity = _identity(stage, options, inputs, sources)
        root = output.with_name(f"{output.name}.parts")
        folder = root / identity[:16]
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
        engine: Any = open_dask(scheduler, folder) if scheduler else contextlib.nullcontext(Here())
        with engine as working:
            yield Job(folder.resolve(), working, say, progress, again)
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


def _identity(stage: str, options: Mapping[str, Any], inputs: Sequence[Path], sources: Sequence[Path]) -> str:
    for path in inputs:
        if not path.is_file():
            raise InputError(f"{path}: no such file; check the path or run the stage that writes it.")
    what = {
        "stage": stage,
        "version": version("lunargr"),
        "options": dict(options),
        "inputs": [sha256(path) for path in inputs],
        "sources": [_state(path) for path in sources],
    }
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()


def _state(path: Path) -> list[Any]:
    try:
        found = os.stat(path)
    except OSError:
        return [str(path)]
    return [str(path), found.st_size, found.st_mtime_ns]
