"""Write docs/files.md: every file of the project with the first line of what it says of itself."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {
    "lunargr_cli": "The command line: thin, no physics",
    "lunargr_cli/commands": "One thin file per command",
    "lunargr_cli/fanout": "One stage's shards over processes and nodes",
    "schemas": "What artefacts hold, and how they are written and opened",
    "stages": "One module (or package) per stage of the pipeline, in the order of the data",
    "stages/physics": "Grids, bodies, geometry, light, views, registration: everything that stages share",
    "stages/physics/photometry": "Reflectance models, one file each",
    "stages/physics/cameras": "Camera models, one file each",
    "stages/network": "The U-Net and what training and inference share",
    "stages/effects": "Candidate causes of a residual, one file each",
    "stages/simulate": "simulate",
    "stages/ingest": "ingest",
    "stages/render": "render",
    "stages/infer": "infer",
    "stages/evaluate": "evaluate",
    "stages/match": "match; one file per matcher",
    "stages/diagnose": "diagnose",
    "stages/report": "report",
    "examples": "Scripts to run and to learn from",
    "examples/cluster": "Scripts for Slurm and Dask",
    "docs": "Pages",
    "tests": "Tests, by layer",
    "tests/hidden": "The independent generator of data with something hidden in them",
    "tests/benchmarks": "Speed and memory, each beside a named peer in the same run",
}


def first_line(path: Path) -> str:
    """What a file says of itself in one line."""
    text = path.read_text(encoding="utf-8", errors="replace")
    if path.suffix == ".py":
        return (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
    for line in text.splitlines():
        words = line.strip().lstrip("#!").strip()
        if words and not words.startswith(("/usr", "/bin")):
            return words
    return ""


def page() -> str:
    """The whole page."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    missing = {str(Path(f).parent) for f in listed if f.endswith(".py")} - FOLDERS.keys()
    if missing:
        raise SystemExit(f"{Path(__file__).name}: say in FOLDERS what these are: {', '.join(sorted(missing))}")
    out = ["# Every file", "", "Written by `make docs` from the first line of each file.", ""]
    for folder, what in FOLDERS.items():
        rows = [
            f for f in listed if str(Path(f).parent) == folder and Path(f).suffix in (".py", ".md", ".sh", ".pipeline")
        ]
        if rows:
            out += [f"## `{folder}/`", "", f"{what}.", "", "| file | what |", "|---|---|"]
            out += [
                f"| `{Path(f).name}` | {first_line(ROOT / f).replace('|', '/')} |" for f in rows if f != "docs/files.md"
            ]
            out.append("")
    return "\n".join(out)


if __name__ == "__main__":
    (ROOT / "docs" / "files.md").write_text(page())
