"""`lunargr match FILES`: do features of the renderings lie where those of the measured images lie?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.console import Console
from lunargr_cli.options import MOST, Device, Json, Overwrite, Quiet, Seed, check_once, configure, make_output
from schemas.errors import ConfigError
from stages import match
from stages.match import Config

NAME, ORDER = "match", 71


def command(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILES",
            help="PAIRS CHECKPOINT; or an EVALUATION with renderings; or a measured image and rendered ones.",
        ),
    ] = None,
    matchers: Annotated[
        list[str] | None,
        typer.Option(
            "--matcher",
            help=f"A matcher of --list. May be repeated (default: {' and '.join(Config.matchers)}).",
        ),
    ] = None,
    split: Annotated[str, typer.Option("--split", help="train, validation or test (for pairs).")] = Config.split,
    count: Annotated[
        int, typer.Option("--count", min=1, max=MOST, help="Crops to match, drawn at random.")
    ] = Config.count,
    features_model: Annotated[
        Path | None, typer.Option("--features-model", metavar="ONNX", help="Network of aliked or disk.")
    ] = None,
    lightglue_model: Annotated[
        Path | None, typer.Option("--lightglue-model", metavar="ONNX", help="LightGlue's network for these features.")
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option("--figures", metavar="DIR", help="Write match pictures, coloured by error, as PNG."),
    ] = None,
    list_matchers: Annotated[bool, typer.Option("--list", help="Explain every matcher and stop.")] = False,
    seed: Seed = Config.seed,
    device: Device = Config.device,
    json_file: Json = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Match measured with rendered images at 512 x 384 and count the matches within 1, 3 and 5 px of the truth.

    Measured and rendered images show the same ground, pixel for pixel: a correct match has the same position in both.
    The learned reflectance stands beside Hapke matched to each crop's range, as in the Lunar-G2R paper.
    """
    console = Console(quiet)
    if list_matchers:
        _list_matchers(console)
        return
    if not files:
        raise ConfigError("match: expected files to match, found none; give pairs.h5 and checkpoint.h5, or --list.")
    config = configure(Config, locals(), matchers=check_once("--matcher", matchers or Config.matchers))
    to = make_output(locals())
    result = match.run(files, to, config, console.say, console.progress)
    from stages.match.stage import result_lines

    extent = f"{result['crops']} picture(s) of 512 x 384 on {result['tiles']} ground tile(s)"
    console.table(f"matching consistency over {extent}", *result_lines(result))
    if figures is not None:
        console.say(f"written: {figures}/")


def _list_matchers(console: Console) -> None:
    from stages.match.base import matchers

    rows = [(m.name, m.title, "--features-model" if m.needs_models else "-", m.reference) for m in matchers()]
    console.table("matchers", ("name", "what", "needs", "reference"), rows)
