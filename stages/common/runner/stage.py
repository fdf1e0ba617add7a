"""The declaration of a stage, and all that is done around its work."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from schemas.command_line import is_first_process
from schemas.errors import ConfigError
from schemas.files.companions import companions_of
from schemas.files.inputs import Inputs, check_input
from schemas.files.locks import claim
from schemas.files.outputs import Output, Target, check_apart, check_places, map_targets, protect, write_json

MOST_WORKERS = 4096  # of one machine
P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Call:
    """One call of a stage. arguments : all, by name; ``output`` as an Output"""

    arguments: Mapping[str, Any]

    @property
    def output(self) -> Output:
        """Where it writes."""
        return self.arguments["output"]

    @property
    def config(self) -> Any:
        """What it is told."""
        return self.arguments["config"]

    @property
    def inputs(self) -> list[Any]:
        """What comes before ``output``."""
        return list(self.arguments.values())[: list(self.arguments).index("output")]

    @property
    def files(self) -> list[Path]:
        """The paths among the inputs."""
        return list(paths_in(self.inputs))


def paths_in(values: Iterable[Any]) -> Iterator[Path]:
    """The paths among values and lists of values."""
    for value in values:
        if isinstance(value, list | tuple):
            yield from paths_in(value)
        elif isinstance(value, Path):
            yield value


def the_output(call: Call) -> list[Target]:
    """The one file of most stages."""
    return [Target(call.output.file)]


def as_geotiff(config: Any) -> bool:
    """Whether a map is written as a GeoTIFF too: a shard, which holds some rows only, is not."""
    return bool(config.geotiff) and config.shard[1] == 1


def the_map(call: Call) -> list[Target]:
    """The file of a map, and its GeoTIFF where one is written."""
    return map_targets(call.output, as_geotiff(call.config))


def stage(
    reads: Callable[[Call], Iterable[Path | None]] = lambda call: call.files,
    writes: Callable[[Call], Iterable[Target]] = the_output,
    main: Callable[[Call], Path | None] = lambda call: call.output.path,
    check: Callable[[Call], None] = lambda call: None,
    content: Callable[[Any], Any] | None = None,
    in_parts: bool = False,
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a stage of ``run(inputs..., output, config, ...)``.

    Before ``run`` is called, everything that can be refused is refused (:func:`prepared`); it gets an :class:`Output`.

    reads : the files that no output may replace; writes : all files that may be written
    main : the file or folder that a run holds the lock of. Other files become whole before it, and go where it does not.
    check : refuses options, before a large library is imported
    content : of the result, for ``output.json``; None for stages that write their JSON themselves
    in_parts : whether the module of ``run``, or ``stage`` in its package, has ``in_parts(job, inputs..., config)``: the
        same, with what it has ``job`` work on
    """

    def decorate(run: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(run)

        @functools.wraps(run)
        def started(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            given = bound.arguments
            given["output"] = output = Output.at(given["output"])
            call = Call(given)
            _check_parts(call)
            check(call)
            files = [path for path in reads(call) if path is not None]
            if output.path is not None:  # before a wrong ending is refused
                check_apart([Target(output.path)], Inputs(files))
            targets = list(writes(call))
            if content is not None and output.json is not None:
                targets.append(Target(output.json, "json"))
            with prepared(files, targets, output.overwrite, main(call)) as known:
                if in_parts and output.in_parts:
                    result = _run_in_parts(run.__module__, call, known)
                else:
                    result = run(*bound.args, **bound.kwargs)
                if content is not None and output.json is not None:
                    write_json(output.json, content(result))
            return result

        return started

    return decorate


@contextlib.contextmanager
def prepared(
    reads: Iterable[Path], writes: Iterable[Target] = (), overwrite: bool = False, main: Path | None = None
) -> Iterator[Inputs]:
    """Refuse, before anything is made, what cannot be read or written; within the block only ``writes`` are replaced.

    main : see :func:`stage`. Raises ConfigError, InputError.
    """
    reads, writes = list(reads), list(writes)
    for path in reads:
        check_input(path)
    known = Inputs(reads)
    beside = main if any(target.path == main for target in writes) else None
    check_apart(writes, known)
    with protect(known, writes, overwrite), claim(main) if main and is_first_process() else contextlib.nullcontext():
        check_places(writes, overwrite)  # after the lock: whoever gets it tidies up after a killed run
        with companions_of(beside):
            yield known


def _run_in_parts(package: str, call: Call, known: Inputs) -> Any:
    """Have the stage's ``in_parts`` do the work."""
    from stages.common.runner.job import Identity, open_job

    if call.output.path is None:
        raise ConfigError("expected `output` with `scheduler` (the parts lie beside it), found none.")
    inputs = [_resolved(value) for value in call.inputs]
    files = list(paths_in(inputs))
    others = sorted({p.resolve() for p in known.paths} - set(files))
    identity = Identity(package, {"config": call.config, "parts": call.output.parts}, files, others)
    module = importlib.import_module(package)
    work = (importlib.import_module(f"{package}.stage") if hasattr(module, "__path__") else module).in_parts
    told = {name: call.arguments[name] for name in ("say", "progress") if name in call.arguments}
    with open_job(call.output, identity, **told) as job:
        return work(job, *inputs, call.config)


def _check_parts(call: Call) -> None:
    """Refuse ways to work in parts that cannot be, or not together. Raises ConfigError."""
    output = call.output
    if output.parts is not None and not output.in_parts:
        raise ConfigError("`parts`: expected `scheduler` or `resume` beside it.")
    if output.in_parts and getattr(call.config, "shard", (0, 1)) != (0, 1):
        raise ConfigError(
            "`shard`: one part by hand; `scheduler` and `resume` make all parts themselves. Give one of them."
        )
    if (text := output.scheduler) is None:
        return
    kind, _, number = text.partition(":")
    local = number.isdecimal() and len(number) < 9 and 1 <= int(number) <= MOST_WORKERS
    if not text.strip() or (kind == "local" and not local):
        raise ConfigError(
            f"`scheduler`: expected an address, or local:N with 1 <= N <= {MOST_WORKERS} workers, found '{text}'."
        )


def _resolved(value: Any) -> Any:
    """Paths as workers in other folders find them."""
    if isinstance(value, list | tuple):
        return [_resolved(v) for v in value]
    return value.resolve() if isinstance(value, Path) else value
