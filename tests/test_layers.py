"""Imports run one way: schemas <- common <- physics <- pairs <- network, effects, merge, photographs <- stages <- pipelines <- command line; stages never
import each other."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys

import pytest
from conftest import ROOT

LAYERS = [
    "schemas",
    "stages.common",
    "stages.physics",
    "stages.pairs",
    "stages.network|stages.effects|stages.merge|stages.photographs",
    "stages",
    "stages.pipelines",
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


def test_models_are_listed_without_torch_which_still_comes_when_it_is_asked_for():
    code = """import sys
from lunargr_cli.commands import models
models.command(name="hapke")
print("torch._C" in sys.modules)
from stages.physics.photometry import evaluate
print(evaluate("lambert", {"albedo": 1.0}, 0.0, 0.0, 0.0), "torch._C" in sys.modules)"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert out[0].startswith("hapke: ") and out[-2:] == ["False", "1.0 True"]


def test_images_are_projected_without_torch():
    """Whose import would take longer than the rest of a small run: registration alone renders."""
    code = "import stages.project.stage, sys; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


CORE = sorted(path for top in ("stages", "schemas") for path in (ROOT / top).rglob("*.py"))


def test_the_core_does_not_speak_of_command_line_options():
    """Stages name settings as their fields; the command line alone knows how they are spelled."""
    wrong = []
    for path in CORE:
        if path.name == "command_line.py":  # which takes recorded command lines apart
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found = re.search(r"(?<![\w-])--[a-z][\w-]*", node.value)
                wrong += [f"{path.relative_to(ROOT)}:{node.lineno}: {found[0]}"] if found else []
    assert not wrong, wrong


LONGEST, MOST_PARAMETERS = 80, 8
LOOPS = {"stages/train/stage.py run"}  # the training loop reads best in one piece
# What hands a kernel its arrays one by one
HANDING = ("stages/physics/horizon/",)


def _parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return len(arguments) - (bool(arguments) and arguments[0].arg in ("self", "cls"))


def _is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(
        "jit" in ast.dump(decorator) or "intrinsic" in ast.dump(decorator) for decorator in function.decorator_list
    )


def test_functions_are_short_and_take_few_parameters():
    """But numba kernels, which take arrays one by one, and commands, whose parameters are their options."""
    wrong = []
    for path in [*CORE, *sorted((ROOT / "lunargr_cli").rglob("*.py"))]:
        place = str(path.relative_to(ROOT))
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or _is_kernel(node):
                continue
            command = node.name == "command" and "commands/" in place
            # of a command only what it does counts, not the list of its options
            first = node.body[0].lineno if command else node.lineno
            if node.end_lineno - first >= LONGEST and f"{place} {node.name}" not in LOOPS:
                wrong.append(f"{place}: {node.name} has {node.end_lineno - first + 1} lines")
            if _parameters(node) > MOST_PARAMETERS and not command:
                wrong.append(f"{place}: {node.name} has {_parameters(node)} parameters")
    assert not [line for line in wrong if not line.startswith(HANDING)], wrong


STAGES_RUN = (
    "simulate", "ingest", "sample", "project", "train", "infer", "albedo", "normalize", "render", "view", "export", "evaluate", "match",
    "diagnose", "report", "merge", "convert", "pipelines.compare_models", "pipelines.infer_terrain",
)  # fmt: skip


@pytest.mark.parametrize("name", STAGES_RUN)
def test_every_stage_is_run_alike(name):
    """run(inputs ..., output, config, say, progress); say and progress may be left away, also by stages that use neither."""
    from stages.common.progress import say_nothing, show_nothing

    parameters = inspect.signature(importlib.import_module(f"stages.{name}").run).parameters
    told = [name for name in ("say", "progress") if name in parameters]
    assert list(parameters)[-2 - len(told) :] == ["output", "config", *told]
    assert parameters["output"].annotation in ("Output | Path", "Output | Path | None")
    defaults = {"say": say_nothing, "progress": show_nothing}
    assert all(parameters[name].default is defaults[name] for name in told)
    assert all(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters.values())


def test_shared_types_are_defined_once():
    """One name for arrays of float64, for progress and for messages, in stages/common."""
    shared = re.compile(r"^(\w+) = (NDArray\[np\.float(64|32)\]|Callable\[\[(int, int, )?str\], None\])(  #.*)?$", re.M)
    found = [m[1] for path in CORE for m in shared.finditer(path.read_text())]
    assert len(found) == len(set(found)) and {"Floats", "Floats32", "Progress", "Say"} <= set(found), found
