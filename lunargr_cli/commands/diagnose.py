"""`lunargr diagnose PAIRS [CHECKPOINT]`: what the simulation gets wrong, why, and what fixing it is worth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console, write_out
from lunargr_cli.options import (
    MOST,
    Json,
    Overwrite,
    Quiet,
    Scheduler,
    Seed,
    complete_model,
    configure,
    make_output,
    read_names,
)
from schemas.errors import ConfigError
from stages import diagnose
from stages.diagnose import Config

NAME, ORDER = "diagnose", 80


def command(
    pairs: Annotated[Path | None, typer.Argument(help="Pairs from 'lunargr project'.")] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Argument(help="Checkpoint from 'lunargr train' to simulate with; without it --model is fitted."),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            autocompletion=complete_model,
            help="Reflectance model to fit without a checkpoint, with the departures of measured lunar laws.",
        ),
    ] = Config.model,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="diagnosis.h5: the effects, for --extend of train, render and evaluate."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="FILE", help="One HTML file with pictures and evidence."),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            "--free",
            metavar="NAME,...",
            help="Coefficients of --model to fit, separated by commas (default: all); the others keep published values.",
        ),
    ] = None,
    law_known: Annotated[
        bool, typer.Option("--law-known", help="The ground follows --model: fit its coefficients alone.")
    ] = Config.law_known,
    list_effects: Annotated[bool, typer.Option("--list", help="Explain every effect and stop.")] = False,
    most_causes: Annotated[
        int, typer.Option("--causes", min=1, max=100, help="Maximum number of causes to name.")
    ] = Config.most_causes,
    most_pairs: Annotated[
        int,
        typer.Option(
            "--pairs", min=1, max=MOST, help="Maximum number of pairs of 128 px to search; fewer if they are larger."
        ),
    ] = Config.most_pairs,
    seed: Seed = Config.seed,
    json_file: Json = None,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Name the physical causes of the difference between measured and simulated images."""
    console = Console(quiet)
    if list_effects:
        _list_effects()
        return
    if pairs is None:
        raise ConfigError("diagnose: expected a file of pairs, found none; give pairs.h5, or --list.")
    config, to = configure(Config, locals(), free=read_names("--free", free)), make_output(locals())
    answer = diagnose.run(pairs, checkpoint, to, config, console.say, console.progress).report
    from stages.diagnose.result.answer import describe

    rows = [
        (
            c["effect"],
            describe(c["parameters"]),
            _percent(c["held_out_gain_percent"], c["held_out_low"], c["held_out_high"]),
            ", ".join(g for g in c["group"] if g != c["effect"]) or "-",
        )
        for c in answer["causes"]
    ]
    if quiet:
        return
    if rows:
        console.table("causes", ("effect", "parameters", "gain on held-out ground", "equally good"), rows)
    if answer["budget"]:
        shares = ", ".join(f"{name.replace('_', ' ')} {100 * share:.0f} %" for name, share in answer["budget"].items())
        write_out(f"Variance of the residual: {shares}.")
    for c in answer["ordinary"]:
        write_out(f"{c['effect']} is of a size that any data have: {describe(c['parameters'])}.")
    for r in answer["rejected"]:
        write_out(f"{r['effect']} is not named: {r['why']}.")
    write_out(f"{answer['verdict']}: {answer['sentence']}")
    if answer["blind"] and answer["verdict"] != "cannot_tell":
        write_out(f"Whether any of these is there, the data cannot tell: {', '.join(answer['blind'])}.")


def _percent(value: float | None, low: float | None, high: float | None) -> str:
    return "-" if value is None or low is None or high is None else f"{value:.2g} % ({low:.2g} .. {high:.2g})"


def _list_effects() -> None:
    from stages.effects import effect_names, get_effect

    for name in effect_names():
        effect = get_effect(name)
        write_out(f"{name} ({effect.slot}, per {effect.scope}): {effect.title}")
        write_out(f"  {effect.mechanism}")
        for p in effect.parameters:
            unit = "" if p.unit == "1" else f" {p.unit}"
            write_out(f"  {p.name}: {p.description}; {p.lower:g} .. {p.upper:g}{unit}, null {p.default:g}")
        units = {p.name: "" if p.unit == "1" else f" {p.unit}" for p in (*effect.fitted(), *effect.parameters)}
        if effect.tolerance:
            ordinary = ", ".join(f"{k} up to {v:.2g}{units.get(k, '')}" for k, v in effect.tolerance.items())
            write_out(f"  any data may have, and gets no name: {ordinary}")
        write_out(f"  reference: {effect.reference}")
        write_out(f"  confused with: {', '.join(effect.confused_with) or '-'}; told apart by {effect.separate}\n")
