"""The lunargr command line."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from types import FrameType
from typing import Any

INTERRUPTED = "lunargr: interrupted; nothing half-written was kept."
IMPORT_POLL = 0.02  # seconds
signals: list[int] = []  # that asked this command to stop


def stop(number: int, frame: Any) -> None:
    """Unwind: locks are let go of, and partial files go. An import ends first: libraries print what breaks theirs."""
    signals.append(number)
    if _is_importing(frame):
        signal.signal(signal.SIGALRM, lambda _, later: stop(number, later))
        signal.setitimer(signal.ITIMER_REAL, IMPORT_POLL)
        return
    raise_again()


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


def raise_again() -> None:
    """Python swallows what is raised while it collects garbage: whoever is called often asks here."""
    if signals:
        raise KeyboardInterrupt if signals[0] == signal.SIGINT else SystemExit(128 + signals[0])


def quiet_interruptions() -> None:
    """Where Python swallows an interruption it prints a traceback; ours is raised again, and that is enough."""
    before = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if not (signals and isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit)):
            before(unraisable)

    sys.unraisablehook = hook


def _leave(number: int, frame: Any) -> None:
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(128 + number)


# Ctrl-C or `kill` while the command is still being imported; `main` has its own way from then on. Only in the command's own process:
# a program that uses this package as a library keeps its handlers.
if (
    os.path.basename((sys.argv or [""])[0]) in ("lunargr", "-m")
    and multiprocessing.parent_process() is None
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
):
    with contextlib.suppress(ValueError):  # not the main thread
        for _number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(_number, _leave)
