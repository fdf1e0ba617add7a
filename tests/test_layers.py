"""Imports run one way: schemas <- common <- physics <- pairs <- network, effects <- stages <- command line; stages never import each other."""

from __future__ import annotations

import ast
import subprocess
import sys

from conftest import ROOT

LAYERS = [
    "schemas",
    "stages.common",
    "stages.physics",
    "stages.pairs",
    "stages.network|stages.effects",
    "stages",
    "lunargr_cli",
]
STAGES = LAYERS.index("stages")


def _layer(module: str) -> int:
    for level, names in reversed(list(enumerate(LAYERS))):
        for name in names.split("|"):
            if name != "stages" and (module == name or module.startswith(name + ".")):
                return level
    return STAGES if module.split(".")[0] == "stages" else -1


def _imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            if node.module == "stages":
                yield from (f"stages.{alias.name}" for alias in node.names)


def test_imports_run_one_way():
    wrong = []
    for top in ("schemas", "stages", "lunargr_cli"):
        for path in sorted((ROOT / top).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            for imported in _imports(path):
                level = _layer(imported)
                if level < 0 or imported == "stages":
                    continue
                upward = level > _layer(module)
                stage_to_stage = level == _layer(module) == STAGES and imported.split(".")[:2] != module.split(".")[:2]
                if upward or stage_to_stage:
                    wrong.append(f"{module} imports {imported}")
    assert not wrong, wrong


def test_help_needs_no_heavy_import():
    code = "import sys; import lunargr_cli.main; print(sorted({'torch','cv2','h5py','numba','rasterio','matplotlib'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"
