"""How far a long loop is and how long it still takes, as a bar on a terminal or a line in a log."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable

MOST_MARKS = 256
LONGEST_BAR = 30  # characters


class Pace:
    """The speed of a loop from its own reports, wherever it began.

    What is left is reckoned from the later half of what this run has done: neither the work that a resumed run found
    finished counts, nor compilation and cold disks at the start. Another total, or a count that falls back, is another loop.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._total = -1
        self._times: list[float] = []
        self._done: list[int] = []

    def report(self, done: int, total: int) -> tuple[float, float | None]:
        """Seconds since the loop's first report, and seconds that are left; None where nothing is known yet."""
        now = self._clock()
        if total != self._total or (self._done and done < self._done[-1]):
            self._total, self._times, self._done = total, [], []
        if not self._done or done > self._done[-1]:
            self._times.append(now)
            self._done.append(done)
        first, last = self._done[0], self._done[-1]
        elapsed = now - self._times[0]
        if last == first:
            return elapsed, None
        middle = min(bisect_left(self._done, first + (last - first) // 2), len(self._done) - 2)
        seconds_each = (self._times[-1] - self._times[middle]) / (last - self._done[middle])
        if len(self._done) > MOST_MARKS:  # every second one is enough
            del self._times[1:-1:2], self._done[1:-1:2]
        return elapsed, seconds_each * (total - done)


def bar_line(label: str, done: int, total: int, times: tuple[float, float | None], width: int, plain: bool) -> str:
    """'epoch 2/6 ━━━━━━──── 38 %, 14 s, 42 s left', in at most ``width`` characters; plain : ASCII alone"""
    words = f" {progress_words(done, total, times)}"
    room = min(LONGEST_BAR, width - len(label) - len(words) - 2)
    if room < 5 or total <= 0:
        return f"{label}{words}"[: width - 1]
    full = room * min(max(done, 0), total) // total
    filled, empty = ("#", "-") if plain else ("━", "─")
    return f"{label} {filled * full}{empty * (room - full)}{words}"


def progress_words(done: int, total: int, times: tuple[float, float | None]) -> str:
    """'38 %, 14 s, 42 s left'"""
    elapsed, left = times
    rest = f", {duration(left)} left" if left is not None and done < total else ""
    share = 100 * done // total if total > 0 else 100
    return f"{share} %, {duration(elapsed)}{rest}"


def duration(seconds: float) -> str:
    """'42 s', '3 min 05 s', '2 h 07 min'"""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
