"""The engines that work on parts: this process, one part after the other, or the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from schemas.command_line import recording, running_command
from schemas.errors import ConfigError, InputError, LunargrError
from schemas.files.companions import companions_of
from schemas.files.locks import unlocked
from schemas.provenance import known_digests

ANSWER_WITHIN = 10.0  # seconds in which a scheduler must answer
WORKER_WITHIN = 300.0  # seconds in which it must have a worker: a queue may have to start it
DEATHS = 5  # of workers on one part, before the part is blamed
RETRIES = 2  # of a part after an error of the machine it ran on


@dataclass(frozen=True)
class Task:
    """``function(path, **arguments)`` writes the part ``path``, whole or not at all."""

    function: Callable[..., Any]
    path: Path
    arguments: dict[str, Any]


class Engine(Protocol):
    """Where the parts of a stage are worked on."""

    def work(self, tasks: Sequence[Task]) -> Iterator[Path]:
        """Do all tasks; a part's path as it is finished."""


class ThisProcess:
    """One after the other, in this process."""

    def work(self, tasks: Sequence[Task]) -> Iterator[Path]:
        """Do all tasks one after the other; a part's path as it is finished."""
        for task in tasks:
            with unlocked(), companions_of(None):
                task.function(task.path, **task.arguments)
            yield task.path


@contextlib.contextmanager
def open_dask(scheduler: str, folder: Path) -> Iterator[Engine]:
    """An engine with ``local:N`` workers of its own, or those of the scheduler at an address. Raises ConfigError."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ConfigError(
            f"`scheduler`: needs Dask distributed ({error.name} is missing); install it with: pip install 'lunargr[cluster]'."
        ) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    kind, _, number = scheduler.partition(":")
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(_settings(int(number) if kind == "local" else 1)))
        if kind == "local":
            cluster = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=int(number),
                    threads_per_worker=1,
                    memory_limit=None,
                    dashboard_address="127.0.0.1:0",
                    local_directory=str(folder),
                )
            )
            client = stack.enter_context(distributed.Client(cluster))
        else:
            client = stack.enter_context(_connect(scheduler))
        yield _Dask(client, scheduler)


def _settings(workers: int) -> dict[str, Any]:
    threads = str(max(1, (os.cpu_count() or 1) // workers))
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    environment = {name: os.environ.get(name, threads) for name in names}
    return {
        # Workers that are stopped during a part, after an error in another, would log that at length.
        "distributed.nanny.pre-spawn-environ": environment | {"DASK_LOGGING__DISTRIBUTED": "critical"},
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.comm.timeouts.connect": f"{ANSWER_WITHIN:g}s",
        "distributed.diagnostics.nvml": False,
    }


def _connect(address: str) -> Any:
    import distributed

    silent = ConfigError(
        f"`scheduler`: no Dask scheduler answers at '{address}'; expected local:N, or the address that 'dask scheduler' "
        "prints, such as tcp://10.0.0.1:8786."
    )
    try:
        client = distributed.Client(address, timeout=f"{ANSWER_WITHIN:g}s")
    except (OSError, TimeoutError, ValueError):
        raise silent from None
    try:
        client.wait_for_workers(1, timeout=float(os.environ.get("LUNARGR_WAIT_FOR_WORKERS", WORKER_WITHIN)))
    except (OSError, TimeoutError):
        client.close()
        raise ConfigError(
            f"`scheduler`: the scheduler at '{address}' has no workers; start some with: dask worker {address}"
        ) from None
    return client


@dataclass
class _Dask:
    client: Any
    name: str

    def work(self, tasks: Sequence[Task]) -> Iterator[Path]:
        """Do all tasks; paths come as parts are finished. A part whose worker dies is given to another worker."""
        import distributed

        if not tasks:
            return
        # Given along with every task: data scattered to workers would die with them.
        common = version("lunargr"), dict(known_digests), running_command.get()
        waiting = [
            self.client.submit(_work, task, common, key=str(task.path), pure=False, retries=RETRIES) for task in tasks
        ]
        paths: Mapping[Any, Path] = {future.key: task.path for future, task in zip(waiting, tasks, strict=True)}
        try:
            for future in distributed.as_completed(waiting):
                path = paths[future.key]
                try:
                    error = future.result()
                except distributed.KilledWorker:
                    raise InputError(
                        f"{path.name}: {DEATHS + 1} workers died while they worked on this part (out of memory?); "
                        "give workers more memory, or make smaller parts with `parts`."
                    ) from None
                except (distributed.client.FutureCancelledError, distributed.comm.CommClosedError, TimeoutError):
                    raise InputError(
                        f"`scheduler`: lost the scheduler '{self.name}'; finished parts stay: run the command again."
                    ) from None
                if error is not None:
                    raise error
                future.release()
                yield path
        finally:
            with contextlib.suppress(Exception):
                self.client.cancel(waiting, force=True)


def _work(task: Task, common: tuple[str, dict[Any, str], tuple[str, str] | None]) -> LunargrError | None:
    """Do a task on a worker. A LunargrError is returned and not raised: another worker would only find the same."""
    expected, digests, command = common
    if version("lunargr") != expected:
        return ConfigError(
            f"`scheduler`: the worker on {socket.gethostname()} has lunargr {version('lunargr')}, expected {expected}; install the same."
        )
    known_digests.update(digests)
    if task.path.exists():  # by a worker that was given up too early
        return None
    try:
        with unlocked(), recording(command):
            task.function(task.path, **task.arguments)
    except LunargrError as error:
        return error
    return None
