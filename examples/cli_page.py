"""Write docs/cli.md: every command with its options, as `--help` tells them. Run: python examples/cli_page.py"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import typer

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from lunargr_cli.main import app  # noqa: E402


def cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def default_of(option: Any) -> str:
    value = option.default
    if option.required or value is None or callable(value) or value == () or str(value).startswith("Sentinel"):
        return "required" if option.required else ""
    return f"`{value}`" if not isinstance(value, bool) else ("on" if value else "off")


def section(name: str, command: Any) -> list[str]:
    context = command.context_class(command, info_name=f"lunargr {name}")
    text = (command.help or "").replace("\b", "").strip()
    first, _, rest = text.partition("\n\n")
    lines = [f"## {name}", "", " ".join(first.split()), ""]
    for paragraph in rest.strip("\n").split("\n\n"):
        shown = paragraph.strip()
        example = shown.startswith("lunargr ")
        lines += ["```", *(line.rstrip() for line in shown.splitlines()), "```", ""] if example else [shown, ""]
    lines += [f"    {' '.join(command.get_usage(context).split()).removeprefix('Usage: ')}", ""]
    lines += ["| | default | |", "|---|---|---|"]
    for parameter in command.get_params(context):
        if parameter.name == "help":
            continue
        names = ", ".join(f"`{o}`" for o in [*parameter.opts, *parameter.secondary_opts])
        if parameter.param_type_name == "argument":
            names = f"`{(parameter.metavar or parameter.name or '').upper()}`"
        lines.append(f"| {names} | {default_of(parameter)} | {cell(getattr(parameter, 'help', '') or '')} |")
    return [*lines, ""]


def page() -> str:
    group: Any = typer.main.get_command(app)
    lines = [
        "# Commands",
        "",
        "Written by `examples/cli_page.py` from the program itself. All options: `lunargr COMMAND --help`.",
        "",
        "| every command | |",
        "|---|---|",
        *(f"| {', '.join(f'`{o}`' for o in p.opts)} | {cell(getattr(p, 'help', '') or '')} |" for p in group.params),
        "",
    ]
    for name, command in group.commands.items():
        lines += section(name, command)
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    (ROOT / "docs" / "cli.md").write_text(page())
    print(ROOT / "docs" / "cli.md")
