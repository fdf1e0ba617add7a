"""`lunargr evaluate PAIRS CHECKPOINT`: how well the learned reflectance predicts images it has not seen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from stages import evaluate
from stages.evaluate import Config

NAME, ORDER = "evaluate", 70


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project'.")],
    checkpoints: Annotated[
        list[Path],
        typer.Argument(
            metavar="CHECKPOINT...",
            help="Training runs of one model, from 'lunargr train'.",
        ),
    ],
    output: options.OutputFile = Path("evaluation.h5"),
    split: Annotated[str, typer.Option("--split", help="train, validation or test.")] = Config.split,
    extend: Annotated[
        Path | None,
        typer.Option("--extend", metavar="FILE", help="diagnosis.h5: also score the model with its effects."),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option("--figures", metavar="DIR", help="Write training curves and example crops as PNG."),
    ] = None,
    fit_pairs: Annotated[
        int,
        typer.Option(
            "--fit-pairs",
            min=0,
            max=options.MOST,
            help="Maximum number of training pairs for fitting baselines (0: all).",
        ),
    ] = Config.fit_pairs,
    renderings: Annotated[
        bool | None,
        typer.Option(
            "--renderings/--no-renderings", help="Keep every rendered crop in the output (default: below 512 MiB)."
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="ROW", help="Score only this row of the table. May be repeated."),
    ] = None,
    published: Annotated[
        str | None,
        typer.Option(
            "--published", metavar="SET", help="Hapke's parameters to score (default: Sato's nearest in wavelength)."
        ),
    ] = Config.published,
    batch: Annotated[
        int, typer.Option("--batch", min=1, max=options.MOST, help="Crops in memory at a time.")
    ] = Config.batch,
    seed: options.Seed = Config.seed,
    device: options.Device = Config.device,
    json_file: options.Json = None,
    scheduler: options.Scheduler = None,
    resume: options.ResumeParts = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Score the learned model and its baselines on one split: MSE, PSNR, SSIM, LPIPS, with 95 % intervals.

    A JSON file beside the output holds the same results. For images in DN every model gets a gain and an offset per
    image, fitted on the training split; errors are then shares of the full DN range. With checkpoints from several
    seeds the learned rows are means over training runs, and the intervals include the spread of the runs.
    """
    config = options.configure(
        Config, locals(), only=options.check_once("--only", only or ()), extend=str(extend) if extend else None
    )
    console = Console(quiet)
    to = options.make_output(locals())
    result = evaluate.run(pairs, checkpoints, to, config, console.say, console.progress)
    from stages.common.page.sentences import basis
    from stages.evaluate.coverage import coverage_lines
    from stages.evaluate.table import gain_lines, result_lines

    columns, cells = result_lines(result)
    unit = "I/F" if result["image_units"] == "iof" else f"shares of {result['dn_full_range']:.0f} DN"
    console.table(f"split '{split}': {basis(result)}; RMSE in {unit}, MSE in its square", columns, cells)
    columns, cells = gain_lines(result)
    if cells:
        console.table(f"what the learned reflectance gains, paired over ground: {basis(result)}", columns, cells)
    if result["coverage_percent"] is not None:
        console.table("pixels within the learned intervals, percent", *coverage_lines(result["coverage_percent"]))
    console.say(f"Hapke's published parameters: {result['hapke_set']}")
    for sentence in result["conclusions"]:
        console.say(sentence)
    for warning in result["warnings"]:
        console.say(f"note: {warning}.")
    if result["lpips_unavailable"]:
        console.say(f"LPIPS is not available: {result['lpips_unavailable']}.")
    console.say(f"written: {output}, {output.with_suffix('.json')}" + (f", {figures}/" if figures else ""))
