"""Every command that writes says what usually follows it, in words that the named command takes."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from test_outputs_replace_nothing import READS
from typer.main import get_command

from lunargr_cli.main import app
from lunargr_cli.next_step import next_step

COMMANDS = get_command(app).commands
WRITING = sorted(set(READS) - {"simulate", "inspect", "models"})  # simulate knows more; the others answer a question


def options_of(name: str, words: list[str]) -> dict:
    command = COMMANDS[name]
    given = command.make_context(name, list(words)).params
    # click gives texts where the command gets paths
    return {key: Path(value) if isinstance(value, str) and key in PATHS else value for key, value in given.items()}


PATHS = ("output", "json_file", "pairs", "report")


@pytest.mark.parametrize("name", WRITING)
def test_what_follows_a_command_is_a_command_that_there_is(name):
    words = READS[name][1]
    output = [] if name in ("match", "diagnose") else ["-o", "runs/a b/out.h5"]
    step = next_step(name, options_of(name, [*words, *output]))
    assert step
    if step.startswith("lunargr "):
        following, *arguments = shlex.split(step.partition(";")[0].partition(", with")[0])[1:]
        COMMANDS[following].make_context(following, list(arguments))
        assert "runs/a b/" in " ".join(arguments)


@pytest.mark.parametrize("name", WRITING)
def test_a_file_name_with_a_dash_in_front_is_no_option(name):
    step = next_step(
        name,
        options_of(name, [*READS[name][1], "-o", "-o.h5"] if name not in ("match", "diagnose") else READS[name][1]),
    )
    assert " -o." not in step


def test_a_part_is_merged_next_and_a_list_is_followed_by_nothing():
    assert next_step("sample", options_of("sample", ["scene.h5", "--shard", "1/4", "-o", "part1.h5"])).startswith(
        "lunargr merge"
    )
    assert next_step("diagnose", options_of("diagnose", ["--list"])) is None
    assert next_step("inspect", {}) is None
