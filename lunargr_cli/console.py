"""What a person sees: progress, tables and errors. Progress and messages go to standard error, results to standard output.

Names and texts come from files that others wrote: whatever is printed loses here what would steer a terminal.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import os
import shutil
import sys
import time
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lunargr_cli import raise_again
from lunargr_cli.spelling import spell
from schemas.command_line import is_first_process
from schemas.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress

_BEGAN = time.monotonic()
LIBRARIES = "LUNARGR_LIBRARY_MESSAGES"  # set: what libraries print on standard error is let through
# Control codes, marks that turn the direction of writing, halves of surrogate pairs, line separators.
_STEERING = ("Cc", "Cf", "Cs", "Zl", "Zp")


def harmless(text: str) -> str:
    """The text with what steers a terminal spelled out: an escape code becomes the four characters \\x1b."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if c in "\n\t" or unicodedata.category(c) not in _STEERING else _spelled(c) for c in text)


def without_steering(text: str) -> str:
    """The text without what steers a terminal or ends a line."""
    return "".join(c for c in text if unicodedata.category(c) not in _STEERING)


def _spelled(character: str) -> str:
    return character.encode("unicode_escape", "surrogatepass").decode()


def write_out(text: str) -> None:
    """A line, or several, of a result on standard output."""
    with _standard_output():
        print(harmless(text))


@contextlib.contextmanager
def _standard_output() -> Iterator[None]:
    """A full disk behind ``> list.txt`` in one line. Raises InputError; BrokenPipeError where nobody reads any more."""
    try:
        yield
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is still held would fail once more
        raise InputError(
            f"standard output: cannot be written ({error.strerror}); free some space, or send it elsewhere."
        ) from None


def flush_out() -> None:
    """Hand over what standard output still holds. Raises InputError, BrokenPipeError."""
    with _standard_output():
        sys.stdout.flush()


def say_error(message: str) -> None:
    """One line on standard error."""
    print(f"lunargr: {harmless(' '.join(message.split()))}", file=sys.stderr)


def say_resources() -> None:
    """Time and memory of this process and the parts that it had done, on standard error."""
    import resource

    own, parts = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    processor = sum(r.ru_utime + r.ru_stime for r in (own, parts))
    unit = 1 if sys.platform == "darwin" else 1024  # bytes
    memory = max(own.ru_maxrss, parts.ru_maxrss) * unit / 1e6
    started = time.monotonic() - _BEGAN
    print(f"lunargr: {started:.1f} s, {processor:.1f} s of processor time, at most {memory:,.0f} MB", file=sys.stderr)


@dataclass
class Console:
    """The messages and progress of one command.

    A stage takes ``console.progress`` as a callable ``(done, total, what)``; on a terminal it is a bar that is redrawn,
    in a log file a line every ten seconds. Under torchrun the first process alone speaks. clock : in seconds
    """

    quiet: bool = False
    clock: Callable[[], float] = time.monotonic
    _bars: Progress | None = field(default=None)
    _shown: float | None = field(default=None)
    _drawn: bool = field(default=False)

    def __post_init__(self) -> None:
        self.quiet |= not is_first_process()

    def say(self, message: str) -> None:
        """A line for the person at the terminal."""
        if not self.quiet:
            self._wipe_bar()
            print(harmless(spell(message)), file=sys.stderr, flush=True)

    def progress(self, done: int, total: int, what: str = "") -> None:
        """Show how far a long loop is and how long it still takes."""
        raise_again()
        if self.quiet:
            return
        terminal, now = sys.stderr.isatty(), self.clock()
        if self._shown is None:  # a short loop leaves one line in a log
            self._shown = -math.inf if terminal else now
        bars = self._bars_of(done, total, terminal)
        bars.update(bars.task_ids[0], completed=done, description=harmless(what or "progress"))
        if (done < total and now - self._shown < (0.1 if terminal else 10.0)) or not (done or terminal):
            return
        self._shown = now
        line = _one_line(bars, terminal)
        print(f"\r\x1b[K{line}" if terminal else line, end="" if terminal else "\n", file=sys.stderr, flush=True)
        self._drawn = terminal
        if done >= total:
            self._end_bar()

    def _bars_of(self, done: int, total: int, terminal: bool) -> Progress:
        """The progress of the loop that reports: another total, or a count that falls back, is another loop.

        Its speed is that of its own last thousand reports: what a resumed run found finished does not count.
        """
        from rich.progress import (
            BarColumn,
            Progress,
            TaskProgressColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        task = self._bars.tasks[0] if self._bars else None
        if self._bars is None or task is None or task.total != total or done < task.completed:
            columns = [
                TextColumn("{task.description}", markup=False),
                *([BarColumn()] if terminal else []),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
            ]
            self._bars = Progress(*columns, auto_refresh=False, get_time=self.clock, speed_estimate_period=math.inf)
            self._bars.add_task("", total=total, completed=done)
        return self._bars

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """A result table on standard output, plain enough for a log and a pipe."""
        if self.quiet:
            return
        self._wipe_bar()
        from rich import box
        from rich.console import Console as RichConsole
        from rich.table import Table

        table = Table(title=harmless(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        cells = [[harmless(str(cell)) for cell in row] for row in rows]
        for k, column in enumerate(columns):
            numeric = cells and all(row[k][:1] in "-+.0123456789" for row in cells)
            table.add_column(harmless(column), justify="right" if numeric else "left", overflow="fold")
        for row in cells:
            table.add_row(*row)
        width = None if sys.stdout.isatty() else 160
        with _standard_output():
            RichConsole(file=sys.stdout, width=width, highlight=False, markup=False).print(table)

    def _wipe_bar(self) -> None:
        """Take the unfinished bar away: the next report draws it again below what is said now."""
        if self._drawn:
            print("\r\x1b[K", end="", file=sys.stderr)
            self._drawn = False

    def _end_bar(self) -> None:
        if self._drawn:
            print(file=sys.stderr)
            self._drawn = False


def _one_line(bars: Progress, terminal: bool) -> str:
    """A progress as it is drawn: with colours and a bar on a terminal, in the characters that it has."""
    from rich.console import Console as RichConsole

    encoding = sys.stderr.encoding or "utf-8"
    drawn = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="backslashreplace", newline="")
    width = max(20, shutil.get_terminal_size().columns - 1) if terminal else 160
    RichConsole(file=drawn, width=width, force_terminal=terminal).print(bars.make_tasks_table(bars.tasks))
    drawn.seek(0)
    return drawn.readline().rstrip()


def set_up_streams(verbose: bool = False) -> None:
    """Standard output and error for our lines alone, also where the shell closed them.

    PROJ, libtiff, HDF5 and others print on the error stream from C, Python's libraries by warnings and loggers. What they
    have to say to a user our own line says; -v and LUNARGR_LIBRARY_MESSAGES=1 let them speak.
    """
    for number in (0, 1, 2):  # else the first file that is opened gets the place of a closed stream
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if (
        verbose or os.environ.get(LIBRARIES) or sys.stderr is not sys.__stderr__
    ):  # a caller's own streams are left alone
        return
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    logging.lastResort = None
    logging.raiseExceptions = False
    own, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    # For good: C libraries go on talking while Python ends.
    sys.stderr = os.fdopen(own, "w", buffering=1, errors="backslashreplace")
