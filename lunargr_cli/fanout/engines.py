"""Where parts are worked on: in this process, one after the other, or on the workers of a Dask cluster."""

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

from lunargr_cli.options import check_scheduler
from schemas.errors import ConfigError, InputError, LunargrError

ANSWER = 10.0  # seconds in which a scheduler must answer
WORKERS = 300.0  # seconds in which it must have a worker: a queue may have to start it
DEATHS = 5  # workers that one part may take down before it is blamed
ERRORS = 2  # times that a part is tried again after an error of the machine it ran on


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


class Here:
    """One after the other, in this process."""

    def work(self, tasks: Sequence[Task]) -> Iterator[Path]:
        """Do all tasks one after the other; a part's path as it is finished."""
        from schemas.files.locks import unlocked

        for task in tasks:
            with unlocked():
                task.function(task.path, **task.arguments)
            yield task.path


@contextlib.contextmanager
def open_dask(scheduler: str, folder: Path) -> Iterator[Engine]:
    """``local:N`` workers of our own, or those of the scheduler at an address. Raises ConfigError, one line."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ConfigError(
            f"--scheduler: needs Dask distributed ({error.name} is missing); install it with: pip install 'lunargr[cluster]'."
        ) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    check_scheduler(scheduler)
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
        # Workers that are stopped with work in their hands, after an error in another's, would say so at length.
        "distributed.nanny.pre-spawn-environ": environment | {"DASK_LOGGING__DISTRIBUTED": "critical"},
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.comm.timeouts.connect": f"{ANSWER:g}s",
        "distributed.diagnostics.nvml": False,
    }


def _connect(address: str) -> Any:
    import distributed

    where = ConfigError(
        f"--scheduler: no Dask scheduler answers at '{address}'; expected local:N, or the address that 'dask scheduler' "
        "prints, such as tcp://10.0.0.1:8786."
    )
    try:
        client = distributed.Client(address, timeout=f"{ANSWER:g}s")
    except (OSError, TimeoutError, ValueError):
        raise where from None
    try:
        client.wait_for_workers(1, timeout=float(os.environ.get("LUNARGR_WAIT_FOR_WORKERS", WORKERS)))
    except (OSError, TimeoutError):
        client.close()
        raise ConfigError(
            f"--scheduler: the scheduler at '{address}' has no workers; start some with: dask worker {address}"
        ) from None
    return client


@dataclass
class _Dask:
    client: Any
    name: str

    def work(self, tasks: Sequence[Task]) -> Iterator[Path]:
        """As they come. A part whose worker dies is given to another; one that fails is not tried elsewhere."""
        import distributed

        from schemas.provenance import current_command, known_digests

        if not tasks:
            return
        # Given along with every task: data scattered to workers would die with them.
        common = version("lunargr"), dict(known_digests), current_command()
        waiting = [
            self.client.submit(_work, task, common, key=str(task.path), pure=False, retries=ERRORS) for task in tasks
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
                        "give workers more memory, or make smaller parts with --parts."
                    ) from None
                except (distributed.client.FutureCancelledError, distributed.comm.CommClosedError, TimeoutError):
                    raise InputError(
                        f"--scheduler: lost the scheduler '{self.name}'; finished parts stay: run the command again."
                    ) from None
                if error is not None:
                    raise error
                future.release()
                yield path
        finally:
            with contextlib.suppress(Exception):
                self.client.cancel(waiting, force=True)


def _work(task: Task, common: tuple[str, dict[Any, str], tuple[str, str] | None]) -> LunargrError | None:
    """On a worker. A LunargrError is an answer: no other worker would find anything else."""
    from schemas.files.locks import unlocked
    from schemas.provenance import known_digests, run_by

    expected, digests, command = common
    if version("lunargr") != expected:
        return ConfigError(
            f"--scheduler: the worker on {socket.gethostname()} has lunargr {version('lunargr')}, expected {expected}; install the same."
        )
    known_digests.update(digests)
    if task.path.exists():  # by a worker that was given up too early
        return None
    try:
        with unlocked(), run_by(command):
            task.function(task.path, **task.arguments)
    except LunargrError as error:
        return error
    return None
