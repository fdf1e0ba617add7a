"""`lunargr held-out PAIRS MAP...`: how well maps with albedo predict images that had no part in their albedo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli import options
from lunargr_cli.console import Console
from stages import evaluate
from stages.evaluate import HeldOutConfig

NAME, ORDER = "held-out", 70


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project', of the scene of the maps.")],
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="MAP...", help="Maps from 'lunargr albedo' with --fold or --leave-out, such as those of all folds."
        ),
    ],
    output: options.OutputFile = Path("held_out.h5"),
    split: Annotated[str, typer.Option("--split", help="train, validation or test.")] = HeldOutConfig.split,
    seed: options.Seed = HeldOutConfig.seed,
    json_file: options.Json = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Score maps with albedo on images that were left out of it: seen ground, unseen images.

    Each pair is scored on the first map whose albedo its image had no part in. A JSON file beside the output holds the
    same results.
    """
    console = Console(quiet)
    result = evaluate.run_held_out(
        pairs, maps, options.make_output(locals()), HeldOutConfig(split, seed), console.progress
    )
    from stages.evaluate.coverage import coverage_lines
    from stages.evaluate.held_out_images import image_lines, result_lines

    suns = result["nearest_used_sun_deg"]
    title = (
        f"{result['claim']}: {result['pairs']} crops of split '{split}', {result['tiles']} ground tiles, "
        f"Suns {suns['least']:.1f} to {suns['most']:.1f} deg from the nearest one used"
    )
    console.table(title, *result_lines(result))
    console.table("by image", *image_lines(result))
    if result["coverage_percent"] is not None:
        console.table("pixels within the intervals, percent", *coverage_lines(result["coverage_percent"]))
    for warning in result["warnings"]:
        console.say(f"note: {warning}.")
    console.say(f"written: {output}, {output.with_suffix('.json')}")
