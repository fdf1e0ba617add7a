"""`make mutants`: plant bugs in the program, one at a time, and see whether the tests notice.

    python tests/mutants.py [--only WORD] [--list]

Each bug replaces one piece of text in one file and names the tests that should fail then. The tree is copied to a
temporary folder for it. Ends with exit code 1 where fewer than 90 % are caught, or where a bug's text is not found any
more: the list must follow the code.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mutant_list import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parent.parent
ENOUGH = 0.9
TIMEOUT = 600  # seconds: a bug that hangs is a bug that is noticed


def plant(mutant: Mutant, tree: Path) -> None:
    """Put the bug into a copy of the tree. Raises ValueError where its text does not stand exactly once."""
    path = tree / mutant.file
    text = path.read_text() if path.exists() else ""
    if text.count(mutant.before) != 1:
        raise ValueError(f"{mutant.file}: the text stands {text.count(mutant.before)} times, expected once")
    path.write_text(text.replace(mutant.before, mutant.after))


def caught(mutant: Mutant, folder: Path) -> bool:
    """Whether the named tests fail with the bug."""
    tree = folder / "tree"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".venv", ".git", "demo", "results", "__pycache__"))
    plant(mutant, tree)
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "LUNARGR_SHARED": str(_shared()),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *mutant.tests]
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return True
    if done.returncode not in (0, 1):
        raise ValueError(f"pytest ended with {done.returncode}: {done.stdout[-500:]}{done.stderr[-500:]}")
    return done.returncode == 1


def _shared() -> Path:
    return Path(os.environ.get("LUNARGR_SHARED", ROOT.parent / "shared"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="bugs whose file or description holds this word")
    parser.add_argument("--list", action="store_true", help="print the bugs and check that their texts are there")
    options = parser.parse_args()
    chosen = [m for m in MUTANTS if options.only in m.file or options.only in m.bug]
    noticed, broken = 0, 0
    for number, mutant in enumerate(chosen, 1):
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as name:
            try:
                if options.list:
                    shutil.copytree(ROOT / mutant.file.split("/")[0], Path(name) / mutant.file.split("/")[0])
                    plant(mutant, Path(name))
                    outcome = "ready"
                else:
                    outcome = "caught" if caught(mutant, Path(name)) else "NOT CAUGHT"
            except ValueError as error:
                outcome, broken = f"BROKEN: {error}", broken + 1
        noticed += outcome == "caught"
        print(
            f"{number:3d}/{len(chosen)} {outcome:10s} {mutant.file}: {mutant.bug} ({time.monotonic() - started:.0f} s)",
            flush=True,
        )
    if options.list:
        return 1 if broken else 0
    share = noticed / max(len(chosen), 1)
    print(
        f"{noticed} of {len(chosen)} planted bugs caught ({100 * share:.0f} %, at least {100 * ENOUGH:.0f} % expected)"
    )
    return 0 if share >= ENOUGH and not broken else 1


if __name__ == "__main__":
    sys.exit(main())
