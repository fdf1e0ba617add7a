"""Write docs/cli.md: every command with its options, from the texts of `--help`. Run: python examples/cli_page.py"""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import typer

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from lunargr_cli.main import app  # noqa: E402

HEAD = """# Commands

`python examples/cli_page.py` writes this page. `lunargr COMMAND --help` explains every option in full. Commands that write
files also take `--overwrite` and `--quiet`.
"""
EVERYWHERE = ("--overwrite", "--quiet")  # of all commands that write: not repeated
SHARED_FROM = 3  # commands with the same option: then it is explained once, on top


def cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


STATED = re.compile(r"\s*\[default: (.*?)\]")  # in the text itself, where the default hangs on a recipe


def default_of(option: Any) -> str:
    value = option.default
    if stated := STATED.search(getattr(option, "help", "") or ""):
        return f"`{stated[1]}`"
    if option.required or value is None or callable(value) or value in ((), "") or str(value).startswith("Sentinel"):
        return "required" if option.required and option.param_type_name == "option" else ""
    return f"`{value}`" if not isinstance(value, bool) else ("on" if value else "")


def first_sentence(option: Any) -> str:
    text = STATED.sub("", cell(getattr(option, "help", "") or ""))
    return re.split(r"(?<=[\w)'])\. (?=[A-Z])", text)[0].removesuffix(".")


def spelled(option: Any) -> str:
    """'`--view` ortho/pinhole': the names of an option, and what its value may be."""
    if option.param_type_name == "argument":
        return f"`{(option.metavar or option.name or '').upper()}`"
    names = ", ".join(f"`{o}`" for o in [*option.opts, *option.secondary_opts])
    choices = re.sub(r"^\[(.*)\]$", r"\1", option.metavar or "").split("|")
    return f"{names} {'/'.join(choices)}" if option.metavar else names


def key_of(option: Any) -> tuple[str, str]:
    return option.opts[0], first_sentence(option)


def options_of(name: str, command: Any) -> list[Any]:
    context = command.context_class(command, info_name=f"lunargr {name}")
    return [p for p in command.get_params(context) if p.name != "help"]


def section(name: str, command: Any, shared: set[tuple[str, str]]) -> list[str]:
    """A command: what it does, its own options, and the default name of its output."""
    first = (command.help or "").replace("\b", "").strip().partition("\n\n")[0]
    lines = [f"## {name}", "", " ".join(first.split()), ""]
    every = [p for p in options_of(name, command) if p.opts[0] not in EVERYWHERE]
    own = [p for p in every if key_of(p) not in shared]
    if own:
        lines += ["|option|default||", "|---|---|---|"]
        lines += [f"|{spelled(p)}|{default_of(p)}|{first_sentence(p)}|" for p in own]
        lines += [""]
    output = next((default_of(p) for p in every if p.opts[0] == "--output" and key_of(p) in shared), "")
    return [*lines, *([f"Writes {output}.", ""] if output.startswith("`") else [])]


def page() -> str:
    group: Any = typer.main.get_command(app)
    every = {name: options_of(name, command) for name, command in group.commands.items()}
    count = Counter(key_of(p) for options in every.values() for p in options if p.param_type_name == "option")
    shared = {key for key, number in count.items() if number >= SHARED_FROM}
    first = {key_of(p): p for options in reversed(every.values()) for p in options}
    lines = [HEAD, "|option of every command||", "|---|---|"]
    lines += [f"|{spelled(p)}|{first_sentence(p)}|" for p in group.params if "completion" not in p.opts[0]]
    lines += ["", "|option of many commands||commands|", "|---|---|---|"]
    for key in (key for key in count if key in shared and key[0] not in EVERYWHERE):
        users = [name for name, options in every.items() if any(key_of(p) == key for p in options)]
        lines.append(f"|{spelled(first[key])}|{key[1]}|{', '.join(users) if key[0] != '--output' else 'most'}|")
    lines += [""]
    for name, command in group.commands.items():
        lines += section(name, command, shared)
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    (ROOT / "docs" / "cli.md").write_text(page())
    print(ROOT / "docs" / "cli.md")
