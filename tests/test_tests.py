"""The tests themselves: each can fail."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from sure_names import doubtful

TESTS = Path(__file__).parent
# They run examples that hold their own assertions.
ELSEWHERE = {"test_docs.py::test_python_examples_run"}


def _calls(tree: ast.AST) -> set[str]:
    """Last names of what is called: 'raises' for pytest.raises."""
    return {ast.unparse(n.func).rpartition(".")[2] for n in ast.walk(tree) if isinstance(n, ast.Call)}


def asserting_nothing(code: str) -> list[str]:
    """Names of the tests that neither assert, nor expect an exception, nor call what does, in the same file."""
    tree = ast.parse(code)
    functions = {n.name: n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}

    def checks(node: ast.AST) -> bool:
        called = _calls(node)
        return (
            any(isinstance(n, ast.Assert) for n in ast.walk(node))
            or bool(called & {"raises", "fail", "warns"})
            or any("assert" in name for name in called)
        )

    known = {name for name, node in functions.items() if checks(node)}
    return [
        name
        for name, node in functions.items()
        if name.startswith("test_") and name not in known and not _calls(node) & known
    ]


@pytest.mark.parametrize("path", sorted(TESTS.glob("test_*.py")), ids=lambda path: path.name)
def test_every_test_asserts_something(path):
    found = {f"{path.name}::{name}" for name in asserting_nothing(path.read_text())}
    assert not found - ELSEWHERE


def test_a_test_without_assertions_is_found():
    code = "def helper():\n assert 1\ndef test_a():\n helper()\ndef test_b():\n print(1)\ndef test_c():\n assert 1\n"
    assert asserting_nothing(code) == ["test_b"]


def test_tests_that_ask_for_reference_data_are_marked(request):
    asking = [item for item in request.session.items if "shared" in item.fixturenames]
    assert all(item.get_closest_marker("shared") for item in asking)


@pytest.mark.usefixtures("shared")
def test_this_one_asks_for_reference_data(request):
    assert request.node.get_closest_marker("shared")


def test_names_that_may_be_no_gain_are_counted():
    """One cause in doubt makes an answer doubtful; test pairs count where their upper bound is below zero, and not where there were none."""

    def answer(lows, high):
        return {"causes": [{"held_out_low": low} for low in lows], "held_out": {"gain_percent_high": high}}

    unsure, losing = doubtful([answer([0.2], 1.0), answer([0.2, None], -0.3), answer([0.1], None), answer([], None)])
    assert "1 of 3" in unsure and "1 of 3 (up to 0.3 %)" in losing
