"""The counts of tests/validation/frozen_set.py, on answers written here."""

from __future__ import annotations

import frozen_set


def _case(planted=None, causes=(), **other):
    """A case of own scenes; causes : (effect, value of x, its error)."""
    named = [
        {"effect": effect, "values": {"x": [value, error]}, "gain": [1.0, 0.5, 1.5]} for effect, value, error in causes
    ]
    usual = {
        "source": "own",
        "fault": None,
        "fid": 0.2,
        "beside": None,
        "verdict": "named" if causes else "cannot_tell",
    }
    return {
        **usual,
        "planted": planted or {},
        "causes": named,
        "refused": {},
        "blind": [],
        "structure": {},
        "seconds": 2.0,
    } | other


CASES = {
    "right": _case({"echo": {"x": 1.0}}, [("echo", 1.2, 0.1)]),
    "value off": _case({"echo": {"x": 1.0}}, [("echo", 1.4, 0.1)]),
    "another": _case({"echo": {"x": 1.0}}, [("psf_blur", 1.0, 0.1), ("echo", 1.0, 0.1)]),
    "refused": _case({"echo": {"x": 1.0}}, refused={"echo": "ordinary"}, blind=["echo"]),
    "blind": _case({"echo": {"x": 1.0}}, blind=["echo"]),
    "nothing": _case({"echo": {"x": 1.0}}),
    "null": _case(),
    "false name": _case(causes=[("dem_scale", 1.0, 0.1)], structure={"lines": 0.1}),
    "fault": _case(fault="banding", structure={"lines": 0.1}),
    "whole": _case(causes=[("dem_scale", 1.0, 0.1)], beside="whole"),
    "again": _case(causes=[("dem_scale", 1.0, 0.1)], beside="whole"),
    "usual beside plant": _case({"echo": {"x": 1.0}}, [("dem_scale", 1.0, 0.1), ("echo", 1.0, 0.1)], beside="whole"),
}


def test_what_became_of_each_case_is_counted() -> None:
    """Names that a whole stack of photographs has too are neither false nor first."""
    wanted = {
        "right": {"planted", "first", "values", "in 3 errors"},
        "value off": {"planted", "first", "values"},
        "another": {"planted", "another"},
        "refused": {"planted", "refused"},
        "blind": {"planted", "blind"},
        "nothing": {"planted", "nothing"},
        "null": {"null"},
        "false name": {"null", "null: named", "null: words"},
        "fault": {"fault", "fault: words"},
        "whole": set(),
        "again": {"null"},
        "usual beside plant": {"planted", "first", "values", "in 3 errors"},
    }
    for name in CASES:
        counted = frozen_set.judge(name, CASES)
        assert {column for column, count in counted.items() if count and column != "seconds"} == wanted[name], name


def test_a_change_is_told_with_the_counts_of_both_versions(capsys) -> None:
    after = {**CASES, "right": CASES["blind"], "value off": _case({"echo": {"x": 1.0}}, [("echo", 1.45, 0.1)])}
    frozen_set.compare(CASES, after)
    told = capsys.readouterr().out
    assert [line.split(":")[0] for line in told.splitlines() if not line.startswith((" ", "|"))] == ["right"]
    assert "before: named; echo 1.2 +- 0.1\n  after:  cannot_tell; blind\n" in told
    before, later = (line for line in told.splitlines() if line.startswith("| all |"))
    assert before.startswith("| all | before | 12 | 7 | 3 | 1 | 1 | 1 | 1 | 3 | 2 |")
    assert later.startswith("| all | after | 12 | 7 | 2 | 1 | 1 | 2 | 1 | 2 | 1 |")
