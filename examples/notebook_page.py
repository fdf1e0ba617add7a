"""Run examples/relight.py cell by cell and write docs/relight.ipynb.

Run in the folder of the files: cd demo-full; python ../examples/notebook_page.py
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
SCRIPT = ROOT / "examples" / "relight.py"
DPI = 90
JPEG = {"quality": 80, "optimize": True}  # maps of noisy ground are five times as large as PNG
KERNEL = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}


@dataclass
class Cell:
    """``printed`` and ``pictures`` (JPEG) are the outputs of running it."""

    kind: str  # 'markdown' | 'code'
    text: str
    printed: str = ""
    pictures: list[bytes] = field(default_factory=list)


def read_cells(script: Path) -> list[Cell]:
    """The cells of a script in the percent format."""
    found = []
    for head, body in re.findall(r"^# %%(.*)\n((?:(?!# %%).*\n?)*)", script.read_text(), re.M):
        markdown = "[markdown]" in head
        text = re.sub(r"^# ?", "", body, flags=re.M) if markdown else body
        found.append(Cell("markdown" if markdown else "code", text.strip()))
    return found


def run(cells: list[Cell]) -> dict[str, Any]:
    """Run the code in one namespace, which is returned, and keep what it prints and draws."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {"__name__": "__notebook__"}
    for cell in cells:
        if cell.kind == "code":
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(cell.text, str(SCRIPT), "exec"), names)
            cell.printed = out.getvalue().rstrip()
            for number in plt.get_fignums():
                picture = io.BytesIO()
                plt.figure(number).savefig(picture, format="jpeg", dpi=DPI, pil_kwargs=JPEG)
                cell.pictures.append(picture.getvalue())
            plt.close("all")
    return names


def notebook(cells: list[Cell]) -> str:
    """The cells as a Jupyter notebook, with their outputs."""
    made = []
    for number, cell in enumerate(cells):
        entry: dict[str, Any] = {"cell_type": cell.kind, "id": f"cell-{number}", "metadata": {}, "source": cell.text}
        if cell.kind == "code":
            outputs: list[dict[str, Any]] = []
            if cell.printed:
                outputs.append({"output_type": "stream", "name": "stdout", "text": f"{cell.printed}\n"})
            for picture in cell.pictures:
                data = {"image/jpeg": base64.b64encode(picture).decode()}
                outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
            entry |= {"execution_count": None, "outputs": outputs}
        made.append(entry)
    whole = {"cells": made, "metadata": KERNEL, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    cells = read_cells(SCRIPT)
    run(cells)
    (ROOT / "docs" / "relight.ipynb").write_text(notebook(cells))
    print(ROOT / "docs" / "relight.ipynb")
