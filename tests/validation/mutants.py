"""`make mutants`: plant bugs in the program, one at a time, and see whether the tests notice.

    python tests/validation/mutants.py [--only WORD] [--list]

Each bug replaces one piece of text in one file and names the tests that should fail then. The tree is copied to a
temporary folder for them. Ends with exit code 1 where fewer than 90 % are caught, or where a bug's text is not found any
more: the list must follow the code.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from mutant import Mutant
from mutant_list import MUTANTS

ROOT = Path(__file__).resolve().parents[2]
ENOUGH = 0.9
TIMEOUT = 600  # seconds: a bug that hangs is a bug that is noticed


@contextlib.contextmanager
def planted(mutant: Mutant, tree: Path) -> Iterator[None]:
    """The bug stands in a copy of the tree. Raises ValueError where its text does not stand exactly once."""
    path = tree / mutant.file
    text = path.read_text() if path.exists() else ""
    if text.count(mutant.before) != 1:
        raise ValueError(f"the text stands {text.count(mutant.before)} times, expected once")
    state = path.stat()
    path.write_text(text.replace(mutant.before, mutant.after))
    try:
        yield
    finally:
        path.write_text(text)
        os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))  # what was compiled of it is still right


def fails(tests: Sequence[str], tree: Path, compiled: Path | None = None) -> bool:
    """Whether tests fail in a tree; compiled : where numba keeps what it compiles, beside the sources where None."""
    environment = os.environ | {"PYTHONPATH": str(tree), "LUNARGR_SHARED": str(_shared())}
    if compiled is not None:
        environment["NUMBA_CACHE_DIR"] = str(compiled)
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return True
    if done.returncode not in (0, 1):
        raise ValueError(f"pytest ended with {done.returncode}: {done.stdout[-500:]}{done.stderr[-500:]}")
    return done.returncode == 1


def caught(mutant: Mutant, tree: Path) -> bool:
    """Whether the named tests fail with the bug."""
    with planted(mutant, tree), tempfile.TemporaryDirectory() as fresh:
        # numba looks at the date of a function's own file only, not of those that it takes others from
        return fails(mutant.tests, tree, Path(fresh) if "njit" in (tree / mutant.file).read_text() else None)


def _shared() -> Path:
    return Path(os.environ.get("LUNARGR_SHARED", ROOT.parent / "shared"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="bugs whose file or description holds this word")
    parser.add_argument("--list", action="store_true", help="print the bugs and check that their texts are there")
    options = parser.parse_args()
    chosen = [m for m in MUTANTS if options.only in m.file or options.only in m.bug]
    if not chosen:
        parser.error(f"--only: no bug holds '{options.only}' in its file or description")
    noticed, broken = 0, 0
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".venv", ".git", "demo", "results"))
        if not options.list and fails(sorted({test for mutant in chosen for test in mutant.tests}), tree):
            print("the named tests fail, or take too long, without any bug: mend them first")
            return 1
        for number, mutant in enumerate(chosen, 1):
            started = time.monotonic()
            try:
                if options.list:
                    with planted(mutant, tree):
                        outcome = "ready"
                else:
                    outcome = "caught" if caught(mutant, tree) else "NOT CAUGHT"
            except ValueError as error:
                outcome, broken = f"BROKEN: {error}", broken + 1
            noticed += outcome == "caught"
            print(
                f"{number:3d}/{len(chosen)} {outcome:10s} {mutant.file}: {mutant.bug} ({time.monotonic() - started:.0f} s)",
                flush=True,
            )
    if options.list:
        return 1 if broken else 0
    share = noticed / len(chosen)
    print(
        f"{noticed} of {len(chosen)} planted bugs caught ({100 * share:.0f} %, at least {100 * ENOUGH:.0f} % expected)"
    )
    return 0 if share >= ENOUGH and not broken else 1


if __name__ == "__main__":
    sys.exit(main())
