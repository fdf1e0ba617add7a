"""Windows predicted in several threads, whose strips come out as they are made."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch

from stages.common.threads import one_thread

Job = TypeVar("Job")
Item = TypeVar("Item")


def run_in_threads(
    jobs: Sequence[Job], work: Callable[[Job], Iterator[Item]], together: int
) -> Iterator[tuple[int, Item | None]]:
    """Yield (job number, item) for all that ``work`` yields, and (job number, None) after a job's last item.

    The items of one job come in order, those of different jobs in any. ``together`` threads work, but no more than
    PyTorch may use, and each of PyTorch's operators runs on one. At most two items a thread wait for the caller. An
    error in one thread ends all, and so does leaving the loop, once the items that are being made are done.
    """
    together = max(1, min(together, torch.get_num_threads(), len(jobs)))
    made: queue.Queue[tuple[int, Item | None] | BaseException] = queue.Queue(2 * together)
    stop = threading.Event()
    left = deque(enumerate(jobs))

    def hand_over(result: tuple[int, Item | None] | BaseException) -> None:
        while not stop.is_set():
            try:
                made.put(result, timeout=0.1)
                return
            except queue.Full:
                continue

    def take_jobs() -> None:
        try:
            while not stop.is_set():
                try:
                    number, job = left.popleft()
                except IndexError:
                    return
                for item in work(job):
                    hand_over((number, item))
                    if stop.is_set():
                        return
                hand_over((number, None))
        except BaseException as error:
            hand_over(error)

    workers = [threading.Thread(target=take_jobs, name=f"strips {k}", daemon=True) for k in range(together)]
    with one_thread():
        try:
            for worker in workers:
                worker.start()
            finished = 0
            while finished < len(jobs):
                result = made.get()
                if isinstance(result, BaseException):
                    raise result
                finished += result[1] is None
                yield result
        finally:
            stop.set()
            for worker in workers:
                if worker.ident is not None:
                    worker.join()
