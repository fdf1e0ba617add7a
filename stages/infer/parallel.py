"""Windows worked on side by side, their strips handed over as they are made."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch

Job = TypeVar("Job")
Item = TypeVar("Item")


def side_by_side(
    jobs: Sequence[Job], work: Callable[[Job], Iterator[Item]], together: int
) -> Iterator[tuple[int, Item | None]]:
    """(the job's number, what ``work`` yields of it), and (number, None) after its last; in order within a job only.

    ``together`` threads, no more than PyTorch may use, have one of its threads each. What they make waits for the
    caller, two pieces a thread at most. An error in one ends all; so does leaving the loop, after the strips that are being worked on.
    """
    threads = torch.get_num_threads()
    together = max(1, min(together, threads, len(jobs)))
    made: queue.Queue[tuple[int, Item | None] | BaseException] = queue.Queue(2 * together)
    stop = threading.Event()
    left = deque(enumerate(jobs))

    def hand_over(what: tuple[int, Item | None] | BaseException) -> None:
        while not stop.is_set():
            try:
                made.put(what, timeout=0.1)
                return
            except queue.Full:
                continue

    def go() -> None:
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

    torch.set_num_threads(1)  # a convolution shared out among threads adds up in another order, which bf16 shows
    workers = [threading.Thread(target=go, name=f"strips {k}", daemon=True) for k in range(together)]
    try:
        for worker in workers:
            worker.start()
        finished = 0
        while finished < len(jobs):
            what = made.get()
            if isinstance(what, BaseException):
                raise what
            finished += what[1] is None
            yield what
    finally:
        stop.set()
        for worker in workers:
            if worker.ident is not None:
                worker.join()
        torch.set_num_threads(threads)


def in_order(found: Iterator[tuple[int, Item | None]]) -> Iterator[tuple[int, Item | None]]:
    """The same, all of a job before anything of the next."""
    waiting: dict[int, list[Item | None]] = {}
    current = 0
    for number, item in found:
        waiting.setdefault(number, []).append(item)
        while waiting.get(current):
            for early in waiting[current]:
                yield current, early
            ended = waiting[current][-1] is None
            waiting[current].clear()
            if not ended:
                break
            del waiting[current]
            current += 1
