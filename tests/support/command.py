"""`lunargr` within the process of the tests: what a shell would get, without the seconds in which a new one imports PyTorch.

What only a process of its own shows (streams, signals, threads, exit) stands in test_streams.py and test_interruptions.py.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import signal
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from lunargr_cli import main as cli


@dataclass
class Done:
    """Like subprocess.CompletedProcess."""

    returncode: int
    stdout: str
    stderr: str


def lunargr(*arguments, cwd: Path | None = None) -> Done:
    """A command line, as its words."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with contextlib.ExitStack() as stack:
        for context in (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            contextlib.chdir(cwd or os.curdir),
            mock.patch.object(sys, "argv", ["lunargr", *map(str, arguments)]),
            mock.patch.object(os, "_exit", sys.exit),  # the command line leaves Python at once after an error
            mock.patch.object(gc, "freeze"),
            warnings.catch_warnings(),
        ):
            stack.enter_context(context)
        warnings.simplefilter("ignore")
        try:
            cli.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return Done(code, out.getvalue(), err.getvalue())


def outcome(*arguments) -> tuple[int, str]:
    """Exit code, and all that was printed."""
    done = lunargr(*arguments)
    return done.returncode, done.stdout + done.stderr
