"""Public functions on arrays say what shapes they take and give."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = (
    "schemas", "stages/common", "stages/physics", "stages/pairs", "stages/network", "stages/effects",
    "stages/simulate", "stages/ingest", "stages/sample", "stages/project", "stages/train", "stages/infer",
    "stages/render", "stages/export", "stages/merge",
)  # fmt: skip
ARRAYS = re.compile(r"\b(ndarray|NDArray|Tensor|ArrayLike|Floats|Floats32|Mask|Array)\b")
# one axis: ..., a number, a letter or two, or a plain word for it; with what is added to it or multiplied by it
AXIS = r"(?:\.\.\.|\d+|[A-Za-z]\w?|rows|columns|lines|samples|height|width|count|states|strips)(?: ?[-+/*]? ?\w+)?"
SHAPE = re.compile(rf"\(\)|\({AXIS},\)|\({AXIS}(?:, {AXIS})+\)")
NO_SHAPE = re.compile(r"broadcast|same shape|any shape|elementwise|element by element", re.IGNORECASE)


def _functions(path: Path):
    """Public functions and methods of a module, with where they stand."""
    tree = ast.parse(path.read_text())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from ((f"{node.name}.{n.name}", n) for n in node.body if isinstance(n, ast.FunctionDef))


def _takes_arrays(function: ast.FunctionDef) -> bool:
    arguments = [*function.args.args, *function.args.kwonlyargs]
    return any(a.annotation is not None and ARRAYS.search(ast.unparse(a.annotation)) for a in arguments)


def _of_a_kernel(function: ast.FunctionDef) -> bool:
    return any("jit" in ast.unparse(d) for d in function.decorator_list)


def missing_shapes(path: Path) -> list[str]:
    """The public functions of a file that take an array and name no shape."""
    found = []
    for name, function in _functions(path):
        text = ast.get_docstring(function)
        if function.name.startswith("_") or _of_a_kernel(function) or not _takes_arrays(function) or text is None:
            continue
        if not (SHAPE.search(text) or NO_SHAPE.search(text)):
            found.append(f"{path.relative_to(ROOT)}:{function.lineno} {name}")
    return found


def test_a_function_without_a_shape_is_found(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    told = '"""Sum over (H, W) pixels (of a crop)."""'
    vague = '"""Sum over the pixels (mostly), see (Otto et al. 2014)."""'
    text = "".join(f"def {n}(x: Tensor) -> Tensor:\n    {d}\n" for n, d in (("told", told), ("vague", vague)))
    (tmp_path / "module.py").write_text(text)
    assert missing_shapes(tmp_path / "module.py") == ["module.py:3 vague"]


@pytest.mark.parametrize("package", PACKAGES)
def test_functions_on_arrays_name_their_shapes(package):
    assert not [line for path in sorted((ROOT / package).rglob("*.py")) for line in missing_shapes(path)]
