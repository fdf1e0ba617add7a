"""The `lunargr` command: one sub-command per stage. Heavy imports happen inside the commands."""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import os
import pkgutil
import shlex
import signal
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from lunargr_cli import INTERRUPTED, commands, quiet_interruptions, signals, stop
from lunargr_cli.console import Console, flush_out, say_error, say_resources, set_up_streams, write_out
from lunargr_cli.next_step import next_step
from lunargr_cli.options import check_numbers
from lunargr_cli.spelling import running, spell
from schemas.command_line import count_processes, recording
from schemas.errors import EXIT_CODE, InputError, LunargrError

# Threads that wait for each other by spinning slow a busy machine down many times over. Read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

VERBOSE = ("--verbose", "-v")


def _command_line() -> str:
    """What made this process, as one would type it again."""
    words = ["lunargr", *sys.argv[1:]]
    processes, here = count_processes()
    if processes > 1:
        nodes = ["--nnodes", str(processes // here)] if processes > here else []
        words = ["torchrun", *nodes, "--nproc-per-node", str(here), "-m", "lunargr_cli.main", *sys.argv[1:]]
    return shlex.join(words)


def _folder() -> str:
    """The working folder. Raises InputError."""
    try:
        return os.getcwd()
    except OSError:
        raise InputError("the working folder is gone; change to one that exists and run the command again.") from None


def _plain(text: str) -> str:
    """Text that HDF5 and JSON can keep, whatever bytes a name has."""
    return text.encode("utf-8", "backslashreplace").decode()


def _as_typed(name: str, command: Callable[..., None]) -> Callable[..., None]:
    """The command with what every one of them needs around it; its last line says what usually follows.

    No number reaches it that is not finite, its command line is known to what it writes, and its errors name its options.
    """

    @functools.wraps(command)
    def run(**options: Any) -> None:
        spelled = running.set(command)
        try:
            check_numbers(command, options)
            made_by = _plain(_command_line()), _plain(_folder())
            with recording(made_by):
                command(**options)
            if step := next_step(name, options):
                Console(options.get("quiet", False)).say(f"next: {step}")
        except LunargrError as error:
            raise type(error)(spell(str(error))) from None
        finally:
            running.reset(spelled)

    return run


app = typer.Typer(
    name="lunargr",
    help="Learn the reflectance of the Moon from terrain and images, and find what a simulation of them gets wrong.\n\n"
    "simulate -> ingest -> sample -> project -> train -> infer -> albedo -> refine -> render / view -> evaluate / match, and diagnose",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        write_out(f"lunargr {version('lunargr')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and stop.")
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            *VERBOSE,
            help="Show messages of libraries, and print time and memory at the end. Works before or after COMMAND.",
        ),
    ] = False,
) -> None:
    """Options before a command."""


for _module in sorted(
    (importlib.import_module(f"lunargr_cli.commands.{m.name}") for m in pkgutil.iter_modules(commands.__path__)),
    key=lambda module: module.ORDER,
):
    _command = _as_typed(_module.NAME, _module.command)
    # Named, the first sentence is wrapped in the list of commands; left to click, it is cut off.
    _summary = " ".join((_module.command.__doc__ or "").split()).split(". ")[0].rstrip(".")
    app.command(name=_module.NAME, cls=getattr(_module, "CLASS", None), short_help=_summary)(_command)


def take_verbose(words: list[str]) -> bool:
    """Take -v out of a command line, wherever it stands: it is no part of what a command does, nor of its record."""
    end = words.index("--") if "--" in words else len(words)
    kept = [word for word in words[:end] if word not in VERBOSE]
    verbose = len(kept) < end
    words[:end] = kept
    return verbose


def main() -> None:
    """Run the command line; a LunargrError is one line on standard error and exit code 3."""
    words = sys.argv[1:]
    verbose = take_verbose(words)
    sys.argv[1:] = words
    set_up_streams(verbose)
    for number in (signal.SIGINT, signal.SIGTERM):  # a Slurm time limit or `kill` unwinds like Ctrl-C
        signal.signal(number, stop)
    quiet_interruptions()
    # Objects of PyTorch's import are collected neither again and again nor, by freeze below, at the end. Measured on `infer` of a
    # small scene: without both, 22 % more processor time.
    gc.set_threshold(10_000, 10, 10)
    try:
        try:
            app()
        finally:
            flush_out()
            if verbose:
                say_resources()
    except BaseException as error:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # nothing is left to tidy while Python ends
        # What an interruption breaks may say something else: a library that was just being imported, for one.
        if signals or isinstance(error, KeyboardInterrupt):
            print(INTERRUPTED, file=sys.stderr, flush=True)
            # Not sys.exit: Python would end itself by the signal where one of its own parts saw the interruption.
            os._exit(128 + (signals or [signal.SIGINT])[0])
        if isinstance(error, BrokenPipeError):  # `lunargr inspect file | head`
            os._exit(141)
        if isinstance(error, Exception) and (line := _in_one_line(error)):
            say_error(line)
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            # Not sys.exit: after a full disk HDF5 would try, and fail, to flush its files once more while Python ends.
            os._exit(EXIT_CODE)
        raise
    finally:
        gc.freeze()


def _in_one_line(error: Exception) -> str | None:
    """What to say of an error, also of a library's where a disk is full or an input was lost; None where it is a bug."""
    from schemas.files.outputs import is_full_disk
    from schemas.provenance import changed_inputs

    if isinstance(error, LunargrError):
        return str(error)
    if is_full_disk(error):  # where numba keeps its compiled loops, for one
        where = getattr(error, "filename", None) or "a file"
        return f"{where}: the disk is full or over quota; free some space and run the command again."
    if not (lost := changed_inputs()):
        return None
    return (
        f"{lost[0]}: gone, or changed, while it was being read ({type(error).__name__}: {error}); nothing half-written is left. "
        "Bring it back and run the command again."
    )


if __name__ == "__main__":
    main()
