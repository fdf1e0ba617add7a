"""What a person sees: progress, tables and errors. Progress and messages go to standard error, results to standard output."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from lunargr_cli import raise_again


def one_line(message: str) -> str:
    """A message without line breaks, and without what a terminal would obey: file names and values of options hold it."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))


def say_error(message: str) -> None:
    """One line on standard error."""
    print(f"lunargr: {one_line(message)}", file=sys.stderr)


@dataclass
class Console:
    """The messages and progress of one command.

    ``stage.run`` takes ``console.progress`` as a callable ``(done, total, what)``; on a terminal the line is redrawn,
    in a log file it is printed every ten seconds.
    """

    quiet: bool = False
    _started: float = field(default_factory=time.monotonic)
    _shown: float = field(default=0.0)
    _open_line: bool = field(default=False)

    def say(self, message: str) -> None:
        """A line for the person at the terminal."""
        if not self.quiet:
            self._end_line()
            print(message, file=sys.stderr, flush=True)

    def progress(self, done: int, total: int, what: str = "") -> None:
        """Show how far a long loop is and how long it still takes."""
        raise_again()
        now = time.monotonic()
        if done == 0:
            self._started = now
        terminal = sys.stderr.isatty()
        if self.quiet or (done < total and now - self._shown < (0.1 if terminal else 10.0)):
            return
        self._shown = now
        elapsed = now - self._started
        left = f", {_duration(elapsed / done * (total - done))} left" if 0 < done < total else ""
        line = f"{what or 'progress'}: {done}/{total} ({_duration(elapsed)}{left})"
        if terminal:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
            self._open_line = True
            if done >= total:
                self._end_line()
        elif done:
            print(line, file=sys.stderr, flush=True)

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """A result table on standard output, plain enough for a log and a pipe."""
        if self.quiet:
            return
        self._end_line()
        from rich import box
        from rich.console import Console as RichConsole
        from rich.table import Table

        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        cells = [[str(cell) for cell in row] for row in rows]
        for k, column in enumerate(columns):
            numeric = cells and all(row[k][:1] in "-+.0123456789" for row in cells)
            table.add_column(column, justify="right" if numeric else "left", overflow="fold")
        for row in cells:
            table.add_row(*row)
        width = None if sys.stdout.isatty() else 160
        RichConsole(file=sys.stdout, width=width, highlight=False, markup=False).print(table)

    def _end_line(self) -> None:
        if self._open_line:
            print(file=sys.stderr)
            self._open_line = False


Progress = Callable[[int, int, str], None]


def _duration(seconds: float) -> str:
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
